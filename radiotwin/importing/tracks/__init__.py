"""Positions of a receiver over time: GPX, NMEA, PX4 ULog, or a table; joined with a log in time."""

from radiotwin.importing.tracks.join import add_tracks

__all__ = ["add_tracks"]
