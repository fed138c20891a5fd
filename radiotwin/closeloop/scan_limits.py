"""How far a group of links would have had to be from its peers, to be said to stand out.

A typical group of each family is moved away from its peers, further and further until the scan
finds it. What is not said and is smaller may be there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logit

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.families import Readings, families_of, units_of
from radiotwin.closeloop.scan import UNITS, Compared, compare, moved
from radiotwin.closeloop.verdict.criteria import MIN_SURE
from radiotwin.inference.groups import PeerComparison, Units

STATISTICS = ("level", "scatter")
FIRST, STEP = 3.0, 1.25  # errors of a typical group; each size that is tried over the one before
MOST = {"level": 30.0, "scatter": 3.0}  # dB; logarithm of the scatter


@dataclass(frozen=True)
class Seen:
    """Least size from which a typical group of a family would surely have been said.

    Attributes:
        family: of groups.
        statistic: `level` or `scatter`.
        size: dB or times.
        unit: of the size.
    """

    family: str
    statistic: str
    size: float
    unit: str


def seen_from(model: CrossFit) -> list[Seen]:
    """Return from which size on a group of each family would have been said.

    Args:
        model: in whose held-out links no group stands out.
    """
    readings = Readings.of(model)
    units = units_of(readings)
    families = [replace(each, statistics=tuple(
        statistic for statistic in STATISTICS if statistic in each.statistics))
                for each in families_of(readings, units)]
    sharpest: dict[tuple[str, str], tuple[Compared, int, float]] = {}
    for each in compare(readings, families, units):
        if isinstance(each.distance, PeerComparison):
            key, (group, total) = (each.family.name, each.statistic), _typical(each.distance)
            if key not in sharpest or total < sharpest[key][2]:
                sharpest[key] = each, group, total
    found = []
    for (family, statistic), (each, group, total) in sharpest.items():
        size = _least_size(each, group, total, readings, units)
        if np.isfinite(size):
            value = float(np.exp(size)) if statistic == "scatter" else size
            found.append(Seen(family, statistic, value, UNITS[statistic]))
    return found


def _typical(distance: PeerComparison) -> tuple[int, float]:
    """Return the group whose error and spread together are the median, and what they are."""
    judged = np.isfinite(distance.size)
    total = np.where(judged, np.hypot(distance.error, distance.spread), np.inf)
    group = int(np.argsort(total)[(judged.sum() - 1) // 2])
    return group, float(total[group])


def _least_size(compared: Compared, group: int, total: float, readings: Readings,
                units: Units) -> float:
    """Return the size from which a typical group is surely said; inf if there is none."""
    statistic = compared.statistic
    family = replace(compared.family, statistics=(statistic,))
    rows, sure = family.groups.members(group, len(readings)), logit(MIN_SURE)
    size = FIRST * total
    while size <= MOST[statistic]:
        tables = compare(moved(readings, rows, statistic, size), [family], units)
        if max(each.log_odds[group] for each in tables) >= sure:
            return size
        size *= STEP
    return np.inf
