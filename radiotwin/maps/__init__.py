"""Radio maps: the object, its files, flights through it, and export."""
