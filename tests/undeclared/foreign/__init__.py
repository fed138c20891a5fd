"""Foreign worlds: cities, campaigns and effects that share nothing with the effects catalogue."""
