"""The catalogue: one file an effect, known by name to nobody else."""
