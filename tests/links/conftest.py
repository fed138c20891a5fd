"""Worlds that links are read from."""

from tests.worlds import open_ground

__all__ = ["open_ground"]
