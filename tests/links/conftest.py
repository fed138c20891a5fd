"""Worlds that links are read from."""

from tests.worlds import open_ground, short_report

__all__ = ["open_ground", "short_report"]
