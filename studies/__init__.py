"""Studies and benchmarks that made `docs/results`, run by `python -m studies`."""
