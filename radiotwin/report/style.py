"""Define the look that all figures share: colours, canvas, labels and the file."""

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.files import atomic_file
from radiotwin.report.texts import shown

GAIN_COLOURS = "viridis"
DIFFERENCE_COLOURS = "RdBu_r"  # of model − truth, red: the model predicts more
RESIDUAL_COLOURS = "RdBu"  # of measured − predicted, red: less was measured than predicted
LOS_COLOUR, NLOS_COLOUR = "#2a7f9e", "#d1495b"
BEFORE, AFTER, FITTED, FOUND = "#c2571a", "#1f6f8b", "#22272c", "#7a0177"
DPI = 110
RESIDUAL_RANGE_DB = (2.0, 30.0)  # smallest and largest end of a colour scale


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that is drawn without a screen; sizes in inches."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as a PNG file, completely or not at all."""
    data = io.BytesIO()  # Pillow loses the reason of a write to a file that fails
    figure.savefig(data, dpi=DPI, format="png")
    with atomic_file(path) as file:
        file.write(data.getbuffer())


def hide_spines(ax: Axes) -> None:
    """Draw the axes on two sides only."""
    ax.spines[["top", "right"]].set_visible(False)


def plain(text: str, max_length: int = 100) -> str:
    """Return a foreign text for a figure: short, on one line, nothing hidden, and no formula."""
    return " ".join(shown(text, max_length).split()).replace("$", r"\$")


def shorten(text: str, max_length: int = 14) -> str:
    """Cut a name so that it fits under an axis."""
    return plain(text, max_length)


def residual_range_db(residual_db: np.ndarray) -> float:
    """Return the end of a symmetric colour scale [dB] that 95 % of the finite values are within."""
    finite = np.abs(residual_db[np.isfinite(residual_db)])
    high_db = float(np.quantile(finite, 0.95)) if len(finite) else 0.0
    return float(np.clip(np.ceil(high_db), *RESIDUAL_RANGE_DB))


def level_range_db(level_db: np.ndarray) -> tuple[float, float]:
    """Return the ends of a colour scale [dB] that nearly all finite values are within."""
    finite = level_db[np.isfinite(level_db)]
    if not len(finite):
        return -1.0, 0.0
    low, high = np.quantile(finite, [0.01, 0.995])
    return float(low), float(high)


def draw_legend_below(figure: Figure, title: str = "") -> None:
    """Put the legend of a figure's first axes below all axes; with a title alone it is a note."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles or title:
        figure.legend(handles, labels, title=title, loc="outside lower center", ncols=3,
                      frameon=False)
