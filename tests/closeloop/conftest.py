"""Worlds that the loop is closed over."""

from tests.worlds import open_ground, quick_report, short_report

__all__ = ["open_ground", "quick_report", "short_report"]
