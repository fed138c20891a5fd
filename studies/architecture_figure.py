"""Draw docs/images/architecture.png: `python studies/architecture_figure.py [FILE]`."""

import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

FILE = Path(__file__).parents[1] / "docs" / "images" / "architecture.png"
WIDTH, HEIGHT = 1.17, 0.72  # of a box [inch]
COLUMNS = [0.68 + 1.33 * column for column in range(6)]  # middles of the boxes [inch]
ROWS = {"inputs": 3.42, "predict": 2.22, "explain": 0.6}
COLOURS = {"inputs": "#eceff1", "predict": "#d4eeee", "explain": "#fbe6cd"}
BOXES = {  # name -> row, column, title, what is below it
    "scene": ("inputs", 1, "Scene", "3D map, radio"),
    "channel": ("inputs", 2, "ChannelModel", "law, network,\nimage paths"),
    "localize": ("inputs", 3, "localize", "positions of\ndevices"),
    "measurements": ("predict", 0, "Measurements", "measurements\n.csv"),
    "links": ("predict", 1, "Links", "joined with map,\nchecked"),
    "model": ("predict", 2, "Model, Fit", "censored\nregression"),
    "twin": ("predict", 3, "Twin", "Fit, devices,\nprovenance"),
    "map": ("predict", 4, "RadioMap", "mean, sd of\neach position"),
    "policy": ("predict", 5, "policy", "marl: learner\nor planner"),
    "residual": ("explain", 2, "CrossFit", "residual of\nheld-out links"),
    "effects": ("explain", 3, "effects", "propose and fit\nparameters"),
    "search": ("explain", 4, "search", "stages, a log\nof trials"),
    "verdict": ("explain", 5, "verdict", "closeloop.json,\npage")}
ARROWS = [("scene", "links"), ("channel", "model"), ("localize", "twin"), ("measurements", "links"),
          ("links", "model"), ("model", "twin"), ("twin", "map"), ("map", "policy"),
          ("model", "residual"), ("residual", "effects"), ("effects", "search"),
          ("search", "verdict")]
BLUE, GREY = "#00695c", "#37474f"


def middle(name: str) -> tuple[float, float]:
    """Return the middle of a box [inch]."""
    row, column, *_ = BOXES[name]
    return COLUMNS[column], ROWS[row]


def draw_box(axes: Axes, name: str) -> None:
    """Draw a box with its title and text."""
    row, _, title, text = BOXES[name]
    x, y = middle(name)
    axes.add_patch(FancyBboxPatch((x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, linewidth=1,
                                  boxstyle="round,pad=0,rounding_size=0.06",
                                  facecolor=COLOURS[row], edgecolor=GREY))
    axes.text(x, y + 0.18, title, ha="center", va="center", fontsize=9.2, fontweight="bold")
    axes.text(x, y - 0.12, text, ha="center", va="center", fontsize=9, linespacing=1.1)


def draw_arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float],
               **style: object) -> None:
    """Draw an arrow between two points [inch]."""
    arrow = {"arrowstyle": "-|>", "color": GREY, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0,
             "mutation_scale": 13} | style
    axes.annotate("", end, start, arrowprops=arrow)


def connect(axes: Axes, start: str, end: str) -> None:
    """Draw an arrow from the edge of one box to that of another in its row or column."""
    (x0, y0), (x1, y1) = middle(start), middle(end)
    if y0 == y1:
        draw_arrow(axes, (x0 + WIDTH / 2, y0), (x1 - WIDTH / 2, y1))
    else:
        draw_arrow(axes, (x0, y0 - HEIGHT / 2), (x1, y1 + HEIGHT / 2))


def draw() -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(8.0, 4.0), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, 8), ylim=(0, 4))
    axes.set_axis_off()
    for name in BOXES:
        draw_box(axes, name)
    for start, end in ARROWS:
        connect(axes, start, end)
    # What was kept becomes part of the next fit, and of the twin.
    x, y = middle("search")
    back = y + HEIGHT / 2 + 0.32
    twin_x, twin_y = middle("twin")
    axes.plot([x, x, twin_x], [y + HEIGHT / 2, back, back], color=BLUE, linewidth=1.4)
    draw_arrow(axes, (twin_x, back), (twin_x, twin_y - HEIGHT / 2), color=BLUE)
    axes.text(x + 0.08, back, "kept effects become\nTwin.effects", fontsize=9, color=BLUE,
              va="center")
    for y, text in ((ROWS["predict"] + HEIGHT / 2 + 0.16, "predict"),
                    (ROWS["explain"], "explain the residual")):
        axes.text(0.1, y, text, fontsize=10, color=GREY, style="italic", va="center")
    return figure


def main() -> None:
    """Write the figure."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    draw().savefig(path, dpi=200)


if __name__ == "__main__":
    main()
