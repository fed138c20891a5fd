"""What an effect is: something physical that changes levels, found in residuals, fitted, and applied to any link."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from radiotwin.closeloop.folds import evidence_blocks
from radiotwin.closeloop.records import Records

QUANTILE_90 = 1.645
NEPERS = np.log(10) / 10  # of power in a decibel
LEAST_POWER = 1e-290  # of which a logarithm can be taken

Setting = dict[str, Any]
"""Nonlinear parameters of an effect: what JSON can hold. The linear ones are fitted by the regression."""


@dataclass(frozen=True, eq=False)
class Term:
    """What an effect adds to the mean level of n links, for one setting.

    Attributes:
        offset_db: (n,) added as it is.
        columns: (n, q) added times coefficients, which are fitted.
        spread_db: (q,) prior standard deviation of each coefficient.
        names: q names of the coefficients.
        extra: (n, …) what `Effect.bend` needs of each link; None = nothing.
        unsure_db: (n,) standard deviation of what it adds to links of which nothing was learned; None = all are known.
    """

    offset_db: np.ndarray
    columns: np.ndarray
    spread_db: np.ndarray
    names: list[str]
    extra: np.ndarray | None = None
    unsure_db: np.ndarray | None = None

    def select(self, rows: np.ndarray) -> "Term":
        """For the links of a mask or index."""
        return Term(self.offset_db[rows], self.columns[rows], self.spread_db, self.names,
                    None if self.extra is None else self.extra[rows],
                    None if self.unsure_db is None else self.unsure_db[rows])

    @classmethod
    def of_columns(cls, columns: np.ndarray, spread_db: float, names: list[str]) -> "Term":
        """A term that is all linear."""
        return cls(np.zeros(len(columns)), columns, np.full(columns.shape[1], float(spread_db)), names)

    @classmethod
    def of_offset(cls, offset_db: np.ndarray) -> "Term":
        """A term without coefficients."""
        return cls(offset_db, np.zeros((len(offset_db), 0)), np.zeros(0), [])


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter with its 90 % interval."""

    value: float
    low: float
    high: float
    unit: str

    @classmethod
    def normal(cls, value: float, deviation: float, unit: str) -> "Parameter":
        """From an estimate and its standard deviation."""
        return cls(float(value), float(value - QUANTILE_90 * deviation), float(value + QUANTILE_90 * deviation), unit)


@dataclass(frozen=True, eq=False)
class View:
    """What an effect may look at to propose settings: links to learn from, and what the model so far leaves over.

    Attributes:
        records: n links.
        residual_db: (n,) measured minus expected; of blanks, how far they lie at least below what is expected.
        scale_db: (n,) scale of the errors.
        mean_db: (n,) expected level.
        at: expected level [dB] of the base alone for other records, such as devices elsewhere.
        kept: settings of the effects so far, by name.
    """

    records: Records
    residual_db: np.ndarray
    scale_db: np.ndarray
    mean_db: np.ndarray
    at: Callable[..., np.ndarray]
    kept: tuple[tuple[str, Setting], ...] = ()

    def done(self, name: str, what: str) -> list:
        """Values of a field in the settings of the effects of a name that are there already."""
        return [setting[what] for kept, setting in self.kept if kept == name and what in setting]

    @cached_property
    def design_effect(self) -> float:
        """How many links count as one, because links close to each other err alike: the variance of the means of the
        pieces of evidence over what it would be for independent links (Kish 1965, 'Survey sampling', Sec. 5.4)."""
        block = evidence_blocks(self.records)
        z = np.clip(self.residual_db / self.scale_db, -4, 4)
        size = np.bincount(block)
        mean = np.bincount(block, weights=z) / size
        return max(float((size * (mean - z.mean()) ** 2).sum() / max((size > 0).sum(), 1) / max(z.var(), 1e-9)), 1.0)

    @cached_property
    def weight(self) -> np.ndarray:
        """(n,) 1 / variance, less for outliers [1/dB²], divided by the design effect: sums of weighted squares are nats
        that can be believed"""
        z = self.residual_db / self.scale_db
        return 5.0 / (4.0 + z * z) / self.scale_db**2 / self.design_effect

    def nats(self, rows: np.ndarray, change_db: np.ndarray) -> np.ndarray:
        """(r,) how much likelier links `rows` become if their mean changes by (r,) [dB].

        With heavy tails before and after: `weight` knows the old outliers only, and a change makes others. A blank is
        content with any level that is low enough.
        """
        scale_db, blank = self.scale_db[rows], np.isnan(self.records.level_db[rows])
        before = (self.residual_db[rows] / scale_db) ** 2
        rest_db = self.residual_db[rows] - change_db
        after = (np.where(blank, np.minimum(rest_db, 0.0), rest_db) / scale_db) ** 2
        return 2.5 * (np.log1p(before / 4.0) - np.log1p(after / 4.0)) / self.design_effect

    def score(self, term: Term) -> float:
        """How much a term would help: half of the drop of the weighted squares, after its coefficients and a level for
        each class of line of sight are fitted [nats]."""
        weight = self.weight
        target = self.residual_db - term.offset_db
        level = np.column_stack([self.records.los, ~self.records.los]).astype(float)
        before = _weighted_squares(level, np.full(2, np.inf), self.residual_db, weight)
        spread_db = np.concatenate([np.full(2, np.inf), term.spread_db])
        after = _weighted_squares(np.hstack([level, term.columns]), spread_db, target, weight)
        return 0.5 * (before - after)


def _weighted_squares(columns: np.ndarray, spread: np.ndarray, target: np.ndarray, weight: np.ndarray) -> float:
    weighted = columns.T * weight
    precision = 1.0 / np.square(spread) + 1e-9
    moments = weighted @ target
    coefficients = np.linalg.solve(weighted @ columns + np.diag(precision), moments)
    return float(weight @ (target * target) - coefficients @ moments)


