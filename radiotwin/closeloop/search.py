"""Which effects the data supports: fitted on training folds, judged on held-out ones, kept one after the other."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.folds import Folds, evidence_blocks
from radiotwin.closeloop.model import Side, add
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Solution
from radiotwin.effects.base import Effect

DOFS = (3.0, 5.0, 10.0, 30.0)
LEAST_GAIN_NATS = 25.0
LEAST_GAIN_PER_LINK = 0.01  # nats; 0.02 is what an RMSE lower by 2 % gains
LEAST_FOLDS = 0.6  # of the folds must gain
SIGNIFICANCE = 0.01
CONSISTENT = 0.1
FLIPS = 20_000
MOST_EFFECTS = 6
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
    """

    name: str
    kept: bool
    reason: str
    nll_gain: float
    rmse_db: float
    p_value: float
    step: int


@dataclass(eq=False)
class Model:
    """The whole and the folds, side by side.

    Attributes:
        whole: learned from all links.
        folds: learned from all but one fold each.
        fits: the whole's solution, then the folds'.
    """

    whole: Side
    folds: list[Side]
    fits: list[Solution]
    index: np.ndarray

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

    def held_out_nll(self) -> np.ndarray:
        return self.held_out(lambda side, fit: side.nll(fit))

    def held_out_mean_db(self) -> np.ndarray:
        return self.held_out(lambda side, fit: np.where(side.usable, side.mean_db(fit), np.nan))


def make_model(records: Records, base: Base, folds: Folds) -> Model:
    """Fit a base to all links and to those outside each fold."""
    everything = np.ones(len(records), dtype=bool)
    whole = base.fit(records)
    dof = _best_dof(records, everything, whole)
    sides = []
    for number in range(folds.count):
        train = folds.index != number
        sides.append(Side.make(records, train, base.fit(records.select(train)), dof))
    model = Model(Side.make(records, everything, whole, dof), sides, [], folds.index)
    model.fits = [side.fit() for side in model.sides]
    return model


def _best_dof(records: Records, everything: np.ndarray, base) -> float:
    sides = [Side.make(records, everything, base, dof) for dof in DOFS]
    return DOFS[int(np.argmin([side.fit().objective for side in sides]))]


@dataclass(eq=False)
class Search:
    """What was found, and how.

    Attributes:
        model: base and kept effects.
        log: every candidate of every step.
        gains: held-out gain of each kept effect when it was added [nats], and its corrected p-value.
    """

    model: Model
    log: list[Judged] = field(default_factory=list)
    gains: list[tuple[float, float]] = field(default_factory=list)


def search_effects(model: Model, catalogue: list[Effect], seed: int,
                   tell: Callable[[str], None]) -> Search:
    """Add the effect that gains most, and again, until none passes."""
    result = Search(model)
    block = evidence_blocks(model.whole.records)
    available = []
    for effect in catalogue:
        why = effect.lacks(model.whole.records)
        if why:
            result.log.append(Judged(effect.name, False, f"not looked for: {why}", np.nan, np.nan, np.nan, 0))
        else:
            available.append(effect)
    for step in range(MOST_EFFECTS):
        best = None
        for effect in available:
            tell(f"step {step + 1}: {effect.name}")
            if not effect.repeatable and any(part.effect is effect for part in result.model.whole.parts):
                continue
            judged, extended = _judge(result.model, effect, block, len(available), step, seed)
            result.log.append(judged)
            if extended is not None and (best is None or judged.nll_gain > best[0].nll_gain):
                best = judged, extended
        if best is None:
            break
        judged, result.model = best
        place = next(i for i, entry in enumerate(result.log) if entry is judged)
        result.log[place] = Judged(judged.name, True, "", judged.nll_gain, judged.rmse_db, judged.p_value, step)
        for i, entry in enumerate(result.log):
            if entry.step == step and entry.reason == "" and not entry.kept:
                result.log[i] = Judged(entry.name, False, f"{judged.name} gains more", entry.nll_gain, entry.rmse_db,
                                       entry.p_value, step)
        result.gains.append((judged.nll_gain, judged.p_value))
    return result


