"""Measured antenna patterns: read from files, turned to where an antenna looks, asked for the gain in a direction."""

from radiotwin.antennas.pattern import Antenna, Pattern
from radiotwin.antennas.read import read_pattern

__all__ = ["Antenna", "Pattern", "read_pattern"]
