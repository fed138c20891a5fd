"""The verdict and every number that decides it."""
