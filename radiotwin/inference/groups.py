"""Find groups of values that stand out from their peers: statistics, errors, two-groups odds.

A group is any set of values, and groups may overlap. Each has a statistic (level, log scatter,
share) with a cluster-robust standard error: values of one unit (neighbours, with correlated errors)
count as one. Its peers are the other groups of the same kind. The spread between peers is estimated
robustly and, with few peers, shrunk to a prior. Two hypotheses are compared (Efron 2008,
'Microarrays, empirical Bayes and the two-groups model', Statist. Sci. 23): the group is as far from
its peers as Student's t with that spread allows, or it may be anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student_t

from radiotwin.inference.gaussian import MAD_SD, robust_sd

LEAST = 12, 4, 3.0  # least number of values, passing and lasting units of a group that is judged
BIN_LEAST = 5, 2, 1.0  # the same for a bin of a curve
HUBER = 1.345  # clip of Huber's estimate [scales]: 95 % efficient for normal errors
MAX_SCALES = 6.0  # clip of a single deviation [scales]
LEAVE_OUT = 64  # number of groups up to which peers are taken leave-one-out
PEER_WEIGHT = 4.0  # prior spread counts as so many peers
PRIOR_DOF = 60.0  # degrees of freedom of the prior spread
MIN_ALIKE = 3  # passing units in a lasting one, to estimate the spread between lasting units
OUTLIER_DOF = 2.0  # heavy tails of the size of a group that stands out
POLISH_ROUNDS, SHARED_ROUNDS = 3, 10
MEDIAN_VARIANCE = 1.57  # of a median over that of a mean, normal values: pi / 2
TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Units:
    """Labels of n values that share errors.

    Attributes:
        passing_unit: (n,) label of values with correlated errors at one time.
        lasting_unit: (n,) label of values with correlated errors at all times; few and large.
    """

    passing_unit: np.ndarray
    lasting_unit: np.ndarray


@dataclass(frozen=True, eq=False)
class Groups:
    """Memberships of values in groups, which may overlap.

    Attributes:
        row: (m,) index of the value of each membership.
        group: (m,) index of its group.
        count: number of groups k.
        passing_unit, lasting_unit: (m,) number of its pair of group and unit.
        of_passing_unit, of_lasting_unit: (pairs,) group of each pair.
    """

    row: np.ndarray
    group: np.ndarray
    count: int
    passing_unit: np.ndarray
    of_passing_unit: np.ndarray
    lasting_unit: np.ndarray
    of_lasting_unit: np.ndarray

    @classmethod
    def of_members(cls, row: np.ndarray, group: np.ndarray, count: int, units: Units) -> Groups:
        """Build groups from memberships: rows (m,) and their groups (m,)."""
        return cls(row, group, count, *_pairs(group, units.passing_unit[row]),
                   *_pairs(group, units.lasting_unit[row]))

    @classmethod
    def of_labels(cls, label: np.ndarray, units: Units) -> Groups:
        """Build one group per label (n,); values of a negative label are in no group."""
        row = np.flatnonzero(label >= 0)
        return cls.of_members(row, label[row], int(label.max(initial=-1)) + 1, units)

    def restrict_to(self, rows: np.ndarray) -> Groups:
        """Keep only the members in a mask (n,)."""
        kept = rows[self.row]
        return replace(self, row=self.row[kept], group=self.group[kept],
                       passing_unit=self.passing_unit[kept], lasting_unit=self.lasting_unit[kept])

    def members(self, group: int, n: int) -> np.ndarray:
        """Build the mask (n,) of a group's members."""
        rows = np.zeros(n, dtype=bool)
        rows[self.row[self.group == group]] = True
        return rows


class LastingErrors:
    """Estimator of the error that lasts, from passing units nested in lasting ones."""

    def __init__(self, units: Units, rows: np.ndarray) -> None:
        """Prepare the estimate for some rows (r,), a mask or indices."""
        lasting = np.unique(units.lasting_unit[rows], return_inverse=True)[1].ravel()
        self._part, self._of_part = _pairs(lasting, units.passing_unit[rows])
        self._size = np.bincount(self._part)
        self._parts = np.bincount(self._of_part)

    def sd(self, values: np.ndarray) -> float:
        """Estimate the sd of the error that the values (r,) of a lasting unit, e.g. a place, share.

        Analysis of variance: variance of the units' means, less what the scatter of their visits
        (passing units) explains. By medians, so that a group that stands out does not inflate it. 0
        if too few units were visited several times.
        """
        divided, parts = self._parts >= MIN_ALIKE, self._parts
        if divided.sum() < LEAST[1]:
            return 0.0
        mean = np.bincount(self._part, values) / self._size
        middle = np.bincount(self._of_part, mean) / parts
        used = divided[self._of_part]
        freedom = np.sqrt(1 - 1 / parts[self._of_part[used]])
        within = MAD_SD * np.median(np.abs(mean - middle[self._of_part])[used] / freedom)
        between = robust_sd(middle[divided]) ** 2 - within**2 * np.mean(1 / parts[divided])
        return float(np.sqrt(np.maximum(between, 0.0)))


