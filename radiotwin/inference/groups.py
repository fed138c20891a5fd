"""Groups of values that stand out from their peers.

A group is any set of values, and groups may overlap. Each has a statistic with a standard error, in
which values of one unit (neighbours, which err alike) count as one. Its peers are the other groups
of the same kind. Their own spread is estimated robustly, and with few peers it is shrunk to a
prior. Whether a group is one of its peers is judged by two hypotheses (Efron 2008,
'Microarrays, empirical Bayes and the two-groups model', Statist. Sci. 23): it is as far from them
as Student's t with that spread allows, or it may be anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student_t

from radiotwin.inference.gaussian import MAD_SD, robust_sd

LEAST = 12, 4, 3.0  # values, passing and lasting units of a group, to be judged
BIN_LEAST = 5, 2, 1.0  # of a bin of a curve
HUBER = 1.345  # scales, beyond which a value pulls no further (95 % efficient for normal errors)
MAX_SCALES = 6.0  # a single value counts as this far away at most
LEAVE_OUT = 64  # groups up to which each is left out of its own peers
PEER_WEIGHT = 4.0  # peers that the prior spread counts as
PRIOR_DOF = 60.0  # of that prior
MIN_ALIKE = 3  # values of a unit, to tell how much units differ
OUTLIER_DOF = 2.0  # of sizes of what stands out: heavy tails
POLISH_ROUNDS, SHARED_ROUNDS = 3, 10
TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Units:
    """Which of n values err alike.

    Attributes:
        passing: unit (n,) of values whose errors are alike at one time.
        lasting: unit (n,) of values whose errors are alike at all times; there are few large ones.
    """

    passing: np.ndarray
    lasting: np.ndarray


@dataclass(frozen=True, eq=False)
class Groups:
    """Members of groups, which may overlap.

    Attributes:
        row: (m,) value of each membership.
        group: (m,) group of each membership.
        count: number of groups k.
        passing, lasting: (m,) number of each membership's pair of group and unit.
        of_passing, of_lasting: group of each such pair.
    """

    row: np.ndarray
    group: np.ndarray
    count: int
    passing: np.ndarray
    of_passing: np.ndarray
    lasting: np.ndarray
    of_lasting: np.ndarray

    @classmethod
    def of_members(cls, row: np.ndarray, group: np.ndarray, count: int, units: Units) -> Groups:
        """Return groups (m,) of rows (m,), some of which may be in several."""
        return cls(row, group, count, *_pairs(group, units.passing[row]),
                   *_pairs(group, units.lasting[row]))

    @classmethod
    def of_labels(cls, label: np.ndarray, units: Units) -> Groups:
        """Return the groups of equal labels (n,); negative labels are in none."""
        row = np.flatnonzero(label >= 0)
        return cls.of_members(row, label[row], int(label.max(initial=-1)) + 1, units)

    def among(self, rows: np.ndarray) -> Groups:
        """Return the groups with members from a mask (n,) only."""
        kept = rows[self.row]
        return replace(self, row=self.row[kept], group=self.group[kept],
                       passing=self.passing[kept], lasting=self.lasting[kept])

    def members(self, group: int, n: int) -> np.ndarray:
        """Return the mask (n,) of a group's members."""
        rows = np.zeros(n, dtype=bool)
        rows[self.row[self.group == group]] = True
        return rows


class Nested:
    """Passing units within lasting ones, of some rows: how much of their errors lasts."""

    def __init__(self, units: Units, rows: np.ndarray) -> None:
        lasting = np.unique(units.lasting[rows], return_inverse=True)[1].ravel()
        self._part, self._of_part = _pairs(lasting, units.passing[rows])
        self._size = np.bincount(self._part)
        self._parts = np.bincount(self._of_part)
        self._several = self._parts >= MIN_ALIKE

    def error(self, values: np.ndarray) -> float:
        """Return the standard deviation of lasting units, of the rows' values (r,).

        Analysis of variance: the part that lasts is what the units' means differ by beyond what
        their passing parts explain. Robust, as groups that stand out must not hide themselves.
        """
        several, parts = self._several, self._parts
        if several.sum() < LEAST[1]:
            return 0.0
        mean = np.bincount(self._part, values) / self._size
        middle = np.bincount(self._of_part, mean) / parts
        own = several[self._of_part]
        freedom = np.sqrt(1 - 1 / parts[self._of_part[own]])
        within = MAD_SD * np.median(np.abs(mean - middle[self._of_part])[own] / freedom)
        between = robust_sd(middle[several]) ** 2 - within**2 * np.mean(1 / parts[several])
        return float(np.sqrt(np.maximum(between, 0.0)))


