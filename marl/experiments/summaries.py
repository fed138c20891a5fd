"""Numbers of tables and figures, made of records."""

from collections import defaultdict
from itertools import groupby
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np


class Curve(NamedTuple):
    """Mean and spread over seeds.

    Attributes:
        x: (n,) real episodes, or whatever it is over.
        mean, spread: (n,) of the ratio.
        seeds: how many.
    """

    x: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    seeds: int

    def needed(self, ratio: float) -> float:
        """The first x at which the mean is at least `ratio`; NaN where it never is."""
        enough = np.flatnonzero(self.mean >= ratio)
        return float(self.x[enough[0]]) if len(enough) else np.nan


def by_name(records: list[dict]) -> dict[str, list[dict]]:
    """Name of a run -> its seeds."""
    return {name: list(group) for name, group in groupby(records, key=lambda record: record["name"])}


def over_seeds(records: list[dict], x: str = "real_episodes", y: str = "truth_ratio") -> Curve:
    """The curve of a run, as long as that of every seed."""
    rows = min(len(record["curve"]) for record in records)
    table = np.array([[(row[x], row[y]) for row in record["curve"][:rows]] for record in records], dtype=float)
    return Curve(table[:, :, 0].mean(axis=0), table[:, :, 1].mean(axis=0), spread(table[:, :, 1]), len(records))


def spread(values) -> np.ndarray:
    """Standard deviation over the first axis, estimated from that few (n - 1); 0 of one value."""
    return np.std(values, axis=0, ddof=1 if len(values) > 1 else 0)


def worlds(records: list[dict]) -> dict[tuple[str, str], dict[str, list[dict]]]:
    """(truth, scene) -> name without both -> seeds, of runs of Algorithm 1."""
    found: dict[tuple[str, str], dict[str, list[dict]]] = defaultdict(dict)
    for name, seeds in by_name(records).items():
        run = seeds[0]["settings"]["run"]
        scene, truth = Path(run["scene"]).name, run["truth"]
        found[truth, scene][name.removeprefix(f"{scene}-{truth}-")] = seeds
    return dict(sorted(found.items(), key=lambda item: (item[0][0] != "traced", item[0][1])))


def shown(scene: str, truth: str) -> str:
    """A world in words."""
    return f"{scene.replace('paper_', 'the paper’s ')}, {'ray-traced' if truth == 'traced' else 'statistical'} truth"


def scenes(records: list[dict]) -> dict[str, dict[str, list[dict]]]:
    """Scene -> name without it -> seeds, of the other runs."""
    found: dict[str, dict[str, list[dict]]] = defaultdict(dict)
    for name, seeds in by_name(records).items():
        scene = Path(seeds[0]["settings"]["scene"]).name
        found[scene][name.removeprefix(f"{scene}-")] = seeds
    return dict(found)


def quantiles(errors_m: list[float | None]) -> tuple[float, float, float, float]:
    """Median, 90 % and worst of distances [m], and the share above 100 m; a device without estimate counts as far."""
    errors = np.array([np.inf if error is None else error for error in errors_m], dtype=float)
    # Nothing lies between a number and infinity.
    method: Literal["linear", "higher"] = "linear" if np.isfinite(errors).all() else "higher"
    return (float(np.median(errors)), float(np.quantile(errors, 0.9, method=method)), float(errors.max()),
            float(np.mean(errors > 100)))


def mean_of(records: list[dict], key: str) -> float:
    """Over seeds; NaN where there is nothing."""
    values = [record[key] for record in records if record.get(key) is not None]
    return float(np.mean(values)) if values else np.nan


def number(value: float, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value != value else f"{value:,.{digits}f}"


def with_spread(values: list[float], digits: int = 3) -> str:
    """Mean ± standard deviation, of one value the value."""
    if not values:
        return "–"
    return f"{np.mean(values):.{digits}f}" + (f" ± {spread(values):.{digits}f}" if len(values) > 1 else "")
