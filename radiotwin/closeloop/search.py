"""Which effects the data supports: fitted on training folds, judged on held-out ones, kept one after the other."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from radiotwin.closeloop.bases import Base, FittedBase
from radiotwin.closeloop.folds import Folds, evidence_blocks
from radiotwin.closeloop.model import Side, add, exactly
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Solution, detected_db, nll_at
from radiotwin.closeloop.shadowing import NAME as SHADOWING
from radiotwin.closeloop.shadowing import Shadowing
from radiotwin.closeloop.significance import gain_p, sign_flip_p
from radiotwin.effects.base import Effect
from radiotwin.effects.position_errors import site_of

DOFS = (3.0, 5.0, 10.0, 30.0)
LEAST_GAIN_NATS = 25.0
LEAST_GAIN_PER_LINK = 0.01  # nats; 0.02 is what an RMSE lower by 2 % gains
MOST_OF_RMSE = 0.98  # or what is left of it
LEAST_FOLDS = 0.6  # of the folds must gain
SIGNIFICANCE = 0.01
CONSISTENT = 0.1
SUPPORTED = 0.1
CLEARLY_NATS = np.log(100.0)  # how much likelier the data must be than with another effect, to tell it from that one
MOST_EFFECTS = 12
MOST_OF_A_KIND = 4  # in one step
WORTH_A_LOOK_NATS = 10.0


@dataclass(frozen=True, eq=False)
class Judged:
    """One step of the search: a candidate and what the held-out links say of it.

    Attributes:
        name: of the effect.
        kept: whether it was added.
        reason: why not, in words; empty where it was.
        nll_gain: held-out likelihood gained [nats]; NaN where it was not tried.
        rmse_db: held-out RMSE with it.
        p_value: of no gain, links that err alike counted as one, corrected for the number of candidates.
        step: number of effects that were there before.
        gain_by_fold: (folds,) `nll_gain` of each fold over the number of links that count as one; empty where it was
            not tried.
    """

    name: str
    kept: bool
    reason: str
    nll_gain: float
    rmse_db: float
    p_value: float
    step: int
    gain_by_fold: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(eq=False)
class Model:
    """The whole and the folds, side by side.

    Attributes:
        whole: learned from all links.
        folds: learned from all but one fold each.
        fits: the whole's solution, then the folds'.
        index: (n,) fold of each link.
        shadowing: the whole's, then the folds', of what all effects leave over; empty where there is none.
    """

    whole: Side
    folds: list[Side]
    fits: list[Solution]
    index: np.ndarray
    shadowing: list[Shadowing] = field(default_factory=list)

    @property
    def sides(self) -> list[Side]:
        return [self.whole, *self.folds]

    def held_out(self, of: Callable[[Side, Solution], np.ndarray]) -> np.ndarray:
        """(n,) a value per link from the fold that did not see it."""
        result = np.full(len(self.index), np.nan)
        for number, side in enumerate(self.folds):
            mine = self.index == number
            result[mine] = of(side, self.fits[number + 1])[mine]
        return result

    @cached_property
    def held_out_shadowing(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) what shadowing adds [error scales], and (n,) the factor that it leaves of the error scale."""
        shift, left = np.zeros(len(self.index)), np.ones(len(self.index))
        for number, shadowing in enumerate(self.shadowing[1:]):
            mine = np.flatnonzero(self.index == number)
            shift[mine], left[mine] = shadowing.at(self.folds[number].records.select(mine))
        return shift, left

    @cached_property
    def held_out_expected(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) expected reading [dB], and (n,) its error scale [dB], with shadowing; NaN where there is none."""
        mean_db, scale_db = np.full((2, len(self.index)), np.nan)
        for number, (side, fit) in enumerate(zip(self.folds, self.fits[1:])):
            mine, expected = self.index == number, side.expect(fit)
            mean_db[mine], scale_db[mine] = expected.mean_db[mine], expected.scale_db[mine]
        shift, left = self.held_out_shadowing
        return mean_db + shift * scale_db, scale_db * left

    @cached_property
    def held_out_nll(self) -> np.ndarray:
        """(n,) negative log-likelihood [nats]; NaN where there is none."""
        mean_db, scale_db = self.held_out_expected
        return self.held_out(lambda side, fit: np.where(
            side.usable, nll_at(side.problem(slice(None)), mean_db, scale_db), np.nan))

    @cached_property
    def held_out_mean_db(self) -> np.ndarray:
        """(n,) expected level of a link that is detected [dB]; NaN where there is none."""
        mean_db, scale_db = self.held_out_expected
        return self.held_out(lambda side, fit: np.where(
            side.usable, detected_db(mean_db, scale_db, side.limit_db, side.dof), np.nan))


def make_model(records: Records, base: Base, folds: Folds) -> Model:
    """Fit a base to all links and to those outside each fold."""
    everything = np.ones(len(records), dtype=bool)
    whole = base.fit(records)
    dof = best_dof(records, whole)
    sides = []
    for number in range(folds.count):
        train = folds.index != number
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the data: the fit to all links has said it
            sides.append(Side.make(records, train, base.fit(records.select(train)), dof))
    model = Model(Side.make(records, everything, whole, dof), sides, [], folds.index)
    model.fits = [side.fit() for side in model.sides]
    return model


def best_dof(records: Records, base: FittedBase) -> float:
    """Degrees of freedom of the errors that explain the links best."""
    everything = np.ones(len(records), dtype=bool)
    sides = [Side.make(records, everything, base, dof) for dof in DOFS]
    return DOFS[int(np.argmin([side.fit().objective for side in sides]))]


@dataclass(frozen=True, eq=False)
class Look:
    """A candidate, fitted to all links, and how much likelier they are with it [nats]."""

    effect: Effect
    whole: Side
    fit: Solution
    gain: float


@dataclass(eq=False)
class Search:
    """What was found, and how.

    Attributes:
        model: base and kept effects.
        log: every candidate of every step.
        rivals: of each kept effect, names of those that the data cannot tell from it.
        explained: the model before any last resort.
    """

    model: Model
    log: list[Judged] = field(default_factory=list)
    rivals: list[list[str]] = field(default_factory=list)
    explained: Model | None = None

    def keep(self, judged: Judged, model: Model) -> None:
        """Take over a model with one more effect."""
        self.model = model
        self.log.append(replace(judged, kept=True))
        self.rivals.append([])


def search_effects(result: Search, catalogue: list[Effect], seed: int, tell: Callable[[str], None]) -> None:
    """Add to the model the effect that gains most, and again, until none passes."""
    block = evidence_blocks(result.model.whole.records)
    available = []
    for effect in catalogue:
        why = effect.lacks(result.model.whole.records)
        if why:
            result.log.append(Judged(effect.name, False, f"not looked for: {why}", np.nan, np.nan, np.nan, 0))
        else:
            available.append(effect)
    while len(result.model.whole.parts) < MOST_EFFECTS:
        step = len(result.model.whole.parts)
        looks: list[Look] = []
        passed: list[tuple[Effect, Judged, Model]] = []
        for effect in available:
            tell(f"step {step + 1}: {effect.name}")
            if not effect.repeatable and any(part.effect is effect for part in result.model.whole.parts):
                continue
            look = look_at(result.model, effect, step)
            if isinstance(look, Judged):
                result.log.append(look)
            else:
                looks.append(look)
        for look in sorted(looks, key=lambda look: -look.gain):
            better = next((each for each in passed if _beyond(each, look, result.model)), None)
            if better is None:
                tell(f"step {step + 1}: {look.effect.name}, held out")
                # One more of a kind needs no correction: that there is such a thing here has been shown already.
                more = any(part.effect is look.effect for part in result.model.whole.parts)
                judged, extended = judge(result.model, look, block, 1 if more else len(available), step, seed)
            else:
                judged, extended = Judged(look.effect.name, False, (
                    f"{better[1].name} gains more on held-out links than this on those that it is fitted to "
                    f"({look.gain:.0f} nats)"), np.nan, np.nan, np.nan, step), None
            result.log.append(judged)
            if extended is not None:
                passed.append((look.effect, judged, extended))
        if not passed:
            break
        passed.sort(key=lambda each: -each[1].nll_gain)
        # Of those that the data cannot tell apart the one with the least error.
        alike = [each for each in passed if _alike(passed[0][1], each[1])]
        passed.sort(key=lambda each: each[1].rmse_db if each in alike else np.inf)
        steps = [passed[0][1:]]
        rival = next((each for each in passed[1:] if each[0].repeatable), None)
        most = MOST_OF_A_KIND if not passed[0][0].repeatable else _on_one_mast(passed[0][2])
        if rival is not None and most > 1:
            tell(f"step {step + 1}: more of {rival[1].name}")
            steps = _several(*rival, block, seed, passed[0][1].nll_gain, most) or steps
        best = steps[0][0]
        rivals = [judged.name for _, judged, _ in passed if judged.name != best.name and _alike(best, judged)]
        for i, entry in enumerate(result.log):
            if entry.step == step and entry.reason == "":
                result.log[i] = replace(entry, kept=entry is best,
                                        reason="" if entry is best else f"{best.name} gains more")
        result.log += [replace(judged, kept=True) for judged, _ in steps[1:]]
        result.rivals += [rivals, *([] for _ in steps[1:])]
        tell(f"step {step + 1}: {best.name}, exactly")
        result.model = _exactly(steps[-1][1])
    # A rival that gains beside the effect is another effect; one that does not is another name for it.
    last = max((entry.step for entry in result.log), default=0)
    alive = {entry.name for entry in result.log if entry.kept or (entry.step == last and entry.reason == "")}
    result.rivals = [sorted(set(rivals) - alive) for rivals in result.rivals]


def _beyond(passed: tuple[Effect, Judged, Model], look: Look, model: Model) -> bool:
    """Whether an effect that passed gains so much that another need not be tried on held-out links, where it can hardly
    gain more than on those that it is fitted to. One of a kind of which there may be several gets its chance."""
    effect, judged, _ = passed
    clear = judged.nll_gain - look.gain > CLEARLY_NATS * model.whole.view(model.fits[0]).design_effect
    return clear and (effect.repeatable or not look.effect.repeatable)


def _alike(best: Judged, other: Judged) -> bool:
    return best.gain_by_fold.sum() - other.gain_by_fold.sum() < CLEARLY_NATS


def _on_one_mast(extended: Model) -> int:
    """How many devices the last effect acts on, if they are all on one mast; else 0."""
    part, records = extended.whole.parts[-1], extended.whole.records
    acts = (part.term.offset_db != 0) | (part.term.columns != 0).any(axis=1)
    devices = np.unique(records.device[acts])
    return len(devices) if len(devices) and set(devices) <= set(site_of(records, devices[0])) else 0


def _several(effect: Effect, judged: Judged, extended: Model, block: np.ndarray, seed: int,
             least_gain: float, most: int) -> list[tuple[Judged, Model]] | None:
    """An effect of which a step finds one, again and again, until it gains more than one that finds all of its kind at
    once: groves or towers, each seen from few devices, against an offset for each device; or antennas against another
    place of the mast that carries them. None where it does not."""
    steps = [(judged, extended)]
    while len(extended.whole.parts) < MOST_EFFECTS and len(steps) < most:
        look = look_at(extended, effect, judged.step + 1)
        if isinstance(look, Judged):
            return None
        judged, extended = judge(extended, look, block, 1, judged.step + 1, seed)
        if extended is None:
            return None
        steps.append((judged, extended))
        if sum(judged.nll_gain for judged, _ in steps) > least_gain:
            return steps
    return None


def _exactly(model: Model) -> Model:
    """The same effects, worked out exactly by each side whose training links are better explained so."""
    worked_out = [exactly(side, fit) for side, fit in zip(model.sides, model.fits)]
    return Model(worked_out[0][0], [side for side, _ in worked_out[1:]], [fit for _, fit in worked_out], model.index)


def add_shadowing(search: Search, seed: int) -> None:
    """Interpolate over the ground what is left, and keep that where held-out links are better predicted."""
    model = search.model
    step = len(model.whole.parts)
    fields = [Shadowing.fit(side, fit, seed) for side, fit in zip(model.sides, model.fits)]
    # Where what it learnt does not return on held-out flights, its mean may be right and its certainty is not.
    for tried in (fields, [replace(each, certain=False) for each in fields]):
        extended = Model(model.whole, model.folds, model.fits, model.index, tried)
        judged = _weigh(model, extended, Judged(SHADOWING, False, "", np.nan, np.nan, np.nan, step),
                        None, 1, seed, nlos_only=True)
        if not judged.reason:
            search.log.append(replace(judged, kept=True))
            search.model = extended
            return
    search.log.append(judged)


def look_at(model: Model, effect: Effect, step: int) -> Look | Judged:
    """Fit a candidate to all links; what is said of it where that is enough to refuse it."""
    refused = Judged(effect.name, False, "", np.nan, np.nan, np.nan, step)
    whole = add(model.whole, effect, model.fits[0])
    if whole is None:
        return replace(refused, reason="nothing in the residual looks like it")
    last = whole[0].parts[-1]
    strange = effect.unphysical(last.setting, whole[1].coefficients[whole[0].places[-1]])
    if strange:
        return replace(refused, reason=strange)
    gain = model.fits[0].objective - whole[1].objective
    if gain < WORTH_A_LOOK_NATS:
        why = f"gains less than {WORTH_A_LOOK_NATS:.0f} nats even on the links that it is fitted to"
        return replace(refused, reason=why)
    return Look(effect, *whole, gain)


def judge(model: Model, look: Look, block: np.ndarray, tried: int, step: int, seed: int):
    """Fit a candidate to each fold's links; what the others say of it, and the model with it where it passes."""
    sides, fits = [], [look.fit]
    for side, fit in zip(model.folds, model.fits[1:]):
        added = add(side, look.effect, fit, look.whole.parts[-1].setting) or (side, fit)
        sides.append(added[0])
        fits.append(added[1])
    extended = Model(look.whole, sides, fits, model.index)
    judged = Judged(look.effect.name, False, "", np.nan, np.nan, np.nan, step)
    judged = _weigh(model, extended, judged, block, tried, seed, nlos_only=look.effect.nlos_only)
    return judged, None if judged.reason else extended


