"""Frames, reference systems, and conversion between them."""