@dataclass(frozen=True, eq=False)
class Statistic:
    """A statistic of each of k groups; NaN where a group is too small.

    Attributes:
        value: (k,).
        error: (k,) its standard error, units counted once.
    """

    value: np.ndarray
    error: np.ndarray


def medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return the median (count,) of the values (m,) of each group (m,); NaN of an empty one.

    Exact to the span of the values over 2³²: group and value are sorted as one integer, which is
    ten times as fast as sorting by both.
    """
    found = np.full(count, np.nan)
    if not len(values):
        return found
    least = values.min()
    step = max(float(values.max() - least), TINY) / (2**32 - 1)
    key = (group.astype(np.int64) << 32) | np.rint((values - least) / step).astype(np.int64)
    key.sort()
    begin = np.searchsorted(key, np.arange(count + 1, dtype=np.int64) << 32)
    size = np.diff(begin)
    some = size > 0
    low, high = begin[:-1] + (size - 1) // 2, begin[:-1] + size // 2
    middle = (key[low[some]] & (2**32 - 1)) + (key[high[some]] & (2**32 - 1))
    found[some] = least + 0.5 * step * middle
    return found


def levels(values: np.ndarray, groups: Groups, lasting_sd: float,
           least_scale: float, is_bin: bool = False) -> Statistic:
    """Return the level of each group: Huber's estimate, one step from the median.

    Args:
        values: (n,) without NaN among the members.
        groups: of them.
        lasting_sd: standard deviation of lasting units.
        least_scale: of a group's values, such as the step that they are rounded to.
        is_bin: whether groups are bins of curves, which may be small, as they are judged together.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    middle = medians(x, group, count)
    scale = np.maximum(MAD_SD * medians(np.abs(x - middle[group]), group, count), least_scale)
    deviation = (x - middle[group]) / scale[group]
    inside = np.maximum(np.bincount(group, np.abs(deviation) < HUBER, count), 1.0)
    value = middle + scale * np.bincount(group, np.clip(deviation, -HUBER, HUBER), count) / inside
    pull = np.clip((x - value[group]) / scale[group], -HUBER, HUBER)
    return _judged(value, scale / inside, pull, groups, lasting_sd, is_bin)


