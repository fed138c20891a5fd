"""The studies behind `docs/results.md`: what is run, the runs, and tables and figures made of their JSON files."""