@dataclass(frozen=True, eq=False)
class Statistic:
    """A statistic of k groups; NaN if a group is too small.

    Attributes:
        value: (k,) estimate.
        error: (k,) cluster-robust standard error.
    """

    value: np.ndarray
    error: np.ndarray


def medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Compute the median (count,) of values (m,) by group (m,); NaN for an empty group.

    Exact to 2⁻³² of the span of values: group and value are sorted as one integer.
    """
    found = np.full(count, np.nan)
    if not len(values):
        return found
    least = values.min()
    step = max(float(values.max() - least), TINY) / (2**32 - 1)
    key = (group.astype(np.int64) << 32) | np.rint((values - least) / step).astype(np.int64)
    key.sort()
    begin = np.searchsorted(key, np.arange(count + 1, dtype=np.int64) << 32)
    number = np.diff(begin)
    filled = number > 0
    low, high = begin[:-1] + (number - 1) // 2, begin[:-1] + number // 2
    middle = (key[low[filled]] & (2**32 - 1)) + (key[high[filled]] & (2**32 - 1))
    found[filled] = least + 0.5 * step * middle
    return found


def levels(values: np.ndarray, groups: Groups, lasting_sd: float,
           least_scale: float, is_bin: bool = False) -> Statistic:
    """Estimate the level of each group of values (n,): Huber's M-estimate, a step from the median.

    `lasting_sd` is that of the error shared at all times, see `LastingErrors`; `least_scale` bounds
    the scale of a group's values, e.g. by their rounding step; `is_bin`: bins of curves may be
    small.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    middle = medians(x, group, count)
    scale = np.maximum(MAD_SD * medians(np.abs(x - middle[group]), group, count), least_scale)
    deviation = (x - middle[group]) / scale[group]
    inside = np.maximum(np.bincount(group, np.abs(deviation) < HUBER, count), 1.0)
    value = middle + scale * np.bincount(group, np.clip(deviation, -HUBER, HUBER), count) / inside
    influence = np.clip((x - value[group]) / scale[group], -HUBER, HUBER)
    return _with_error(value, scale / inside, influence, groups, lasting_sd, is_bin)


def log_scatters(values: np.ndarray, groups: Groups, lasting_sd: float | None,
                 scale: float) -> Statistic:
    """Estimate the log scatter of each group: log of the mean absolute deviation from its median.

    `lasting_sd` is that of the log scatter between lasting units; None: values are independent.
    `scale` is the usual scatter, the unit of the deviations, which are clipped at `MAX_SCALES`.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    middle = medians(x, group, count)
    deviation = np.minimum(np.abs(x - middle[group]) / scale, MAX_SCALES)
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.maximum(np.bincount(group, deviation, count) / number, 1e-3)
    return _with_error(np.log(mean), 1 / (number * mean), deviation - mean[group], groups,
                       lasting_sd)


def means(values: np.ndarray, groups: Groups, lasting_sd: float) -> Statistic:
    """Estimate the mean of each group, e.g. its share of blank links; arguments as in `levels`.

    The error is at least that of independent values, with the variance of the group or of all
    values, whichever is larger.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.bincount(group, x, count) / number
    found = _with_error(mean, 1 / number, x - mean[group], groups, lasting_sd)
    variance = np.bincount(group, (x - mean[group]) ** 2, count) / number
    least = np.sqrt(np.maximum(variance, np.var(x)) / number)
    return replace(found, error=np.maximum(found.error, least))