def log_scatters(values: np.ndarray, groups: Groups, lasting_sd: float | None,
                 scale: float) -> Statistic:
    """Return the logarithm of each group's mean absolute deviation from its own median.

    Args:
        values: (n,) without NaN among the members.
        groups: of them.
        lasting_sd: as of `levels`, of the logarithm; None: values are independent.
        scale: usual one, of which a value counts `MAX_SCALES` at most.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    middle = medians(x, group, count)
    size = np.minimum(np.abs(x - middle[group]) / scale, MAX_SCALES)
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.maximum(np.bincount(group, size, count) / number, 1e-3)
    return _judged(np.log(mean), 1 / (number * mean), size - mean[group], groups, lasting_sd)


def means(values: np.ndarray, groups: Groups, lasting_sd: float) -> Statistic:
    """Return the mean of each group, such as a share; arguments as of `levels`.

    Values are taken as at least as uncertain as if they were independent, with the variance of
    their group, or of all values where that is larger.
    """
    x, group, count = values[groups.row], groups.group, groups.count
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.bincount(group, x, count) / number
    found = _judged(mean, 1 / number, x - mean[group], groups, lasting_sd)
    variance = np.bincount(group, (x - mean[group]) ** 2, count) / number
    least = np.sqrt(np.maximum(variance, np.var(x)) / number)
    return replace(found, error=np.maximum(found.error, least))


def _judged(value: np.ndarray, step: np.ndarray, pull: np.ndarray, groups: Groups,
            lasting_sd: float | None, is_bin: bool = False) -> Statistic:
    """Return a statistic with its error.

    That of passing units is a sandwich, whose influences are `pull` (m,) times `step`. What lasts
    in lasting units is added. Without it each value is a unit. Bins have few units, so that
    their sandwich is shrunk to what all groups have.
    """
    count = groups.count
    number = np.bincount(groups.group, minlength=count)
    filled = np.bincount(groups.passing, minlength=len(groups.of_passing)) > 0
    several = np.bincount(groups.of_passing, filled, count)
    pulls = np.bincount(groups.passing, pull, len(groups.of_passing))
    squares = np.bincount(groups.of_passing, pulls**2, count)
    sandwich = step * np.sqrt(squares * several / np.maximum(several - 1, 1))
    share = np.bincount(groups.lasting, minlength=len(groups.of_lasting)).astype(float)
    effective = np.maximum(
        number**2 / np.maximum(np.bincount(groups.of_lasting, share**2, count), 1), 1.0)
    independent = step * np.sqrt(np.bincount(groups.group, pull**2, count))
    least = BIN_LEAST if is_bin else LEAST
    enough = (number >= least[0]) & (several >= least[1]) & (effective >= least[2])
    if is_bin and enough.any():
        ratio = sandwich[enough] / np.maximum(independent[enough], TINY)
        usual = independent * np.sqrt(np.average(ratio**2, weights=several[enough]))
        sandwich = np.sqrt((several * sandwich**2 + PEER_WEIGHT * usual**2)
                           / (several + PEER_WEIGHT))
    error = independent if lasting_sd is None else np.hypot(
        sandwich, lasting_sd / np.sqrt(effective))
    return Statistic(np.where(enough, value, np.nan), np.where(enough, error, np.nan))


def _pairs(group: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pair (m,) of each group (m,) and unit (m,), and the group of each pair."""
    size = np.int64(unit.max(initial=0) + 1)
    pairs, pair = np.unique(group * size + unit, return_inverse=True)
    return pair.ravel(), pairs // size


@dataclass(frozen=True, eq=False)
class Apart:
    """How far k groups are from their peers.

    Attributes:
        size: (k,) distance from the peers' centre; NaN where a group is not judged.
        error: (k,) its standard error, the centre's included.
        spread: (k,) standard deviation of the peers themselves.
        dof: (k,) degrees of freedom of the spread.
    """

    size: np.ndarray
    error: np.ndarray
    spread: np.ndarray
    dof: np.ndarray

    @property
    def score(self) -> np.ndarray:
        """(k,) distance over error and spread together."""
        return self.size / np.hypot(self.error, self.spread)

    def log_odds(self, outlier_sd: float, prior_odds: float) -> np.ndarray:
        """Return the log odds (k,) that a group is not one of its peers; NaN = not judged.

        Args:
            outlier_sd: scale of the sizes of what stands out, Student's t around 0.
            prior_odds: that one group of all k stands out, shared among those that are judged.
        """
        total, judged = np.hypot(self.error, self.spread), np.isfinite(self.size)
        like_peers = student_t.logpdf(self.size, self.dof, scale=total)
        anywhere = student_t.logpdf(self.size, OUTLIER_DOF, scale=np.hypot(total, outlier_sd))
        return anywhere - like_peers + np.log(prior_odds / max(judged.sum(), 1))


def apart(found: Statistic, prior_spread: float, dof: float) -> Apart:
    """Return how far each group is from its peers, whose spread is shrunk to a prior.

    Args:
        found: statistic of each group.
        prior_spread: standard deviation of peers.
        dof: degrees of freedom of peers' distribution, Student's t.
    """
    value, error = found.value, found.error
    size, total = np.full(len(value), np.nan), np.full(len(value), np.nan)
    spread, tails = total.copy(), total.copy()
    judged = np.flatnonzero(np.isfinite(value))
    if len(judged) < 2:
        return Apart(size, total, spread, tails)
    own, squares = value[judged], error[judged] ** 2
    if len(judged) <= LEAVE_OUT:
        others = ~np.eye(len(judged), dtype=bool)
        own_peers = np.broadcast_to(own, others.shape)[others].reshape(len(judged), -1)
        of_peers = np.broadcast_to(squares, others.shape)[others].reshape(len(judged), -1)
    else:
        own_peers, of_peers = own[None], squares[None]
    peers = own_peers.shape[1]
    centre = np.median(own_peers, axis=1)
    noise = np.maximum(np.median(of_peers, axis=1), TINY)
    seen = (MAD_SD * np.median(np.abs(own_peers - centre[:, None]), axis=1)) ** 2
    # Peers may be closer together than their errors say, which are of the worst case.
    weight = peers - 1.0
    usual = (weight * seen + PEER_WEIGHT * (prior_spread**2 + noise)) / (weight + PEER_WEIGHT)
    size[judged] = own - centre
    total[judged] = np.sqrt(squares * np.minimum(usual / noise, 1.0) + 1.57 / peers * usual)
    spread[judged] = np.sqrt(np.maximum(usual - noise, 0.0))
    tails[judged] = 1 / (1 / (weight + PRIOR_DOF) + 1 / dof)  # the spread is not known exactly
    return Apart(size, total, spread, tails)