class Effect(ABC):
    """One effect of the catalogue.

    Class attributes:
        name: as in `closeloop.json`.
        variant: which of several physical forms of that name.
        nlos_only: acts on links without line of sight only, so those with it need not support it.
        confused_with: names of effects that may look alike.
        repeatable: whether there may be several, each found in a step of its own.
        of_receiver: whether it belongs to a receiver, so that it is no part of a map.
        explains: whether it is a cause, not merely a description of what is left.
        quickly_exact: whether `exact` may be asked of every candidate, not only of what is kept.
        stage: `gain` adds decibels (its `term`); `paths` adds power to that of the base, before any gain; `receiver`
            comes last. The latter two say with `bend` what they do. `detection` leaves levels as they are and says with
            `loses` which links are blank all the same; `limit`, with `limits_db`, below which level they are.
    """

    name: ClassVar[str]
    variant: ClassVar[str] = ""
    nlos_only: ClassVar[bool] = False
    confused_with: ClassVar[tuple[str, ...]] = ()
    repeatable: ClassVar[bool] = False
    stage: ClassVar[str] = "gain"
    of_receiver: ClassVar[bool] = False
    explains: ClassVar[bool] = True
    quickly_exact: ClassVar[bool] = False

    def lacks(self, records: Records) -> str | None:
        """Why the data does not allow this effect to be looked for; None where it does."""
        return None

    @abstractmethod
    def propose(self, view: View) -> list[Setting]:
        """Settings worth trying, best first; empty where nothing looks like this effect."""

    def propose_like(self, view: View, setting: Setting) -> list[Setting]:
        """The same for a part of the data, once all of it has proposed `setting`."""
        return self.propose(view)

    @abstractmethod
    def term(self, records: Records, setting: Setting, at: Callable[..., np.ndarray]) -> Term:
        """What it adds to the mean level of links; `at` asks the base for the mean level of other records, such as with
        devices elsewhere: `at(records)` quickly, `at(records, True)` exactly."""

    def bend(self, level_db: np.ndarray, setting: Setting, extra: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """What it makes of the mean level of links (n,), and the slope of that; for the stages `paths` and
        `receiver`."""
        raise NotImplementedError

    def loses(self, records: Records, setting: Setting) -> np.ndarray:
        """(n,) probability, less than 1, that a link is blank whatever its level; for the stage `detection`."""
        raise NotImplementedError

    def limits_db(self, records: Records, setting: Setting) -> np.ndarray:
        """(n,) level below which a link is blank, -inf where the declared one holds; for the stage `limit`."""
        raise NotImplementedError

    def vary(self, setting: Setting) -> "Variation | None":
        """How the setting may be refined; None where it is fixed."""
        return None

    def exact(self, setting: Setting) -> Setting | None:
        """The same, asking the base for exact levels; None where that makes no difference."""
        return None

    def improbable(self, setting: Setting) -> float:
        """How much less likely a setting is than the likeliest, before anything is measured [nats]."""
        return 0.0

    def unphysical(self, setting: Setting, coefficients: np.ndarray) -> str | None:
        """Why what was fitted cannot be this effect, None where it can."""
        return None

    @abstractmethod
    def parameters(self, records: Records, setting: Setting, found: "Found") -> dict[str, Parameter]:
        """What was found, by name."""


@dataclass(frozen=True, eq=False)
class Found:
    """Numbers of a fitted effect.

    Attributes:
        coefficients: (q,) of its columns.
        covariance: (q, q) of them.
        setting_sides: (2, q) of the numbers of its `vary`: how far below and above them the likelihood has fallen by
            half a nat, if it falls as a parabola on that side; very far where it does not fall.
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    setting_sides: np.ndarray

    @property
    def setting_deviations(self) -> np.ndarray:
        """(q,) standard deviations of the numbers of its `vary`, from the likelihood's fall to both sides"""
        return 1 / np.sqrt((1 / self.setting_sides**2).mean(axis=0))

    @property
    def deviations(self) -> np.ndarray:
        """(q,) standard deviations of the coefficients"""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class Variation:
    """A setting as numbers, to be refined.

    Attributes:
        values: (q,) now.
        steps: (q,) typical uncertainty of each.
        low, high: (q,) bounds.
        setting: numbers -> setting.
        members: indices of numbers that belong together and act on links of their own, such as those of one device;
            each is refined by itself. None: all numbers act on the same links.
    """

    values: np.ndarray
    steps: np.ndarray
    low: np.ndarray
    high: np.ndarray
    setting: Callable[[np.ndarray], Setting]
    members: list[np.ndarray] | None = None


class Remembered:
    """What was worked out of some links, for as long as they are in use."""

    def __init__(self):
        self._known: WeakKeyDictionary[Records, dict] = WeakKeyDictionary()

    def of(self, records: Records, key, work_out: Callable[[], Any]) -> Any:
        """What `work_out` gives, asked once for these links and this key."""
        known = self._known.setdefault(records, {})
        if key not in known:
            known[key] = work_out()
        return known[key]


def some(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the rows (n,), in order, at random and always the same: links of devices, receivers and slots
    take turns in a file, and every k-th would be those of a few."""
    if len(rows) <= most:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, most, replace=False))


def one_hot(index: np.ndarray, members: list[int]) -> np.ndarray:
    """(n, len(members)) 1 where the index is the member's."""
    return (index[:, None] == np.asarray(members)[None]).astype(float)


def measured(index: np.ndarray, least: int) -> list[int]:
    """Values of an index that stand there at least that often."""
    values, counts = np.unique(index, return_counts=True)
    return [int(value) for value, count in zip(values, counts) if count >= least]
