"""Measured antenna patterns: read from files, oriented, and evaluated in a direction."""

from radiotwin.antennas.pattern import Antenna, Pattern
from radiotwin.antennas.read import read_pattern

__all__ = ["Antenna", "Pattern", "read_pattern"]
