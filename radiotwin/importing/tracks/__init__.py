"""Positions of a receiver over time: from files of its own, joined with a log in time."""

from radiotwin.importing.tracks.join import add_tracks

__all__ = ["add_tracks"]
