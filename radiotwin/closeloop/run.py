"""The loop: residual, dependences, effects one by one, and the error before and after, held out.

Fewer links where more say nothing new: piles at one place, and samples of very many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from radiotwin.closeloop.crossfit import (
    BASES,
    CrossFit,
    Folds,
    LogDistanceBase,
    cross_validate,
    make_bases,
    make_folds,
    training_parts,
)
from radiotwin.closeloop.predict.predictor import CombinedPrediction, combined_prediction
from radiotwin.closeloop.search.declared import take_declared
from radiotwin.closeloop.search.faults import drop_idle_faults, select_change_points, select_faults
from radiotwin.closeloop.search.posterior import NONE, OTHER
from radiotwin.closeloop.search.relocate import relocate_devices
from radiotwin.closeloop.search.selection import SelectionResult, add_shadowing, forward_selection
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.intervals import effect_parameters, effect_size_db
from radiotwin.closeloop.verdict.residual_tests import ResidualDependence, residual_dependences
from radiotwin.closeloop.verdict.sensitivity import Detectable, detectable
from radiotwin.display import Summarised, Summary, count, some
from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from radiotwin.effects.params import Parameter
from radiotwin.effects.registry import catalogue
from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.links import Links, prepare_links, residual_variables
from radiotwin.links.checks import refuse_misplaced_anchors
from radiotwin.links.correlation import moving_end_m, pair_of_ends
from radiotwin.links.limits import limits_to_explain
from radiotwin.links.measurements import Measurements
from radiotwin.runtime.execution import Executor
from radiotwin.scene import Scene

PLACE_M = 5.0  # side of a square of ground that counts as one place
PILE, MIN_PILE = 5, 20  # times the usual number of readings at one place is a pile; and at least
MIN_SURPLUS = 0.05  # share of all links in piles, to thin them
MAX_LINKS = 120_000  # up to which all are used
SAMPLE_LINKS = 60_000  # of more: takes minutes


def thin_piles(links: Links) -> Links:
    """Return links of which no place has far more than the others have, with a note.

    A receiver that hovers reads one and the same error many times. What a place (of one pair of
    ends, on one flight) has beyond `PILE` times the usual number is left out, evenly in time.

    Args:
        links: n links.
    """
    cell = np.floor(moving_end_m(links)[:, :2] / PLACE_M).astype(np.int64)
    keys = np.column_stack([cell, pair_of_ends(links), links.flight])
    order = np.lexsort((np.arange(len(links)), links.time_s, *keys.T))
    starts = np.flatnonzero(np.r_[True, np.diff(keys[order], axis=0).any(axis=1)])
    count = np.diff(np.r_[starts, len(links)])
    most = max(PILE * float(np.median(count)), MIN_PILE)
    if np.maximum(count - most, 0).sum() < MIN_SURPLUS * len(links):
        return links
    share = np.repeat(np.minimum(most / count, 1.0), count)
    place = np.arange(len(links)) - np.repeat(starts, count)
    kept = np.sort(order[np.floor((place + 1) * share) > np.floor(place * share)])
    note = (f"receivers stayed at {(count > most).sum():,} places, where "
            f"{len(links) - len(kept):,} of {len(links):,} links are left out, evenly in time: "
            f"readings at one place err alike and count as one; {most:.0f} of them are used")
    return links.select(kept).with_notes(note)


def thin_links(links: Links, seed: int) -> Links:
    """Return the links, or a sample of very many, with a note that says so.

    The links of each flight, device and receiver are taken in the order of their times, and of as
    many as go into the sample once, one is drawn. So all flights, devices, receivers, times and
    blanks have the share that they have of all links, and means over the sample are not biased.

    Args:
        links: n links.
        seed: of the draw.
    """
    links = thin_piles(links)
    n = len(links)
    if n <= MAX_LINKS:
        return links
    order = np.lexsort((np.arange(n), links.time_s, links.receiver, links.device, links.flight))
    first = np.arange(SAMPLE_LINKS + 1) * n // SAMPLE_LINKS
    rows = np.sort(order[np.random.default_rng(seed).integers(first[:-1], first[1:])])
    note = (f"of {n:,} links {len(rows):,} are used, drawn evenly from all flights, devices, "
            f"receivers and times, as above {MAX_LINKS:,} the loop would take hours; errors, "
            "evidence and residuals are those of the sample")
    return links.select(rows).with_notes(note)


@dataclass(eq=False, repr=False)
class Loop(Summarised):
    """Result of a close-loop.

    Attributes:
        base: name of the base.
        links: that were used: all, or a sample of very many.
        folds: how they were held out.
        before: the base alone, with what is declared.
        selection: base and effects.
        dependences_before, dependences_after: of the held-out residual.
        seed: of what is still to be drawn.
        noise_floor_db: from links measured twice at one position; NaN where there are none.
        origin: of the frame of the links; None where it is not known.
    """

    base: str
    links: Links
    folds: Folds
    before: CrossFit
    selection: SelectionResult
    dependences_before: list[ResidualDependence]
    dependences_after: list[ResidualDependence]
    seed: int
    noise_floor_db: float = np.nan
    origin: Origin | None = None

    @property
    def after(self) -> CrossFit:
        """Base and effects."""
        return self.selection.model

    @cached_property
    def for_twin(self) -> CrossFit:
        """The same without curves that no map has; with the rest, if it goes with just that."""
        dropped = [each.effect for each in self.after.whole.effects
                   if not (each.effect.is_cause or each.effect.is_declared
                           or each.effect.is_on_maps(each.params))]
        if not dropped:
            return self.after
        return self.after.map(lambda fit: fit.model.with_effects(
            [each for each in fit.effects
             if not any(each.effect is other for other in dropped)]).fit())

    @property
    def criteria(self) -> SelectionCriteria:
        """Thresholds that decided."""
        return self.selection.criteria

    @property
    def remaining(self) -> list[ResidualDependence]:
        """Dependences that are left."""
        return significant(self.dependences_after, self.criteria)

    @property
    def verdict(self) -> str:
        """`effect`, `none`, `unexplained` or `undecided`.

        Without a named effect: `unexplained` where a cause without a name is the likeliest, or more
        than `max_rest_db` belongs to places; `none` where nothing is the likeliest by far. Of the
        first step; last resorts have no part in it.
        """
        if any(each.effect.is_cause and not each.effect.is_declared
               for each in self.after.whole.effects):
            return "effect"
        if not self.selection.steps:
            return "undecided"
        step = self.selection.steps[0]
        likeliest = max(step.probabilities, key=lambda name: step.probabilities[name])
        if likeliest == OTHER or step.rest_db > self.criteria.max_rest_db:
            return "unexplained"
        sure = step.probabilities[NONE] >= self.criteria.min_probability
        return "none" if sure else "undecided"

    @property
    def _summary(self) -> Summary:
        names = some(each.effect.name for each in self.after.whole.effects) or "no effect"
        error = f"RMSE {self.before.rmse_db():.2f} dB before, {self.after.rmse_db():.2f} dB after"
        return Summary("Loop", f"verdict {self.verdict}: {names}, base {self.base}, {error}", (
            ("verdict", self.verdict), ("effects", names), ("base", self.base),
            ("error on held-out links", error),
            ("held out", f"by {self.folds.by}, {count(self.folds.count, 'fold')}"),
            ("links", f"{len(self.links):,}")))

    @cached_property
    def prediction(self) -> CombinedPrediction:
        """Held-out, by all that was learnt, and by other models alone; takes a while."""
        return combined_prediction(self.for_twin, bool(self.remaining), self.criteria, self.seed)

    @cached_property
    def detectable(self) -> list[Detectable]:
        """How large effects would have had to be, to be named."""
        left = self.selection.looked_at
        if left is None:
            return []
        model, hypotheses = left
        return detectable(model.whole.view, hypotheses, self.criteria,
                          model.whole.model.effect_names)

    @cached_property
    def parameters(self) -> list[dict[str, Parameter]]:
        """Of each kept effect, see `effect_parameters`."""
        return effect_parameters(self.after)

    @cached_property
    def sizes_db(self) -> list[Parameter]:
        """Of each kept effect, see `effect_size_db`."""
        return [effect_size_db(self.after, number)
                for number in range(len(self.after.whole.effects))]


def significant(dependences: list[ResidualDependence],
                criteria: SelectionCriteria) -> list[ResidualDependence]:
    """Return those that are not chance and strong enough to matter."""
    return [each for each in dependences if each.p_value <= criteria.max_dependence_p_value
            and each.effect_db >= criteria.min_dependence_db]


def close_loop(measurements: Measurements, scene: Scene | None = None, base: str = "auto",
               seed: int = 0, on_progress: Callable[[str], None] = lambda _: None,
               hold_out: str = "auto", criteria: SelectionCriteria | None = None,
               executor: Executor | None = None) -> Loop:
    """Find what a base model lacks.

    Args:
        measurements: links.
        scene: 3D map and radio; None: every link counts as one with line of sight.
        base: one of `BASES`, or `auto`: the one with the least held-out error.
        seed: of folds, fits and permutations.
        on_progress: called with what is being done.
        hold_out: which links are held out together, see `make_folds`.
        criteria: thresholds; None: the defaults.
        executor: where effects are fitted, inside `keep_pieces`; None: in this process.

    Returns:
        what was found, with the error before and after on links that took no part.

    Raises:
        BadInput: an unknown base or way to hold out, or data of which nothing can be used.
    """
    if base not in (*BASES, "auto"):
        raise BadInput(f"base {base!r} is unknown; allowed are auto, {', '.join(BASES)}")
    if scene is None and base == "raytrace":
        raise BadInput("base 'raytrace' follows paths over a 3D map; give --scene, or take the "
                       "base log-distance")
    criteria = criteria or SelectionCriteria()
    all_links = prepare_links(measurements, scene)
    if scene is not None and base != LogDistanceBase.name:  # which needs no line of sight
        refuse_misplaced_anchors(all_links, scene)
    links = limits_to_explain(thin_links(all_links, seed))
    folds = make_folds(links, seed, hold_out)
    names = [base]
    if base == "auto":
        names = ["log-distance"] if scene is None else ["twin", "raytrace"]
    executor = executor or Executor()
    bases = make_bases(scene, seed)
    models, parts = {}, training_parts(links, folds)
    for name in names:
        on_progress(f"fitting the base {name}")
        models[name] = cross_validate(links, bases[name], folds, parts)
    best = best_base(models)
    selection = SelectionResult(models[best], criteria, executor=executor)
    candidates = [effect() for effect in catalogue()
                  if not (effect.in_paths and models[best].whole.channel.follows_paths)]
    effects = take_declared(selection, candidates, seed, on_progress)
    before = selection.model
    on_progress("looking at the residual")
    dependences_before = _dependences(before, seed)
    select_faults(selection, effects, links, bases[best], seed, on_progress)
    select_change_points(selection, links, bases[best], folds, seed, on_progress)
    forward_selection(selection, [effect for effect in effects if not effect.within_flights], seed,
                      on_progress)
    drop_idle_faults(selection)
    on_progress("unknown devices again, beside the effects")
    anew = make_bases(scene, seed)[best]  # which remembers no earlier position
    selection.model = relocate_devices(selection.model, links, anew)
    selection.explained = selection.model
    on_progress("looking at what is left")
    dependences_after = dependences_before
    if selection.model is not before:
        dependences_after = _dependences(selection.model, seed)
    left = significant(dependences_after, criteria)
    if left:
        values = residual_variables(selection.model.links, selection.model.held_out_mean_db)
        trends = [UnexplainedTrend(each.variable) for each in left
                  if values[each.variable].dtype.kind == "f"]  # a curve needs an order
        forward_selection(selection, [*trends[:criteria.max_trends]], seed, on_progress)
        on_progress("correlated_shadowing")
        add_shadowing(selection, seed)
    return Loop(best, links, folds, before, selection, dependences_before, dependences_after,
                seed, _noise_floor_db(all_links, criteria), measurements.origin)


def best_base(models: dict[str, CrossFit]) -> str:
    """Return the base with the least held-out error of the links that all can predict.

    One that cannot locate the devices that are hard to predict does not win by that. Of several
    without a link in common, the one that predicts most.
    """
    known = {name: np.isfinite(model.links.level_db - model.held_out_mean_db)
             for name, model in models.items()}
    in_common = np.all(list(known.values()), axis=0)
    if not in_common.any():
        return max(known, key=lambda name: known[name].sum())
    return min(models, key=lambda name: models[name].rmse_db(in_common))


def _dependences(model: CrossFit, seed: int) -> list[ResidualDependence]:
    mean_db = model.held_out_mean_db
    residual_db = np.where(model.unforeseen, np.nan, model.links.level_db - mean_db)
    return residual_dependences(model.links, residual_db, model.held_out_reading[1], mean_db, seed)


def _noise_floor_db(links: Links, criteria: SelectionCriteria) -> float:
    """Return the standard deviation of one measurement [dB], from repeats at one position."""
    place = np.round(np.column_stack([links.receiver_m, links.device, links.receiver]), 1)
    group = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    seen = np.isfinite(links.level_db)
    count = np.bincount(group[seen], minlength=group.max() + 1)
    sums = np.bincount(group[seen], weights=links.level_db[seen], minlength=len(count))
    mean = sums / np.maximum(count, 1)
    again = seen & (count[group] > 1)
    freedom = int((count[count > 1] - 1).sum())
    if freedom < criteria.min_repeats_for_noise:
        return float("nan")
    return float(np.sqrt(((links.level_db - mean[group])[again] ** 2).sum() / freedom))
