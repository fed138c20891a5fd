"""Formats that are recognised by their columns."""

from radiotwin.importing.formats.registry import (
    FORMATS,
    find_format,
    format_named,
    signatures,
)

__all__ = ["FORMATS", "find_format", "format_named", "signatures"]
