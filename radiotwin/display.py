"""Show objects: one line, a table in a notebook, axes of a plot, rows for a GIS.

Axes of a plan view are metres of the local frame, or degrees if its origin is known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput, optional_package
from radiotwin.geo import local_crs, to_geographic
from radiotwin.io.forms import Origin
from radiotwin.io.texts import shown

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection, QuadMesh

TICKS = 6  # on an axis in degrees, whose labels are long
LABEL_SHARE = 0.85  # height of a colour bar over that of the axes
GAIN_COLOURS = "viridis"
DIFFERENCE_COLOURS = "RdBu_r"  # of model − truth, red: the model predicts more
RESIDUAL_COLOURS = "RdBu"  # of measured − predicted, red: less was measured than predicted
RESIDUAL_RANGE_DB = (2.0, 30.0)  # smallest and largest end of a colour scale
MAX_CELL = 300  # characters of a cell; names come from strangers' files
MAX_LINE = 200


def new_axes(ax: Axes | None) -> Axes:
    """Return the given axes, or those of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(7.0, 5.6), layout="constrained")[1]


@dataclass(frozen=True)
class PlotFrame:
    """Coordinates of the axes.

    Attributes:
        origin: of the local frame; None: axes are in metres.
    """

    origin: Origin | None = None

    @classmethod
    def choose(cls, origin: Origin | None, geographic: bool | None) -> PlotFrame:
        """Choose axes in degrees if `geographic`, else metres; None: degrees if origin is known.

        Raises:
            BadInput: longitude and latitude are requested without an origin.
        """
        if geographic and origin is None:
            raise BadInput("longitude and latitude cannot be drawn: the origin of the frame is not "
                           "known; give the scene an [origin], or plot with geographic=False")
        return cls(None if geographic is False else origin)

    def at(self, x_m: Any, y_m: Any) -> tuple[np.ndarray, np.ndarray]:
        """Convert local positions [m], in any shape, to coordinates on the axes."""
        x_m, y_m = np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float)
        if self.origin is None:
            return x_m, y_m
        return to_geographic(self.origin, x_m, y_m)

    def prepare(self, ax: Axes) -> None:
        """Label the axes, and give a metre the same length on both."""
        if self.origin is None:
            ax.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
            return
        from matplotlib.ticker import MaxNLocator

        shrinkage = float(np.cos(np.radians(self.origin.latitude_deg)))
        ax.set(xlabel="longitude [°]", ylabel="latitude [°]",
               aspect=1 / max(shrinkage, 1e-3))
        ax.ticklabel_format(useOffset=False, style="plain")
        ax.xaxis.set_major_locator(MaxNLocator(TICKS))
        ax.tick_params(axis="x", labelrotation=25)


METRES = PlotFrame()


def draw_cells(ax: Axes, frame: PlotFrame, x_m: np.ndarray, y_m: np.ndarray, values: np.ndarray,
               **look: Any) -> QuadMesh:
    """Draw values (ny, nx) in cells around positions x (nx,) and y (ny,), ascending [m].

    NaN stays empty; `look` is passed to `Axes.pcolormesh`.
    """
    corners = frame.at(*np.meshgrid(_edges(x_m, y_m), _edges(y_m, x_m)))
    return ax.pcolormesh(*corners, values, rasterized=True, linewidth=0, **look)


def draw_points(ax: Axes, frame: PlotFrame, x_m: np.ndarray, y_m: np.ndarray,
                **look: Any) -> PathCollection:
    """Draw points of the local frame [m]; `look` is passed to `Axes.scatter`."""
    return ax.scatter(*frame.at(x_m, y_m), **look)


def add_colour_bar(ax: Axes, drawn: Any, label: str, extend: str = "neither") -> None:
    """Add a colour bar beside the axes."""
    ax.figure.colorbar(drawn, ax=ax, label=label, shrink=LABEL_SHARE, extend=extend)


