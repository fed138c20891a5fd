"""What made `docs/results`: studies and benchmarks, run by `python -m studies` (docs/results.md)."""
