"""Worlds that the loop is closed over."""

from tests.worlds import open_ground

__all__ = ["open_ground"]