def add_legend(ax: Axes) -> None:
    """Add a legend below the axes if anything in them has a label."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        by_label = dict(zip(labels, handles))
        ax.legend(by_label.values(), by_label, loc="upper center", bbox_to_anchor=(0.5, -0.18),
                  ncols=3, frameon=False)


def _edges(along_m: np.ndarray, across_m: np.ndarray) -> np.ndarray:
    """Return the (n + 1,) borders of cells around n ascending positions along an axis [m].

    A single cell is as wide as the cells along the other axis (`across_m`), or else 1 m.
    """
    if len(along_m) > 1:
        step_m = np.diff(along_m)
    else:
        step_m = np.diff(across_m)[:1] if len(across_m) > 1 else np.ones(1)
    middle_m = along_m[:-1] + np.diff(along_m) / 2
    return np.concatenate([[along_m[0] - step_m[0] / 2], middle_m, [along_m[-1] + step_m[-1] / 2]])


def plain(text: str, max_length: int = 100) -> str:
    """Make a foreign text safe for a figure: short, on one line, escaped, without formulas."""
    return " ".join(shown(text, max_length).split()).replace("$", r"\$")


def residual_range_db(residual_db: np.ndarray) -> float:
    """Return the end of a symmetric colour scale [dB] that contains 95 % of the finite values."""
    finite = np.abs(residual_db[np.isfinite(residual_db)])
    high_db = float(np.quantile(finite, 0.95)) if len(finite) else 0.0
    return float(np.clip(np.ceil(high_db), *RESIDUAL_RANGE_DB))


def level_range_db(level_db: np.ndarray) -> tuple[float, float]:
    """Return the ends of a colour scale [dB]: the 1 and 99.5 % quantiles of the finite levels."""
    finite = level_db[np.isfinite(level_db)]
    if not len(finite):
        return -1.0, 0.0
    low, high = np.quantile(finite, [0.01, 0.995])
    return float(low), float(high)


@dataclass(frozen=True)
class Summary:
    """Facts about an object.

    Attributes:
        kind: class of the object.
        line: short description, without the class.
        facts: rows of the table: subject and finding.
    """

    kind: str
    line: str
    facts: tuple[tuple[str, str], ...] = ()

    def text(self) -> str:
        """Return `<Kind: line>`, on one line."""
        return f"<{self.kind}: {' '.join(shown(self.line, MAX_LINE).split())}>"

    def html(self) -> str:
        """Return the summary as an HTML table; every text is escaped."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(shown(subject, MAX_CELL))}</th>'
            f'<td style="text-align:left">{escape(shown(finding, MAX_CELL))}</td></tr>'
            for subject, finding in self.facts)
        return (f"<div><strong>{escape(self.kind)}</strong>: {escape(shown(self.line, MAX_CELL))}"
                f"<table>{rows}</table></div>")


class Summarised(ABC):
    """Base of objects that show a summary: one line in a terminal, a table in a notebook."""

    @property
    @abstractmethod
    def _summary(self) -> Summary:
        """Summary of the object."""

    def __bool__(self) -> bool:
        return True  # also without devices or links

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


def some(names: Iterable[object], max_names: int = 5) -> str:
    """Join the first names of a list, and say how many there are if some are omitted."""
    texts = [str(name) for name in names]
    more = f", … ({len(texts):,} in all)" if len(texts) > max_names else ""
    return ", ".join(texts[:max_names]) + more


def span(low: float, high: float, unit: str) -> str:
    """Return a range of values with its unit; a dash if they are not finite.

    >>> span(-101.26, -60.0, "dB")
    '−101.3 to −60 dB'
    """
    if not (low <= high):
        return "–"
    return f"{round(low, 1):g} to {round(high, 1):g} {unit}".replace("-", "−")


def geo_data_frame(table: pd.DataFrame, origin: Origin | None, *, position_m: np.ndarray | None
                   = None, geometry: Any = None) -> GeoDataFrame:
    """Add a geometry in metres of the local frame to a table of n rows.

    Args:
        table: n rows.
        origin: of the frame; if known, `.to_crs(4326)` gives longitude and latitude.
        position_m: points (n, 2) or (n, 3) [m]; NaN: none.
        geometry: other shapes (n,), in place of points.

    Raises:
        BadInput: GeoPandas is not installed.
    """
    geopandas = optional_package(
        "geopandas", "a GeoDataFrame needs the package geopandas, which is not installed; install "
                     "it with `pip install 'radiotwin[geo]'`")
    if geometry is None:
        import shapely

        assert position_m is not None
        known = np.isfinite(position_m).all(axis=1)
        geometry = np.full(len(table), None, dtype=object)
        geometry[known] = shapely.points(position_m[known])
    crs = None if origin is None else local_crs(origin)
    return geopandas.GeoDataFrame(table, geometry=geometry, crs=crs)
