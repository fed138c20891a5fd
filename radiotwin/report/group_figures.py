"""Heat maps of the held-out residual by device, receiver and flight; anomalies are framed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from radiotwin.display import RESIDUAL_COLOURS, plain, residual_range_db
from radiotwin.inference.gaussian import MAD_SD
from radiotwin.report.closeloop_data import DrawnLinks, LoopData
from radiotwin.report.labels import FITTED, new_figure, signed

MAX_MEMBERS = 40  # of an end; more would be too small to be read
MIN_LINKS = 3  # in a cell that is shown
MAX_NUMBERS = 12  # columns up to which each cell has its number
SCATTER_COLOURS = "YlGnBu"


@dataclass(frozen=True, eq=False)
class Pivot:
    """Table of residuals by two ends, such as device and flight.

    Attributes:
        axes: what rows and columns are: two of `device`, `receiver` and `flight`.
        names: of rows and of columns.
        median_db: (rows, columns) median residual [dB]; NaN with fewer than `MIN_LINKS` links.
        scatter_db: (rows, columns) robust standard deviation of residuals [dB]; NaN likewise.
        left_out: number of members that are not shown, by end.
    """

    axes: tuple[str, str]
    names: tuple[list[str], list[str]]
    median_db: np.ndarray
    scatter_db: np.ndarray
    left_out: dict[str, int]


def pivot(links: DrawnLinks, residual_db: np.ndarray, ends: tuple[str, str],
          anomalies: Sequence[dict]) -> Pivot:
    """Tabulate median and scatter of residuals (n,) [dB] by two of device, receiver and flight.

    Up to `MAX_MEMBERS` names of each end get a row or column: those in anomalies (deviating groups
    of links) first, then those with the largest mean square residual.
    """
    table = pd.DataFrame({end: links.variables[end].astype(int) for end in ends} | {
        "residual_db": residual_db}).dropna()
    kept, left_out = [], {}
    for end in ends:
        names = links.names[end]
        framed = {name for each in anomalies for name in each["members"].get(end, ())}
        mean_square = (table["residual_db"]**2).groupby(table[end]).mean()
        order = sorted(mean_square.index,
                       key=lambda each: (names[each] not in framed, -mean_square[each]))
        kept.append(sorted(order[:MAX_MEMBERS]))
        left_out[end] = len(order) - len(kept[-1])
    pairs = table.groupby(list(ends))["residual_db"]
    deviation_db = (table["residual_db"] - pairs.transform("median")).abs()
    is_known = pairs.count() >= MIN_LINKS
    median_db, scatter_db = (
        each.where(is_known).unstack().reindex(index=kept[0], columns=kept[1]).to_numpy()
        for each in (pairs.median(),
                     MAD_SD * deviation_db.groupby([table[end] for end in ends]).median()))
    shown = [[links.names[end][each] for each in members]
             for end, members in zip(ends, kept, strict=True)]
    return Pivot(ends, (shown[0], shown[1]), median_db, scatter_db, left_out)


def groups_figure(data: LoopData, report: dict) -> Figure:
    """Draw heat maps of the held-out residual by device and flight, and by receiver and flight.

    With a single flight there is one table, by device and receiver. Each has two panels: median and
    scatter. Anomalies of `report` (`closeloop.json`) are framed in the panel that shows them.
    """
    residual_db, anomalies = data.links.level_db - data.before_db, report.get("anomalies", [])
    flights, receivers = len(data.links.flight_names), len(data.links.receiver_names)
    ends = [("device", "flight")]
    if receivers > 1:
        ends = [("device", "receiver")] if flights == 1 else [*ends, ("receiver", "flight")]
    pivots = [pivot(data.links, residual_db, each, anomalies) for each in ends]
    heights = [0.26 * len(each.names[0]) + 1.3 for each in pivots]
    widest = max(len(each.names[1]) for each in pivots)
    figure = new_figure(min(max(2 * (0.62 * widest + 2.2), 7.0), 16.0), sum(heights) + 0.4)
    grid = figure.add_gridspec(len(pivots), 2, height_ratios=heights)
    high_db = residual_range_db(np.concatenate([each.median_db.ravel() for each in pivots]))
    scatters_db = np.concatenate([each.scatter_db.ravel() for each in pivots])
    known_db = scatters_db[np.isfinite(scatters_db)]
    top_db = max(1.0, known_db.max(), 2 * np.median(known_db)) if len(known_db) else 1.0
    for row, each in enumerate(pivots):
        panels = ((each.median_db, "median residual [dB]", RESIDUAL_COLOURS, -high_db, high_db,
                   ("level", "curve", "blanks")),
                  (each.scatter_db, "scatter [dB]", SCATTER_COLOURS, 0.0, top_db, ("scatter",)))
        for column, (values, label, colours, low, high, statistics) in enumerate(panels):
            ax = figure.add_subplot(grid[row, column])
            image = ax.imshow(values, cmap=colours, vmin=low, vmax=high, aspect="auto")
            figure.colorbar(image, ax=ax, label=label, pad=0.02)
            _label(ax, each, column)
            _write_numbers(ax, values, low, high)
            for anomaly in anomalies:
                if anomaly["statistic"] in statistics:
                    _frame(ax, each, _framed_members(anomaly), _is_part(anomaly))
    return figure


def _is_part(anomaly: dict) -> bool:
    """Return whether an anomaly holds a part of its members' links only."""
    return bool(anomaly.get("ranges")) or anomaly.get("sight", "all") != "all"


