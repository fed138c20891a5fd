"""The base and the effects that were found so far, as one regression on one set of training links."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from radiotwin.closeloop import regression
from radiotwin.closeloop.bases import ANY_LEVEL_DB, FittedBase
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Expected, Problem, Solution, covariance, expect, nll, residual_db, solve
from radiotwin.effects.base import Effect, Found, Setting, Term, Variation, View, some

TRIALS = 25  # for each number of a setting, while it is refined
DESCENTS = 2  # a simplex that has collapsed too early starts anew
REFINED_ON = 5000  # links at most
MEMBER_REFINED_ON = 1500  # of each member
MOST_FITS = 2  # of proposals of one effect
WORTH_REFINING_NATS = 5.0
LEAST_RISE_NATS = 1e-3
EXTREMES_DB = (-200.0, 100.0)  # levels at which whatever a receiver does to them shows


@dataclass(frozen=True, eq=False)
class Part:
    """An effect with its setting, and what it adds to all links of a side."""

    effect: Effect
    setting: Setting
    term: Term


@dataclass(frozen=True, eq=False)
class Side:
    """All links, of which some are learned from: one fold, or the whole.

    Attributes:
        records: n links, with the devices where the base has them.
        train: (n,) bool, links that are learned from.
        usable: (n,) bool, links to devices that the base has a position for.
        base: fitted to the training links.
        base_db: (n,) its expected level.
        base_columns, base_spread: see `FittedBase.columns`.
        group: (n,) index of the error scale.
        dof: degrees of freedom of the errors.
        parts: effects so far.
    """

    records: Records
    train: np.ndarray
    usable: np.ndarray
    base: FittedBase
    base_db: np.ndarray
    base_columns: np.ndarray
    base_spread: np.ndarray
    group: np.ndarray
    dof: float
    parts: list[Part] = field(default_factory=list)

    @classmethod
    def make(cls, records: Records, train: np.ndarray, base: FittedBase, dof: float) -> "Side":
        """Without effects."""
        located = np.isfinite(base.device_m).all(axis=1)
        usable = located[records.device]
        # A stand-in for devices that are nowhere, whose links are not looked at.
        placed = records.with_devices(np.where(np.isfinite(base.device_m), base.device_m, 0.0))
        columns, spread = base.columns(placed)
        return cls(placed, train & usable, usable, base, base.mean_db(placed), columns, spread, base.group(placed), dof)

    def part(self, effect: Effect, setting: Setting) -> Part:
        """An effect for these links."""
        return Part(effect, setting, effect.term(self.records, setting, self.base.shifted_db))

    def with_parts(self, parts: list[Part]) -> "Side":
        """The same with other effects."""
        return replace(self, parts=parts)

    def problem(self, rows: np.ndarray | slice) -> Problem:
        """The regression on links of a mask or index."""
        records, parts = self.records, self.parts
        terms = [part.term for part in parts]
        mine = records.select(rows) if any(part.effect.stage == "detection" for part in parts) else None
        return Problem(
            records.level_db[rows], self.limit_db[rows],
            self.base_db[rows], self.base_columns[rows], _bend(parts, "paths", rows),
            sum((term.offset_db[rows] for term in terms), np.zeros(len(self.base_db[rows]))),
            regression.design([term.columns[rows] for term in terms], len(self.base_db[rows])),
            np.concatenate([self.base_spread, *(term.spread_db for term in terms)]), self.group[rows],
            _bend(parts, "receiver", rows), self.dof, _lost(parts, mine), _unsure_db(parts, rows))

    @cached_property
    def training(self) -> Problem:
        """The regression on the training links."""
        return self.problem(self.train)

    @cached_property
    def limit_db(self) -> np.ndarray:
        """(n,) level below which a link is blank; -inf where none is known"""
        limit_db = np.full(len(self.records), -np.inf if self.records.limit_db is None else self.records.limit_db)
        for part in self.parts:
            if part.effect.stage == "limit":
                limit_db = np.maximum(limit_db, part.effect.limits_db(self.records, part.setting))
        return limit_db

    def fit(self, start: Solution | None = None) -> Solution:
        """Fit to the training links."""
        return solve(self.training, start)

    def expect(self, solution: Solution) -> Expected:
        """What is expected of all links."""
        return expect(self.problem(slice(None)), solution)

    def view(self, solution: Solution) -> View:
        """The training links as an effect sees them."""
        expected = expect(self.training, solution)
        return View(self.records.select(self.train), residual_db(self.training, solution), expected.scale_db,
                    expected.mean_db, self.base.shifted_db,
                    tuple((part.effect.name, part.setting) for part in self.parts))

    @property
    def places(self) -> list[slice]:
        """Of each part: where its coefficients stand among all."""
        ends = np.cumsum([self.base_columns.shape[1], *(part.term.columns.shape[1] for part in self.parts)]).tolist()
        return [slice(first, end) for first, end in zip(ends, ends[1:])]

    def found(self, solution: Solution) -> list[Found]:
        """Of each part: what was fitted, and how surely, in view of how many links count as one."""
        design_effect = self.view(solution).design_effect
        spread = design_effect * covariance(self.training, solution)
        return [Found(solution.coefficients[place], spread[place, place],
                      np.sqrt(design_effect) * self._setting_sides(number, solution))
                for number, place in enumerate(self.places)]

    def _setting_sides(self, number: int, solution: Solution) -> np.ndarray:
        """(2, q) how far below and above each number of a setting the likelihood, all coefficients fitted again, has
        fallen by half a nat if it falls as a parabola on that side."""
        part = self.parts[number]
        variation = part.effect.vary(part.setting)
        if variation is None:
            return np.zeros((2, 0))
        sides = np.empty((2, len(variation.values)))

        def objective(numbers: np.ndarray) -> float:
            parts = list(self.parts)
            parts[number] = self.part(part.effect, variation.setting(numbers))
            return self.with_parts(parts).fit(solution).objective

        best = objective(variation.values)
        for i, step in enumerate(variation.steps):
            for row, sign in enumerate((-1.0, 1.0)):
                numbers = variation.values.copy()
                numbers[i] = np.clip(numbers[i] + sign * step, variation.low[i], variation.high[i])
                sides[row, i] = step / np.sqrt(2 * max(objective(numbers) - best, LEAST_RISE_NATS))
        return sides


def _bend(parts: list[Part], stage: str, rows: np.ndarray | slice) -> Callable | None:
    """What all parts of a stage do to the level, one after the other; None where there is none."""
    parts = [part for part in parts if part.effect.stage == stage]
    if not parts:
        return None
    extras = [None if part.term.extra is None else part.term.extra[rows] for part in parts]

    def bend(level_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.ones_like(level_db)
        for part, extra in zip(parts, extras):
            level_db, own = part.effect.bend(level_db, part.setting, extra)
            slope = slope * own
        return level_db, slope
    return bend


def _lost(parts: list[Part], records: Records | None) -> np.ndarray | float:
    """(n,) probability that a link is lost to any of the parts; 0 where there is none that loses links."""
    kept: np.ndarray | float = 1.0
    for part in parts:
        if part.effect.stage == "detection":
            assert records is not None
            kept = kept * (1.0 - part.effect.loses(records, part.setting))
    return 1.0 - kept


def _unsure_db(parts: list[Part], rows: np.ndarray | slice) -> np.ndarray | float:
    """(n,) standard deviation of what the parts add to links of which nothing was learned; 0 where there is none."""
    return np.sqrt(sum(part.term.unsure_db[rows] ** 2 for part in parts if part.term.unsure_db is not None))


def add(side: Side, effect: Effect, solution: Solution, like: Setting | None = None) -> tuple[Side, Solution] | None:
    """Find the best setting of an effect on the training links of a side, beside the effects that it has.

    Args:
        side, effect: what is learned from, and what is added.
        solution: the fit without it.
        like: what was found on all links, where the side is a fold.

    Returns:
        the side with the effect, and its fit; None where nothing in the residual looks like the effect
    """
    view = side.view(solution)
    parts = [side.part(effect, setting) for setting in
             (effect.propose(view) if like is None else effect.propose_like(view, like))]
    if effect.stage == "gain" and len(parts) > MOST_FITS:  # the others do not say what they add to a residual
        parts = sorted(parts, key=lambda part: -view.score(part.term.select(side.train)))[:MOST_FITS]
    best = None
    for part in parts:
        tried = side.with_parts([*side.parts, part])
        fitted = tried.fit(solution)
        if best is None or fitted.objective < best[1].objective:
            best = tried, fitted
    if best is None or solution.objective - best[1].objective < WORTH_REFINING_NATS:
        return best
    refined = _refine(*best)
    return exactly(*refined) if effect.quickly_exact else refined


def exactly(side: Side, fitted: Solution) -> tuple[Side, Solution]:
    """The same effects, where the base can say exactly what they do, and that is better."""
    if not side.base.follows_paths:
        return side, fitted
    for number, part in enumerate(side.parts):
        setting = part.effect.exact(part.setting)
        if setting is None or setting == part.setting:
            continue
        other = side.with_parts([*side.parts[:number], side.part(part.effect, setting), *side.parts[number + 1:]])
        solution = other.fit(fitted)
        if solution.objective < fitted.objective:
            side, fitted = other, solution
    return side, fitted


def _refine(side: Side, fitted: Solution) -> tuple[Side, Solution]:
    """Vary the last effect's setting (Nelder and Mead 1965) for a better fit to the training links."""
    part = side.parts[-1]
    variation = part.effect.vary(part.setting)
    if variation is None or not len(variation.values):
        return side, fitted
    if variation.members is not None:
        return _refine_members(side, fitted, part, variation)
    rows = some(np.flatnonzero(side.train), REFINED_ON)
    design_effect = side.view(fitted).design_effect * len(rows) / max(side.train.sum(), 1)
    part_records = side.records.select(rows)
    small = replace(
        side, records=part_records, train=np.ones(len(rows), bool), usable=np.ones(len(rows), bool),
        base_db=side.base_db[rows], base_columns=side.base_columns[rows], group=side.group[rows],
        parts=[replace(p, term=p.term.select(rows)) for p in side.parts[:-1]])
    rest = small.problem(slice(None))
    # What has no coefficients of its own moves those of the others little: they stay while it is refined.
    alone = part.effect.stage == "gain" and not len(part.term.spread_db)

    latest = fitted

    def objective(numbers: np.ndarray) -> float:
        nonlocal latest
        inside = np.clip(numbers, variation.low, variation.high)
        setting = variation.setting(inside)
        tried = small.part(part.effect, setting)
        if alone:
            misfit = nll(replace(rest, gain_db=rest.gain_db + tried.term.offset_db), fitted).sum()
        else:
            latest = small.with_parts([*small.parts, tried]).fit(latest)
            misfit = latest.objective
        outside = np.abs((numbers - inside) / variation.steps).sum()
        return float(misfit + design_effect * part.effect.improbable(setting) + 10.0 * outside)

    numbers = variation.values
    for _ in range(DESCENTS):
        numbers = _descend(objective, numbers, variation.steps)
    return _better(side, fitted, part, variation, numbers)