def together(parts: list[Apart]) -> Apart:
    """Return distances of the same groups in several parts of the data, weighted by precision."""
    if len(parts) == 1:
        return parts[0]
    sizes = np.array([each.size for each in parts])
    known = np.isfinite(sizes)
    variance = np.array([each.error**2 + each.spread**2 for each in parts])
    weight = np.where(known, 1 / np.where(known, variance, 1.0), 0.0)
    total = weight.sum(axis=0)
    share = weight / np.where(total > 0, total, 1.0)
    missing = ~known.any(axis=0)

    def joined(values: list[np.ndarray], power: int) -> np.ndarray:
        filled = np.where(known, np.array(values), 0.0)
        summed = np.sum(share**power * filled**power, axis=0) ** (1 / power)
        return np.where(missing, np.nan, summed)

    size = np.where(missing, np.nan, np.sum(share * np.where(known, sizes, 0.0), axis=0))
    return Apart(size, joined([each.error for each in parts], 2),
                 joined([each.spread for each in parts], 2),
                 joined([each.dof for each in parts], 1))


def polished(values: np.ndarray, labels: list[np.ndarray]) -> np.ndarray:
    """Return values (n,) less the medians of each label's groups in turn: a median polish."""
    left = values.copy()
    for _ in range(POLISH_ROUNDS):
        for label in labels:
            left = left - medians(left, label, int(label.max(initial=0)) + 1)[label]
    return left


def less_ends(found: Statistic, ends: tuple[np.ndarray, ...]) -> Statistic:
    """Return a statistic of k pairs less the levels of both ends (k,).

    These have families of their own. An end's level is the median of its pairs and a zero: of two
    pairs of which one is off, the end is not; where both are, it is.
    """
    judged = np.isfinite(found.value)
    value, error = found.value.copy(), found.error.copy()
    own = [np.unique(end[judged], return_inverse=True)[1].ravel() for end in ends]
    left = value[judged] - np.median(value[judged])
    for _ in range(POLISH_ROUNDS):
        for end in own:
            count = int(end.max()) + 1
            left = left - medians(np.append(left, np.zeros(count)),
                                  np.append(end, np.arange(count)), count)[end]
    value[judged] = left
    error[judged] *= np.sqrt(1 + sum(1.57 / (np.bincount(end)[end] + 1) for end in own))
    return Statistic(value, error)


def without_shared(values: np.ndarray, label: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return values (n,) less what several groups share in a unit.

    A unit that several groups have been to shows how far they differ where all else is equal. Its
    own error is estimated beside the groups' levels, by medians in turn, and shrunk to 0.

    Args:
        values: n values.
        label: group (n,) of each.
        unit: (n,) within which errors last.
    """
    cell_of, of_group = _pairs(label, unit)
    size = np.int64(unit.max(initial=0) + 1)
    cell = np.unique(label * size + unit)
    of_unit = np.unique(cell % size, return_inverse=True)[1].ravel()
    middle = medians(values, cell_of, len(cell))
    visits = np.bincount(of_unit)
    shrink = np.where(visits > 1, visits / (visits + 1.0), 0.0)
    shared = np.zeros(len(visits))
    for _ in range(SHARED_ROUNDS):
        level = medians(middle - shared[of_unit], of_group, int(of_group.max(initial=0)) + 1)
        shared = shrink * np.bincount(of_unit, middle - level[of_group]) / visits
    return values - shared[of_unit[cell_of]]
