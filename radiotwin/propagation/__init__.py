"""Propagation: paths over a 3D map, and channel models."""