def _refine_members(side: Side, fitted: Solution, part: Part, variation: Variation) -> tuple[Side, Solution]:
    """Vary the numbers of each member by themselves, on links of its own; a level of its own is all that is fitted
    beside them."""
    numbers, at_receiver = variation.values.copy(), part.effect.stage == "receiver"
    arriving_db = side.problem(slice(None)).arriving(fitted.coefficients)[0] - part.term.offset_db

    def changed(records: Records, numbers: np.ndarray) -> Part:
        setting = variation.setting(np.clip(numbers, variation.low, variation.high))
        return Part(part.effect, setting, part.effect.term(records, setting, side.base.shifted_db))

    def done_db(records: Records, numbers: np.ndarray) -> np.ndarray:
        there = changed(records, numbers)
        if not at_receiver:
            return there.term.offset_db
        return sum((part.effect.bend(np.full(len(records), level_db), there.setting, there.term.extra)[0]
                    for level_db in EXTREMES_DB), start=np.zeros(len(records)))

    every = np.flatnonzero(side.train)
    trained = side.records.select(every)
    for member in variation.members or ():
        moved = numbers.copy()
        moved[member] += variation.steps[member]
        rows = some(every[done_db(trained, moved) != done_db(trained, numbers)], MEMBER_REFINED_ON)
        if not len(rows):
            continue
        latest = None
        mine, others = side.records.select(rows), [replace(p, term=p.term.select(rows)) for p in side.parts[:-1]]
        alone = replace(side.with_parts([]).problem(rows), law_columns=np.ones((len(rows), 1)),
                        spread_db=np.full(1, ANY_LEVEL_DB))

        def objective(values: np.ndarray) -> float:
            nonlocal latest
            tried, inside = numbers.copy(), np.clip(values, variation.low[member], variation.high[member])
            tried[member] = inside
            there = changed(mine, tried)
            receiver = _bend([*others, there], "receiver", slice(None))
            outside = np.abs((values - inside) / variation.steps[member]).sum()
            latest = solve(replace(alone, law_db=arriving_db[rows] + there.term.offset_db, receiver=receiver), latest)
            return latest.objective + 10.0 * outside

        numbers[member] = _descend(objective, numbers[member], variation.steps[member])
    return _better(side, fitted, part, variation, numbers)


def _descend(objective: Callable[[np.ndarray], float], values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    if len(values) == 1:
        around = (values[0] - steps[0], values[0] + steps[0])
        return minimize_scalar(lambda value: objective(np.array([value])), around, method="brent",
                               options={"xtol": 1e-3, "maxiter": TRIALS}).x[None]
    simplex = np.vstack([values, values + np.diag(steps)])
    options = {"initial_simplex": simplex, "maxfev": TRIALS * len(simplex), "xatol": 1e-2, "fatol": 0.1}
    return minimize(objective, values, method="Nelder-Mead", options=options).x


def _better(side: Side, fitted: Solution, part: Part, variation: Variation,
            numbers: np.ndarray) -> tuple[Side, Solution]:
    """The side with the last effect's numbers changed, where that is better."""
    setting = variation.setting(np.clip(numbers, variation.low, variation.high))
    better = side.with_parts([*side.parts[:-1], side.part(part.effect, setting)])
    solution = better.fit(fitted)
    gain = fitted.objective - solution.objective + side.view(fitted).design_effect * (
        part.effect.improbable(part.setting) - part.effect.improbable(setting))
    return (better, solution) if gain > 0 else (side, fitted)
