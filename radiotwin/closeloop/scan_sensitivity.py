"""Sensitivity of the scan: the least deviation of a group of links that would have been found.

A typical group of each family is moved away from its peers, further and further, until the scan
finds it. Smaller deviations may be present and are not reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logit

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.families import Readings, families_of, units_of
from radiotwin.closeloop.scan import UNITS, Compared, log_odds_of_groups, shift_group
from radiotwin.closeloop.verdict.criteria import MIN_SURE
from radiotwin.inference.groups import PeerComparison, Units

STATISTICS = ("level", "scatter")
FIRST_SIZE, STEP = 3.0, 1.25  # first size [standard errors of the group]; factor of the next ones
MAX_SIZE = {"level": 30.0, "scatter": 3.0}  # dB; logarithm of the scatter


@dataclass(frozen=True)
class LeastDeviation:
    """Least deviation from its peers from which a typical group is found with high probability.

    Attributes:
        family: what the links of a group share.
        statistic: `level` or `scatter`.
        size: least deviation, in `unit`.
        unit: dB or times.
    """

    family: str
    statistic: str
    size: float
    unit: str


def least_deviations(model: CrossFit) -> list[LeastDeviation]:
    """Find the least deviation that the scan would report, for each family (kind of group).

    Curves are left out, and families whose typical group is not found even at `MAX_SIZE`.

    Args:
        model: cross-validated fit without anomalies in its held-out residual.
    """
    readings = Readings.of(model)
    units = units_of(readings)
    families = [replace(each, statistics=tuple(
        statistic for statistic in STATISTICS if statistic in each.statistics))
                for each in families_of(readings, units)]
    sharpest: dict[tuple[str, str], tuple[Compared, int, float]] = {}
    for each in log_odds_of_groups(readings, families, units):
        if isinstance(each.distance, PeerComparison):
            key, (group, sd) = (each.family.name, each.statistic), _typical_group(each.distance)
            if key not in sharpest or sd < sharpest[key][2]:
                sharpest[key] = each, group, sd
    found = []
    for (family, statistic), (each, group, sd) in sharpest.items():
        size = _least_size(each, group, sd, readings, units)
        if np.isfinite(size):
            value = float(np.exp(size)) if statistic == "scatter" else size
            found.append(LeastDeviation(family, statistic, value, UNITS[statistic]))
    return found


def _typical_group(distance: PeerComparison) -> tuple[int, float]:
    """Return the group with the median uncertainty (own error and peers' spread) and its value."""
    judged = np.isfinite(distance.size)
    sd = np.where(judged, np.hypot(distance.error, distance.spread), np.inf)
    group = int(np.argsort(sd)[(judged.sum() - 1) // 2])
    return group, float(sd[group])


def _least_size(compared: Compared, group: int, sd: float, readings: Readings,
                units: Units) -> float:
    """Return the deviation from which the scan finds a group [dB, or log of the scatter's ratio].

    It grows by the factor `STEP` until the probability is `MIN_SURE`; inf if above `MAX_SIZE`.
    """
    statistic = compared.statistic
    family = replace(compared.family, statistics=(statistic,))
    rows, sure = family.groups.members(group, len(readings)), logit(MIN_SURE)
    size = FIRST_SIZE * sd
    while size <= MAX_SIZE[statistic]:
        tables = log_odds_of_groups(shift_group(readings, rows, statistic, size), [family], units)
        if max(each.log_odds[group] for each in tables) >= sure:
            return size
        size *= STEP
    return np.inf
