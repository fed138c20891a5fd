"""Figures of the study of foreign worlds."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marl.figures import COLOURS
from studies.foreign_roc import SCORES, curve, scored
from studies.foreign_table import SPLITS, has_interval, holds, reliability
from studies.tables import make_panels, with_legend

SCORE_NAMES = ("probability", "held-out likelihood")
LEAST_FALSE_ALARMS = 1e-3


def foreign_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw how often statements are true, how well effects are told apart, and intervals."""
    figure, (left, middle, right) = make_panels(3, 3, 4.0)
    left.plot([0, 1], [0, 1], color="black", linewidth=0.8)
    for index, split in enumerate(SPLITS):
        part = rows[rows["split"] == split]
        if len(part):
            _reliability(left, part, split, index)
            _roc(middle, part, split, index)
    _coverage(right, rows)
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
    return {"foreign": with_legend(figure, [left, middle], 6)}


def _reliability(axes: Axes, part: pd.DataFrame, split: str, index: int) -> None:
    points = [each for each in reliability(part) if each[2]]
    if points:
        given, true, count = np.array(points).T
        error = np.sqrt(np.maximum(true * (1 - true), 0.25 / count) / count)
        axes.errorbar(given, true, error, marker="os"[index], color=COLOURS[index], capsize=2,
                      label=split)
    axes.set(xlabel="probability given", ylabel="share of statements that are true",
             xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))


def _roc(axes: Axes, part: pd.DataFrame, split: str, index: int) -> None:
    for score, name, style in zip(SCORES, SCORE_NAMES, ("-", ":"), strict=True):
        table = scored(part, score)
        there = table["there"].to_numpy(dtype=bool)
        if there.any() and not there.all():
            false, true = curve(there, table["score"].to_numpy())
            axes.step(np.maximum(false, LEAST_FALSE_ALARMS), true, style, color=COLOURS[index],
                      where="post", label=f"{split}, {name}")
    axes.set(xlabel="false alarms", ylabel="effects detected", xscale="log", ylim=(-0.02, 1.02))


def _coverage(axes: Axes, rows: pd.DataFrame) -> None:
    held: dict[str, dict[str, list[bool]]] = {}
    for split, listed in zip(rows["split"], rows["parameters"], strict=True):
        for each in listed:
            if has_interval(each):
                held.setdefault(each["name"], {}).setdefault(split, []).append(holds(each))
    families = sorted(held, reverse=True)
    for index, split in enumerate(SPLITS):
        shares = np.array([np.mean(held[name][split]) if split in held[name] else np.nan
                           for name in families])
        axes.barh(np.arange(len(families)) + 0.2 - 0.4 * index, shares, 0.38,
                  color=COLOURS[index])
    axes.axvspan(0.8, 0.97, color="black", alpha=0.1, linewidth=0, zorder=0)
    axes.set_yticks(range(len(families)), families, fontsize="small")
    axes.set(xlabel="truths in 90 % intervals", xlim=(0, 1.02))
