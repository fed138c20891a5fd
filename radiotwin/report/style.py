"""Define the look that all figures share: colours, canvas, labels and the file."""

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.display import plain
from radiotwin.io.files import atomic_file

LOS_COLOUR, NLOS_COLOUR = "#2a7f9e", "#d1495b"
BEFORE, AFTER, FITTED, FOUND = "#c2571a", "#1f6f8b", "#22272c", "#7a0177"
DPI = 110


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


def shorten(text: str, max_length: int = 14) -> str:
    """Cut a name so that it fits under an axis."""
    return plain(text, max_length)


def draw_legend_below(figure: Figure, title: str = "") -> None:
    """Put the legend of a figure's first axes below all axes; with a title alone it is a note."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles or title:
        figure.legend(handles, labels, title=title, loc="outside lower center", ncols=3,
                      frameon=False)
