"""Search for effects: stages, candidates, evidence."""
