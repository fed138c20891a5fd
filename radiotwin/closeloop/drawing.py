"""What all pictures of the residual share: colours, means over bins, and the file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.links.link_data import LinkData
from radiotwin.closeloop.words import variable
from radiotwin.files import atomic_path

BEFORE, AFTER, FITTED, FOUND = "#c2571a", "#1f6f8b", "#22272c", "#7a0177"
RESIDUAL_COLOURS = "RdBu"  # red: measured less than predicted
MIN_LINKS = 6  # of a mean that is drawn
DPI = 110
TIMES = (("days", 86_400.0), ("h", 3600.0), ("s", 1.0))


@dataclass(frozen=True, eq=False)
class Means:
    """A mean for each bin of links: where it is, the mean, and its standard error."""

    at: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def bins(value: np.ndarray, count: int) -> np.ndarray:
    """(n,) bin of each value, with about as many values in each; few different values get a bin of their own."""
    values = np.unique(value)
    if len(values) <= count:
        return np.searchsorted(values, value)
    inner = np.unique(np.quantile(value, np.linspace(0, 1, count + 1)[1:-1]))
    return np.searchsorted(inner, value, side="right")


def means(level: np.ndarray, value: np.ndarray, residual_db: np.ndarray, block: np.ndarray) -> Means:
    """Mean residual of each bin.

    Args:
        level: (n,) bin of each link.
        value: (n,) where it is on the axis.
        residual_db: (n,) to be averaged.
        block: (n,) links of one block err alike and count as one in the standard error.
    """
    count = np.bincount(level)
    mean = np.bincount(level, weights=residual_db) / np.maximum(count, 1)
    pairs, place = np.unique(np.column_stack([level, block]), axis=0, return_inverse=True)
    sums = np.bincount(place.ravel(), weights=residual_db - mean[level])
    rest = np.bincount(level, weights=(residual_db - mean[level]) ** 2)
    # No smaller than that of independent links, whose deviations cancel where a bin has one block.
    error = np.sqrt(np.maximum(np.bincount(pairs[:, 0], weights=sums**2), rest)) / np.maximum(count, 1)
    at = np.bincount(level, weights=value) / np.maximum(count, 1)
    used = count >= MIN_LINKS
    return Means(at[used], mean[used], error[used])


def on_axis(links: LinkData, name: str, value: np.ndarray) -> tuple[np.ndarray, str]:
    """A variable as it is drawn, and its label; times count from the first measurement, in units that suit them."""
    words, unit = variable(name)
    if name == "time_s":
        words, value = "time since the first measurement", value - links.first_s
        span_s = np.nanmax(value, initial=0.0)
        unit, size_s = next((unit, size_s) for unit, size_s in TIMES if span_s >= 3 * size_s or unit == "s")
        value = value / size_s
    unit = "dBm" if unit == "dB" and not links.is_gain else unit
    return value, f"{words} [{unit}]" if unit else words


def plain(text: str) -> str:
    """A name that matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def shorten(text: str, most: int = 14) -> str:
    """A name that fits under an axis."""
    return plain(text if len(text) <= most else text[: most - 1] + "…")


def new_figure(width_in: float, height_in: float) -> Figure:
    """A figure without a screen."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def tidy(ax) -> None:
    """Axes on two sides only."""
    ax.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, path: Path) -> None:
    """Write the file, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")
