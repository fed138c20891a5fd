"""Formats that are recognised by their columns."""

from radiotwin.importing.formats.format import Format
from radiotwin.importing.formats.registry import FORMATS, expected, find_format, format_named

__all__ = ["FORMATS", "Format", "expected", "find_format", "format_named"]
