"""Objects as a line, as a small table, and as rows for GIS programs.

Summaries of objects: one line for a terminal, a small table for a notebook.

Tables for GIS programs: rows with a geometry and a reference system, as GeoPandas has them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo.geodesy import local_crs
from radiotwin.io.forms import Origin
from radiotwin.io.texts import shown

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

MAX_CELL = 300  # characters of a cell; names come from strangers' files
MAX_LINE = 200
_NAMED = 5


@dataclass(frozen=True)
class Summary:
    """Facts about an object.

    Attributes:
        kind: its class.
        line: what it is, without its class.
        facts: subject and finding of each row of the table.
    """

    kind: str
    line: str
    facts: tuple[tuple[str, str], ...] = ()

    def text(self) -> str:
        """Return `<Kind: line>`, on one line."""
        return f"<{self.kind}: {' '.join(shown(self.line, MAX_LINE).split())}>"

    def html(self) -> str:
        """Return a table; every text is escaped."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(shown(subject, MAX_CELL))}</th>'
            f'<td style="text-align:left">{escape(shown(finding, MAX_CELL))}</td></tr>'
            for subject, finding in self.facts)
        return (f"<div><strong>{escape(self.kind)}</strong>: {escape(shown(self.line, MAX_CELL))}"
                f"<table>{rows}</table></div>")


class Summarised(ABC):
    """An object that shows its summary: in a terminal one line, in a notebook a table."""

    @property
    @abstractmethod
    def _summary(self) -> Summary:
        """Summary that is shown."""

    def __repr__(self) -> str:
        return self._summary.text()

    def _repr_html_(self) -> str:
        return self._summary.html()


def count(number: int, noun: str) -> str:
    """Return a number with its noun.

    >>> count(1, "device"), count(1200, "link")
    ('1 device', '1,200 links')
    """
    return f"{number:,} {noun}" + "s" * (number != 1)


def some(names: Iterable[str]) -> str:
    """Return the first names of a list, and how many there are."""
    names = [str(name) for name in names]
    more = f", … ({len(names):,} in all)" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def span(low: float, high: float, unit: str) -> str:
    """Return a range of values with its unit; a dash where nothing is finite.

    >>> span(-101.26, -60.0, "dB")
    '−101.3 to −60 dB'
    """
    if not (low <= high):
        return "–"
    return f"{round(low, 1):g} to {round(high, 1):g} {unit}".replace("-", "−")


def geo_data_frame(table: pd.DataFrame, origin: Origin | None, *, position_m: np.ndarray | None
                   = None, geometry: Any = None) -> GeoDataFrame:
    """Return a table with a geometry in metres of the local frame.

    Its reference system is that of the frame, where the origin is known: `.to_crs(4326)` gives
    longitude and latitude.

    Args:
        table: n rows.
        origin: of the local frame; None: the result has no reference system.
        position_m: (n, 2) or (n, 3) points [m]; a row with NaN has no geometry.
        geometry: (n,) shapes in place of points.

    Raises:
        BadInput: GeoPandas is not installed.
    """
    try:
        import geopandas
    except ImportError:
        raise BadInput("a GeoDataFrame needs the package geopandas, which is not installed; "
                       "install it with `pip install 'radiotwin[geo]'`") from None
    if geometry is None:
        import shapely

        assert position_m is not None
        known = np.isfinite(position_m).all(axis=1)
        geometry = np.full(len(table), None, dtype=object)
        geometry[known] = shapely.points(position_m[known])
    crs = None if origin is None else local_crs(origin)
    return geopandas.GeoDataFrame(table, geometry=geometry, crs=crs)
