"""A pivot table of held-out residuals: median and scatter by device, receiver, flight and pairs.

It is the baseline of the study `where` and shares no code with the scan. `robust_z` is what a
spreadsheet gives; `shrunken` estimates standard errors from places and the peers' spread from
the peers and a prior (empirical Bayes, as for batting averages: Efron and Morris 1975).
"""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

PLACE_M, MIN_LINKS, MIN_PLACES = 25.0, 12, 4
PRIOR_SD = {"level": 0.6, "scatter": 0.15}  # between peers [dB], [log]
PRIOR_GROUPS = 4.0
THRESHOLD = 6.0
FAMILIES = (("device",), ("receiver",), ("flight",), ("device", "flight"), ("receiver", "flight"),
            ("device", "receiver"))


class PivotGroup(NamedTuple):
    """A group of links: names of its ends, `level` or `scatter`, its shift, score and links."""

    family: str
    members: dict[str, tuple[str, ...]]
    sight: str
    statistic: str
    shift: float
    score: float
    rows: np.ndarray


def robust_z(residual_db: np.ndarray, ends: dict[str, np.ndarray], los: np.ndarray
             ) -> list[PivotGroup]:
    """Score groups by their distance from the median group, in robust spreads; largest first.

    Args:
        residual_db: (n,) held out [dB]; NaN where there is none.
        ends: (n,) names by `device`, `receiver`, `flight`.
        los: (n,) bool.
    """
    found = []
    for (sight, of_sight), family in product(_sights(los), FAMILIES):
        groups = list(_groups(np.where(of_sight, residual_db, np.nan), ends, family))
        for statistic in PRIOR_SD:
            values = np.array([_value(residual_db[rows], statistic) for _, rows in groups])
            if len(values) < 3:
                continue
            spread = 1.4826 * np.median(np.abs(values - np.median(values)))
            found += [PivotGroup(" x ".join(family), members, sight, statistic, float(shift),
                                 float(abs(shift) / spread), rows) for (members, rows), shift in
                      zip(groups, values - np.median(values)) if spread > 0]
    return sorted(found, key=lambda group: -group.score)


def shrunken(residual_db: np.ndarray, ends: dict[str, np.ndarray], los: np.ndarray,
             place_m: np.ndarray) -> list[PivotGroup]:
    """Score groups by their distance from the others, over both standard errors; largest first.

    Args:
        residual_db: (n,) held out [dB]; NaN where there is none.
        ends: (n,) names by `device`, `receiver`, `flight`.
        los: (n,) bool.
        place_m: (n, 2) of the end that moves [m].
    """
    flight = np.unique(ends["flight"], return_inverse=True)[1]
    cells = np.column_stack([np.floor(place_m / PLACE_M).astype(int), flight])
    place = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    found = []
    for (sight, of_sight), family in product(_sights(los), FAMILIES):
        if not np.isfinite(residual_db[of_sight]).any():
            continue
        left_db = _without_ends(np.where(of_sight, residual_db, np.nan),
                                [ends[end] for end in family] * (len(family) == 2))
        groups = [(members, rows) for members, rows in _groups(left_db, ends, family)
                  if len(np.unique(place[rows])) >= MIN_PLACES]
        for statistic, prior in PRIOR_SD.items():
            values = np.array([_value(left_db[rows], statistic) for _, rows in groups])
            errors = np.array([_error(left_db[rows], place[rows], statistic) for _, rows in groups])
            for number, (members, rows) in enumerate(groups):
                peers = np.delete(values, number)
                if len(peers) < 2:
                    continue
                spread = (1.4826 * np.median(np.abs(peers - np.median(peers))))**2
                spread = max(spread - np.median(np.delete(errors, number)**2), 0.0)
                count = len(peers)
                spread = (count * spread + PRIOR_GROUPS * prior**2) / (count + PRIOR_GROUPS)
                shift = values[number] - np.median(peers)
                found.append(PivotGroup(" x ".join(family), members, sight, statistic, float(shift),
                                        float(abs(shift) / np.hypot(errors[number], spread**0.5)),
                                        rows))
    return sorted(found, key=lambda group: -group.score)


def _sights(los: np.ndarray) -> list[tuple[str, np.ndarray]]:
    return [*{"all": np.ones(len(los), dtype=bool), "los": los, "nlos": ~los}.items()]


def _groups(residual_db: np.ndarray, ends: dict[str, np.ndarray], family: tuple[str, ...]
            ) -> Iterator[tuple[dict[str, tuple[str, ...]], np.ndarray]]:
    heard = np.flatnonzero(np.isfinite(residual_db))
    keys = np.column_stack([ends[end][heard].astype(str) for end in family])
    names, group = np.unique(keys, axis=0, return_inverse=True)
    for number, name in enumerate(names):
        rows = heard[group.ravel() == number]
        if len(rows) >= MIN_LINKS:
            yield {end: (str(value),) for end, value in zip(family, name)}, rows


def _without_ends(residual_db: np.ndarray, ends: list[np.ndarray]) -> np.ndarray:
    left_db = residual_db - np.nanmedian(residual_db)
    for _ in range(3 * bool(ends)):
        for end in ends:
            for name in np.unique(end):
                if np.isfinite(left_db[end == name]).any():
                    left_db[end == name] -= np.nanmedian(left_db[end == name])
    return left_db


def _scatter_db(values_db: np.ndarray) -> float:
    return max(1.4826 * float(np.median(np.abs(values_db - np.median(values_db)))), 0.3)


def _value(values_db: np.ndarray, statistic: str) -> float:
    return float(np.median(values_db) if statistic == "level" else np.log(_scatter_db(values_db)))


def _error(values_db: np.ndarray, place: np.ndarray, statistic: str) -> float:
    """Return the standard error where the readings of one place count as one."""
    off = (values_db - np.median(values_db)) / _scatter_db(values_db)
    if statistic == "scatter":
        off = (np.abs(off) > 0.6745) - 0.5
    number = np.unique(place, return_inverse=True)[1]
    means = np.bincount(number, np.clip(off, -3, 3)) / np.bincount(number)
    size = np.sqrt(np.mean(means**2) / (len(means) - 1))
    return float(1.2533 * _scatter_db(values_db) * size if statistic == "level" else size / 0.43)