def _framed_members(anomaly: dict) -> dict[str, Sequence[str]]:
    """Return an anomaly's names by kind; if its family is a kind, such as device, only that one."""
    members, family = anomaly["members"], anomaly["family"]
    return {family: members[family]} if family in members else members


def _label(ax: Axes, found: Pivot, column: int) -> None:
    """Label the rows and columns of a heat map, and say how many names are not shown."""
    rows, columns = found.names
    crowded = len(columns) * max(map(len, columns)) > 40
    ax.set_xticks(range(len(columns)), [_cut(name, 14) for name in columns],
                  rotation=90 if crowded else 0, fontsize=8)
    ax.set_yticks(range(len(rows)), [_cut(name, 20) for name in rows] if column == 0 else [],
                  fontsize=8)
    more = {end: f"{end}{'s' * (count != 1)}" for end, count in found.left_out.items()}
    left = [f"{count} {more[end]} not shown" for end, count in found.left_out.items() if count]
    ax.set_xlabel("; ".join([found.axes[1], *left]))
    ax.set_ylabel(found.axes[0] if column == 0 else "")
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)


def _write_numbers(ax: Axes, values: np.ndarray, low: float, high: float) -> None:
    """Write each cell's value [dB] into it, white on dark; none in over `MAX_NUMBERS` columns."""
    if values.shape[1] > MAX_NUMBERS:
        return
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            share = (value - low) / (high - low)
            dark = share > (0.8 if low < 0 else 0.45) or (low < 0 and share < 0.2)
            ax.text(column, row, signed(value), ha="center", va="center",
                    fontsize=7, color="white" if dark else FITTED)


def _frame(ax: Axes, found: Pivot, members: dict[str, Sequence[str]], is_part: bool) -> None:
    """Frame the cells of an anomaly (a deviating group of links) in a heat map.

    The frame is dashed if the anomaly is only a part of the cells' links (`is_part`). Nothing is
    drawn if `members` names an end, such as receiver, that is not an axis of the panel.
    """
    if not members or not set(members) <= set(found.axes):
        return
    spans = []
    for end, names in zip(found.axes, found.names, strict=True):
        chosen = members.get(end)
        shown = [place for place, name in enumerate(names) if chosen is None or name in chosen]
        spans.append(_consecutive(shown))
    for top, bottom in spans[0]:
        for left, right in spans[1]:
            ax.add_patch(Rectangle((left - 0.5, top - 0.5), right - left + 1, bottom - top + 1,
                                   fill=False, edgecolor=FITTED, linewidth=2.2, zorder=5,
                                   linestyle="--" if is_part else "-", clip_on=False,
                                   path_effects=[withStroke(linewidth=5, foreground="white")]))


def _cut(name: str, most: int) -> str:
    """Cut a name in its middle: long names of one campaign often differ at their end."""
    if len(name) > most:
        name = f"{name[:most // 2 - 1]}…{name[len(name) - most // 2:]}"
    return plain(name)


def _consecutive(places: list[int]) -> list[tuple[int, int]]:
    """Return first and last of each run of consecutive places: [0, 1, 4] -> [(0, 1), (4, 4)]."""
    runs: list[tuple[int, int]] = []
    for place in places:
        if runs and runs[-1][1] == place - 1:
            runs[-1] = runs[-1][0], place
        else:
            runs.append((place, place))
    return runs
