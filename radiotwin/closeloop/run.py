"""Run the loop: fit a base, scan its residual, search for effects, compare held-out errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.closeloop.crossfit import (
    BASES,
    FIRST_LOOK_LINKS,
    MIN_GAIN_DB,
    Base,
    CrossFit,
    Folds,
    LogDistanceBase,
    RaytraceBase,
    TwinBase,
    best_base,
    cross_validate,
    make_bases,
    make_folds,
    paths_gain_db,
    training_parts,
)
from radiotwin.closeloop.families import Readings
from radiotwin.closeloop.predict.predictor import CombinedPrediction, combined_prediction
from radiotwin.closeloop.scan import scan
from radiotwin.closeloop.scan_sensitivity import LeastDeviation, least_deviations
from radiotwin.closeloop.search.anomaly_causes import add_causes_of_anomalies
from radiotwin.closeloop.search.causes import add_causes
from radiotwin.closeloop.search.declared import add_declared
from radiotwin.closeloop.search.faults import add_changes, add_faults, drop_idle_faults
from radiotwin.closeloop.search.relocate import relocate_devices
from radiotwin.closeloop.search.rest import add_shadowing, add_trends
from radiotwin.closeloop.search.stages import SearchInputs, SearchState, search
from radiotwin.closeloop.verdict.criteria import MIN_SURE, SelectionCriteria
from radiotwin.closeloop.verdict.intervals import effect_parameters, effect_size_db
from radiotwin.closeloop.verdict.posterior import verdict_without_effect
from radiotwin.closeloop.verdict.residual_tests import (
    ResidualDependence,
    dependences,
    noise_floor_db,
    significant,
)
from radiotwin.closeloop.verdict.sensitivity import Detectable, detectable
from radiotwin.display import Summarised, Summary, count, some
from radiotwin.effects.params import Parameter
from radiotwin.effects.registry import catalogue
from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.links import Links, prepare_links
from radiotwin.links.alignment import as_measurements
from radiotwin.links.checks import move_anchors_out
from radiotwin.links.evidence import MAX_LINKS, SAMPLE_LINKS, thin_links
from radiotwin.links.limits import with_usual_limits
from radiotwin.links.measurements import Measurements
from radiotwin.runtime.execution import Executor
from radiotwin.scene import Scene

BASE_FITTED = "looking at the residual"  # first progress message after the data were accepted
FIXED_CPU_S, LINKS_A_CPU_S, LINKS_A_CPU_S_ON_MAP = 45.0, 220.0, 120.0  # see `expected_cpu_s`


@dataclass(eq=False, repr=False)
class Loop(Summarised):
    """Result of a close-loop.

    Attributes:
        base: name of the base.
        links: the links used: all, or a sample if there are very many.
        folds: how they were held out.
        before: the base with declared effects only.
        explained: base and named effects, without trends and interpolated shadowing.
        found: base and all effects, and the log of all trials.
        criteria: thresholds that decided.
        dependences_before, dependences_after: variables on which the held-out residual depends.
        seed: random seed of the folds and of `prediction`.
        noise_floor_db: standard deviation of repeated readings at one position; NaN without any.
        origin: origin of the local frame; None if unknown.
    """

    base: str
    links: Links
    folds: Folds
    before: CrossFit
    explained: CrossFit
    found: SearchState
    criteria: SelectionCriteria
    dependences_before: list[ResidualDependence]
    dependences_after: list[ResidualDependence]
    seed: int
    noise_floor_db: float = np.nan
    origin: Origin | None = None

    @property
    def after(self) -> CrossFit:
        """The base with all effects that were found."""
        return self.found.model

    @cached_property
    def for_twin(self) -> CrossFit:
        """`after`, fitted again without descriptive effects that a map cannot show.

        If there is no such effect, `after` itself, with its interpolated shadowing.
        """
        dropped = [each.entry for each in self.after.whole.effects
                   if not (each.is_cause or each.is_declared or each.is_on_maps())]
        if not dropped:
            return self.after
        return self.after.map(lambda fit: fit.model.with_effects(
            each for each in fit.effects if each.entry not in dropped).fit())

    @property
    def remaining(self) -> list[ResidualDependence]:
        """Variables on which the residual still depends significantly."""
        return significant(self.dependences_after, self.criteria)

    @property
    def anomalies(self) -> pd.DataFrame:
        """Groups of links that stand out in the held-out residual of `before`, one a row.

        Columns: `family`; `devices, receivers, flights` (names); `sight` (line of sight);
        `statistic` with its `size, low, high, unit`; `probability`; `links` (number); `causes`
        (probability by effect).
        """
        rows = [{"family": each.family,
                 **{f"{end}s": ", ".join(each.members.get(end, ()))
                    for end in ("device", "receiver", "flight")},
                 "sight": each.sight, "statistic": each.statistic, "size": each.size.value,
                 "low": each.size.low, "high": each.size.high, "unit": each.size.unit,
                 "probability": each.probability, "links": int(each.rows.sum()),
                 "causes": dict(each.causes)} for each in self.found.anomalies]
        return pd.DataFrame(rows, columns=[
            "family", "devices", "receivers", "flights", "sight", "statistic", "size", "low",
            "high", "unit", "probability", "links", "causes"])

    @property
    def effects(self) -> pd.DataFrame:
        """Parameters of the effects that were found, one a row, with 90 % intervals.

        Columns: `effect`, its `rank` and `probability`, and `parameter, value, low, high, unit,
        determined`; see `Parameter.record`.
        """
        probability = {trial.name: trial.probability for trial in self.found.log.kept}
        rows = [{"effect": each.name, "rank": rank, "probability": probability.get(each.name),
                 "parameter": name, **parameter.record()}
                for rank, (each, parameters) in enumerate(
                    zip(self.after.whole.effects, self.parameters, strict=True), start=1)
                for name, parameter in parameters.items()]
        return pd.DataFrame(rows, columns=["effect", "rank", "probability", "parameter", "value",
                                           "low", "high", "unit", "determined"])

    @property
    def verdict(self) -> str:
        """The verdict: `effect`, `located`, `none` or `undecided`.

        `effect`: a cause was named. `located`: a group of links surely stands out, without a named
        cause. `none`: probably nothing is hidden, and no group stands out. Else `undecided`.
        """
        if any(each.is_cause and not each.is_declared for each in self.after.whole.effects):
            return "effect"
        if any(each.probability >= MIN_SURE for each in self.found.anomalies):
            return "located"
        verdict = verdict_without_effect(self.found.steps, self.criteria)
        return "undecided" if self.found.anomalies else verdict

    @property
    def _summary(self) -> Summary:
        names = some(each.name for each in self.after.whole.effects) or "no effect"
        error = f"RMSE {self.before.rmse_db():.2f} dB"
        if self.after is not self.before:
            had_before = np.isfinite(self.before.on_map[0])
            error += f" before, {self.after.rmse_on_map_db(had_before):.2f} dB after"
        return Summary("Loop", f"verdict {self.verdict}: {names}, base {self.base}, {error}", (
            ("verdict", self.verdict), ("effects", names), ("base", self.base),
            ("error on held-out links", error),
            ("held out", f"by {self.folds.by}, {count(self.folds.count, 'fold')}"),
            ("links", f"{len(self.links):,}")))

    @cached_property
    def prediction(self) -> CombinedPrediction:
        """Held-out prediction by the combination of models, and by each alone; takes minutes."""
        return combined_prediction(self.for_twin, bool(self.remaining), self.seed)

    @cached_property
    def detectable(self) -> list[Detectable]:
        """Least size from which each effect would have been named; empty if none was tried."""
        if self.found.last_hypotheses is None:
            return []
        model, hypotheses = self.found.last_hypotheses
        return detectable(model.whole.view, hypotheses, self.criteria,
                          [effect() for effect in catalogue()], model.whole.model.effect_names)

    @cached_property
    def seen_from(self) -> list[LeastDeviation]:
        """Least deviations of groups that would have been found; empty if a group stands out."""
        return [] if self.found.anomalies else least_deviations(self.before)

    @cached_property
    def parameters(self) -> list[dict[str, Parameter]]:
        """Parameters of each effect of `after`, by name, with 90 % intervals."""
        return effect_parameters(self.after)

    @cached_property
    def sizes_db(self) -> list[Parameter]:
        """RMS change of held-out readings by each effect of `after` [dB], with 90 % intervals."""
        return [effect_size_db(self.after, number)
                for number in range(len(self.after.whole.effects))]


def close_loop(measurements: Measurements | pd.DataFrame | Path | str,
               scene: Scene | Path | str | None = None, base: str = "auto",
               seed: int = 0, on_progress: Callable[[str], None] = lambda _: None,
               hold_out: str = "auto", criteria: SelectionCriteria | None = None,
               executor: Executor | None = None) -> Loop:
    """Find the effects that a base model lacks, and report held-out errors before and after.

    Args:
        measurements: readings; also a data frame or a file.
        scene: 3D map and radio, or their folder; None: every link counts as line of sight.
        base: one of `BASES`, or `auto`: the one with the least held-out error. Paths are then
            followed only if they reduce the error on a sample of links.
        seed: random seed of folds, fits and permutations.
        on_progress: called with a text on each step.
        hold_out: which links are held out together, see `make_folds`.
        criteria: thresholds; None: the defaults.
        executor: where effects are fitted, inside `keep_pieces`; None: in this process.

    Returns:
        the anomalies and effects, with errors before and after on held-out links.

    Raises:
        BadInput: an unknown base or way to hold out, `raytrace` without a map, an anchor deep
            inside a building, or no usable data.
    """
    if base not in (*BASES, "auto"):
        raise BadInput(f"base {base!r} is unknown; allowed are auto, {', '.join(BASES)}")
    scene = None if scene is None else Scene.of(scene)
    measurements = as_measurements(measurements, scene)
    if scene is None and base == "raytrace":
        raise BadInput("base 'raytrace' follows paths over a 3D map; give --scene, or take the "
                       "base log-distance")
    criteria = criteria or SelectionCriteria()
    all_links = prepare_links(measurements, scene)
    if scene is not None:  # anchors inside buildings are refused if the base uses line of sight
        all_links = move_anchors_out(all_links, scene, refuse=base != LogDistanceBase.name)
    links = with_usual_limits(thin_links(all_links, seed))
    folds = make_folds(links, seed, hold_out)
    links, fitted, model = fit_base(links, scene, folds, base, seed, on_progress)
    effects = tuple(effect() for effect in catalogue()
                    if not (effect.in_paths and model.whole.channel.follows_paths))
    inputs = SearchInputs(links, fitted, folds, effects, criteria, seed,
                          executor or Executor(), on_progress)
    declared = search(SearchState(model), [add_declared], inputs)
    on_progress(BASE_FITTED)
    declared = replace(declared, anomalies=tuple(scan(Readings.of(declared.model))))
    before = after = dependences(declared.model, seed)
    found = search(declared, [add_causes_of_anomalies, add_faults, add_changes, add_causes,
                              drop_idle_faults], inputs)
    on_progress("unknown devices again, beside the effects")
    fresh_base = make_bases(scene, seed)[fitted.name]  # without cached positions
    explained = relocate_devices(found.model, links, fresh_base)
    on_progress("looking at what is left")
    if explained is not declared.model:
        after = dependences(explained, seed)
    left = [each.variable for each in significant(after, criteria)]
    found = search(replace(found, model=explained),
                   [partial(add_trends, variables=left), add_shadowing] if left else [], inputs)
    return Loop(fitted.name, links, folds, declared.model, explained, found, criteria, before,
                after, seed, noise_floor_db(all_links, criteria), measurements.origin)


def expected_cpu_s(links: int, has_map: bool) -> float:
    """Estimate the processor time of `close_loop` [s].

    It was right within a factor of two in 40 of 41 recorded runs with 5,000 to 106,000 links
    (`docs/results/real.json`, `injected.json`, `campus.json`).
    """
    used = links if links <= MAX_LINKS else SAMPLE_LINKS
    return FIXED_CPU_S + used / (LINKS_A_CPU_S_ON_MAP if has_map else LINKS_A_CPU_S)


def fit_base(links: Links, scene: Scene | None, folds: Folds, base: str = "auto", seed: int = 0,
             on_progress: Callable[[str], None] = lambda _: None
             ) -> tuple[Links, Base, CrossFit]:
    """Fit a base with cross-validation, or choose the base with the least held-out error.

    Args:
        links: n links.
        scene: 3D map and radio; None: `auto` takes the log-distance law.
        folds: assignment of the links.
        base: one of `BASES`, or `auto`: paths are followed if they reduce the held-out error on a
            sample of links.
        seed: random seed of the fits.
        on_progress: called with a text on each step.

    Returns:
        the links, with a note if paths were not followed; the base; its cross-validated fit.
    """
    names = [base]
    if base == "auto":
        names = [LogDistanceBase.name] if scene is None else [TwinBase.name]
        if scene is not None:
            on_progress("looking whether paths explain more than line of sight does")
            gain_db = paths_gain_db(links, scene, folds, seed)
            if gain_db >= MIN_GAIN_DB:
                names.append(RaytraceBase.name)
            else:
                links = links.with_notes(
                    f"Reflected paths are not part of the base: on {FIRST_LOOK_LINKS} links of "
                    f"anchors they make the held-out error {abs(gain_db):.2f} dB "
                    f"{'smaller' if gain_db > 0 else 'larger'}, and {MIN_GAIN_DB} dB less is "
                    "asked for. --base raytrace takes them all the same.")
    bases = make_bases(scene, seed)
    models, parts = {}, training_parts(links, folds)
    for name in names:
        on_progress(f"fitting the base {name}")
        models[name] = cross_validate(links, bases[name], folds, parts)
    best = best_base(models)
    return links, bases[best], models[best]
