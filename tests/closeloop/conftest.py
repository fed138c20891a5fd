"""Worlds that the loop is closed over."""

from tests.worlds import make_links, only_effects, open_ground, quick_report, short_report

__all__ = ["make_links", "only_effects", "open_ground", "quick_report", "short_report"]