def _with_error(value: np.ndarray, step: np.ndarray, influence: np.ndarray, groups: Groups,
                lasting_sd: float | None, is_bin: bool = False) -> Statistic:
    """Add standard errors to a statistic (k,) of groups; both NaN where a group is below `LEAST`.

    A sandwich over passing units, of the influence (m,) of members times `step` (k,), plus the
    error of lasting units in quadrature; `lasting_sd` None: values are independent. Bins have few
    units, so their sandwich is shrunk to the mean ratio over all bins.
    """
    count = groups.count
    number = np.bincount(groups.group, minlength=count)
    filled = np.bincount(groups.passing_unit, minlength=len(groups.of_passing_unit)) > 0
    units = np.bincount(groups.of_passing_unit, filled, count)
    unit_influence = np.bincount(groups.passing_unit, influence, len(groups.of_passing_unit))
    squares = np.bincount(groups.of_passing_unit, unit_influence**2, count)
    sandwich = step * np.sqrt(squares * units / np.maximum(units - 1, 1))
    sizes = np.bincount(groups.lasting_unit, minlength=len(groups.of_lasting_unit)).astype(float)
    effective = np.maximum(
        number**2 / np.maximum(np.bincount(groups.of_lasting_unit, sizes**2, count), 1), 1.0)
    independent = step * np.sqrt(np.bincount(groups.group, influence**2, count))
    least = BIN_LEAST if is_bin else LEAST
    enough = (number >= least[0]) & (units >= least[1]) & (effective >= least[2])
    if is_bin and enough.any():
        ratio = sandwich[enough] / np.maximum(independent[enough], TINY)
        typical = independent * np.sqrt(np.average(ratio**2, weights=units[enough]))
        sandwich = np.sqrt((units * sandwich**2 + PEER_WEIGHT * typical**2) / (units + PEER_WEIGHT))
    error = independent if lasting_sd is None else np.hypot(
        sandwich, lasting_sd / np.sqrt(effective))
    return Statistic(np.where(enough, value, np.nan), np.where(enough, error, np.nan))