def _weigh(model: Model, extended: Model, judged: Judged, block: np.ndarray | None, tried: int, seed: int,
           nlos_only: bool = False) -> Judged:
    """What held-out links say of an extended model; with the reason where it is to be refused. Without pieces of
    evidence (n,) it may hang on a few places."""
    gain = model.held_out_nll - extended.held_out_nll
    usable, los = np.isfinite(gain), model.whole.records.los
    if not usable.any():
        return replace(judged, reason="no held-out link can be judged with it")
    design_effect = model.whole.view(model.fits[0]).design_effect

    def by_fold(rows: np.ndarray) -> np.ndarray:
        return np.bincount(model.index[rows], weights=gain[rows], minlength=len(model.folds)) / design_effect

    total, shares = float(gain[usable].sum()), by_fold(usable)
    per_link = max(gain[rows].mean() for rows in (usable, usable & los) if rows.any())
    p_value, after_db = min(tried * gain_p(shares), 1.0), rmse_db(extended, usable)
    one_sided = 0.0 if block is None else sign_flip_p(np.bincount(block[usable], weights=gain[usable]), seed)
    unsupported = gain_p(by_fold(usable & los)) if los.any() and not los.all() and not nlos_only else 0.0
    reason = ""
    if total < LEAST_GAIN_NATS:
        reason = f"gains {total:.0f} nats on held-out links, {LEAST_GAIN_NATS:.0f} are needed"
    elif p_value > SIGNIFICANCE:
        reason = f"its gain may be chance (p = {p_value:.2g} after correction)"
    elif one_sided > CONSISTENT:
        reason = f"its gain hangs on a few places (p = {one_sided:.2g} if signs are flipped)"
    elif (shares > 0).mean() < LEAST_FOLDS:
        reason = f"gains in {(shares > 0).sum()} of {len(shares)} folds only"
    elif per_link < LEAST_GAIN_PER_LINK and after_db > MOST_OF_RMSE * rmse_db(model, usable):
        reason = f"gains {per_link:.3f} nats a link only, {LEAST_GAIN_PER_LINK} are needed"
    elif unsupported > SUPPORTED:
        reason = f"links with line of sight, where the base is surest, do not support it (p = {unsupported:.2g})"
    return replace(judged, reason=reason, nll_gain=total, rmse_db=after_db, p_value=p_value,
                   gain_by_fold=shares)


def rmse_db(model: Model, rows: np.ndarray) -> float:
    """Held-out root mean square error of the detected links among `rows` [dB]."""
    error = (model.whole.records.level_db - model.held_out_mean_db)[rows]
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan
