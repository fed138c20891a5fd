"""The final prediction of a loop and its baselines."""