def _judge(model: Model, effect: Effect, block: np.ndarray, tried: int, step: int, seed: int):
    """Fit a candidate everywhere; returns what is said of it, and the model with it where it passes."""
    def refused(reason: str, gain=np.nan, rmse=np.nan, p_value=np.nan):
        return Judged(effect.name, False, reason, gain, rmse, p_value, step), None

    whole = add(model.whole, effect, model.fits[0])
    if whole is None:
        return refused("nothing in the residual looks like it")
    strange = effect.unphysical(whole[0].parts[-1].setting, whole[0].found(whole[1])[-1].coefficients)
    if strange:
        return refused(strange)
    if model.fits[0].objective - whole[1].objective < WORTH_A_LOOK_NATS:
        return refused(f"gains less than {WORTH_A_LOOK_NATS:.0f} nats even on the links that it is fitted to")
    sides, fits = [], [whole[1]]
    for side, fit in zip(model.folds, model.fits[1:]):
        added = add(side, effect, fit) or (side, fit)
        sides.append(added[0])
        fits.append(added[1])
    extended = Model(whole[0], sides, fits, model.index)
    gain = model.held_out_nll() - extended.held_out_nll()
    usable = np.isfinite(gain)
    los = model.whole.records.los
    total = float(gain[usable].sum())
    by_fold = np.bincount(model.index[usable], weights=gain[usable], minlength=len(sides))
    after = rmse_db(extended, usable)
    per_link = max(gain[rows].mean() for rows in (usable, usable & los) if rows.any())
    design_effect = model.whole.view(model.fits[0]).design_effect
    p_value = min(tried * gain_p(by_fold / design_effect), 1.0)
    one_sided = sign_flip_p(np.bincount(block[usable], weights=gain[usable]), seed)
    numbers = total, after, p_value
    if total < LEAST_GAIN_NATS:
        return refused(f"gains {total:.0f} nats on held-out links, {LEAST_GAIN_NATS:.0f} are needed", *numbers)
    if p_value > SIGNIFICANCE:
        return refused(f"its gain may be chance (p = {p_value:.2g} after correction)", *numbers)
    if one_sided > CONSISTENT:
        return refused(f"its gain hangs on a few places (p = {one_sided:.2g} if signs are flipped)", *numbers)
    if (by_fold > 0).mean() < LEAST_FOLDS:
        return refused(f"gains in {(by_fold > 0).sum()} of {len(by_fold)} folds only", *numbers)
    if per_link < LEAST_GAIN_PER_LINK:
        return refused(f"gains {per_link:.3f} nats a link only, {LEAST_GAIN_PER_LINK} are needed", *numbers)
    if los.any() and not los.all() and not effect.nlos_only and gain[usable & los].sum() <= 0:
        return refused("links with line of sight do not support it", *numbers)
    return Judged(effect.name, False, "", *numbers, step), extended


def rmse_db(model: Model, rows: np.ndarray) -> float:
    """Held-out root mean square error of the detected links among `rows` [dB]."""
    error = (model.whole.records.level_db - model.held_out_mean_db())[rows]
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan


def gain_p(gains: np.ndarray) -> float:
    """Bound on the chance of such held-out gains (folds,) [nats] if the effect is not there.

    A likelihood ratio whose parameters were fitted elsewhere is at most 1 on average then, and so is its mean over the
    folds; by Markov's inequality (Wasserman, Ramdas and Balakrishnan 2020, 'Universal inference', PNAS 117(29), the
    cross-fit test).
    """
    return float(np.exp(-max(logsumexp(gains) - np.log(len(gains)), 0.0)))


def sign_flip_p(gains: np.ndarray, seed: int) -> float:
    """Chance of a sum this large if each piece of evidence were as likely to speak against as for it."""
    rng = np.random.default_rng(seed)
    gains = gains[gains != 0]
    if not len(gains):
        return 1.0
    most = max(int(4e6 // len(gains)), 100)
    larger, done = 0, 0
    while done < FLIPS:
        count = min(most, FLIPS - done)
        larger += int(((rng.integers(0, 2, (count, len(gains))) * 2 - 1) @ gains >= gains.sum()).sum())
        done += count
    return (larger + 1) / (FLIPS + 1)