def _pairs(group: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign a number to each pair (m,) of group and unit, and list the group of each number."""
    unit_count = np.int64(unit.max(initial=0) + 1)
    pairs, pair = np.unique(group * unit_count + unit, return_inverse=True)
    return pair.ravel(), pairs // unit_count


@dataclass(frozen=True, eq=False)
class PeerComparison:
    """Distance of k groups from their peers.

    Attributes:
        size: (k,) distance from the centre of the peers; NaN if a group is not judged.
        error: (k,) its standard error, including that of the centre.
        spread: (k,) standard deviation between the peers.
        dof: (k,) degrees of freedom of the spread.
    """

    size: np.ndarray
    error: np.ndarray
    spread: np.ndarray
    dof: np.ndarray

    @property
    def score(self) -> np.ndarray:
        """(k,) distance over the root of error² + spread²."""
        return self.size / np.hypot(self.error, self.spread)

    def log_odds(self, outlier_sd: float, prior_odds: float) -> np.ndarray:
        """Compute the log odds (k,) that a group differs from its peers; NaN = not judged.

        Args:
            outlier_sd: scale of the Student t of the distance of a group that differs.
            prior_odds: prior odds that one of all groups differs, divided among the judged groups.
        """
        total, judged = np.hypot(self.error, self.spread), np.isfinite(self.size)
        like_peers = student_t.logpdf(self.size, self.dof, scale=total)
        anywhere = student_t.logpdf(self.size, OUTLIER_DOF, scale=np.hypot(total, outlier_sd))
        return anywhere - like_peers + np.log(prior_odds / max(judged.sum(), 1))


def compare_with_peers(found: Statistic, prior_spread: float, dof: float) -> PeerComparison:
    """Measure how far each group is from the median of its peers, which are all other groups.

    With more than LEAVE_OUT groups, a group is one of its own peers. Their robust spread is shrunk
    to `prior_spread`; `dof` are those of the Student t between peers. NaN for a group without a
    value, or without peers.
    """
    value, error = found.value, found.error
    deviation, total_error = np.full(len(value), np.nan), np.full(len(value), np.nan)
    spread, tails = total_error.copy(), total_error.copy()
    judged = np.flatnonzero(np.isfinite(value))
    if len(judged) < 2:
        return PeerComparison(deviation, total_error, spread, tails)
    values, squares = value[judged], error[judged] ** 2
    if len(judged) <= LEAVE_OUT:
        others = ~np.eye(len(judged), dtype=bool)
        peer_values = np.broadcast_to(values, others.shape)[others].reshape(len(judged), -1)
        peer_squares = np.broadcast_to(squares, others.shape)[others].reshape(len(judged), -1)
    else:
        peer_values, peer_squares = values[None], squares[None]
    peers = peer_values.shape[1]
    centre = np.median(peer_values, axis=1)
    noise = np.maximum(np.median(peer_squares, axis=1), TINY)
    sampled = (MAD_SD * np.median(np.abs(peer_values - centre[:, None]), axis=1)) ** 2
    # Errors are upper bounds: peers may scatter by less than their errors.
    weight = peers - 1.0
    variance = (weight * sampled + PEER_WEIGHT * (prior_spread**2 + noise)) / (weight + PEER_WEIGHT)
    deviation[judged] = values - centre
    total_error[judged] = np.sqrt(squares * np.minimum(variance / noise, 1.0)
                                  + MEDIAN_VARIANCE / peers * variance)
    spread[judged] = np.sqrt(np.maximum(variance - noise, 0.0))
    tails[judged] = 1 / (1 / (weight + PRIOR_DOF) + 1 / dof)  # the spread is not known exactly
    return PeerComparison(deviation, total_error, spread, tails)


def combine_parts(parts: list[PeerComparison]) -> PeerComparison:
    """Average comparisons of the same groups over parts of the data, weighted by 1/variance."""
    if len(parts) == 1:
        return parts[0]
    deviations = np.array([each.size for each in parts])
    known = np.isfinite(deviations)
    variance = np.array([each.error**2 + each.spread**2 for each in parts])
    weight = np.where(known, 1 / np.where(known, variance, 1.0), 0.0)
    total = weight.sum(axis=0)
    share = weight / np.where(total > 0, total, 1.0)
    missing = ~known.any(axis=0)

    def combined(values: list[np.ndarray], power: int) -> np.ndarray:
        filled = np.where(known, np.array(values), 0.0)
        summed = np.sum(share**power * filled**power, axis=0) ** (1 / power)
        return np.where(missing, np.nan, summed)

    deviation = np.where(missing, np.nan, np.sum(share * np.where(known, deviations, 0.0), axis=0))
    return PeerComparison(deviation, combined([each.error for each in parts], 2),
                          combined([each.spread for each in parts], 2),
                          combined([each.dof for each in parts], 1))


def median_polish(values: np.ndarray, labels: list[np.ndarray]) -> np.ndarray:
    """Subtract from values (n,) the medians of the groups of each labelling (n,) in turn."""
    residual = values.copy()
    for _ in range(POLISH_ROUNDS):
        for label in labels:
            residual = residual - medians(residual, label, int(label.max(initial=0)) + 1)[label]
    return residual


def subtract_end_levels(found: Statistic, ends: tuple[np.ndarray, ...]) -> Statistic:
    """Subtract from the statistic of k pairs of ends what each end shows in all of its pairs.

    That is the median of its pairs and one added zero: an end with two pairs has a level only if
    both deviate. Errors grow accordingly. `ends` are the labels (k,) of the first and second ends.
    """
    judged = np.isfinite(found.value)
    value, error = found.value.copy(), found.error.copy()
    labels = [np.unique(end[judged], return_inverse=True)[1].ravel() for end in ends]
    residual = value[judged] - np.median(value[judged])
    for _ in range(POLISH_ROUNDS):
        for end in labels:
            count = int(end.max()) + 1
            residual = residual - medians(np.append(residual, np.zeros(count)),
                                          np.append(end, np.arange(count)), count)[end]
    value[judged] = residual
    error[judged] *= np.sqrt(1 + sum(MEDIAN_VARIANCE / (np.bincount(end)[end] + 1)
                                     for end in labels))
    return Statistic(value, error)


def subtract_unit_errors(values: np.ndarray, label: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Subtract from values (n,) the error that all groups (n,) share in a unit (n,), e.g. a place.

    Two-way fit by medians, levels of groups plus errors of units; the error of a unit is shrunk
    towards 0, and is 0 if only one group was in it.
    """
    cell_of, of_group = _pairs(label, unit)
    unit_count = np.int64(unit.max(initial=0) + 1)
    cell = np.unique(label * unit_count + unit)
    of_unit = np.unique(cell % unit_count, return_inverse=True)[1].ravel()
    middle = medians(values, cell_of, len(cell))
    visits = np.bincount(of_unit)
    shrink = np.where(visits > 1, visits / (visits + 1.0), 0.0)
    shared = np.zeros(len(visits))
    for _ in range(SHARED_ROUNDS):
        level = medians(middle - shared[of_unit], of_group, int(of_group.max(initial=0)) + 1)
        shared = shrink * np.bincount(of_unit, middle - level[of_group]) / visits
    return values - shared[of_unit[cell_of]]
