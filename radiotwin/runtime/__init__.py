"""Workers, kept pieces, signals, progress, and what commands print."""
