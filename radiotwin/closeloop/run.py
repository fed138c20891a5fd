"""The loop: residual, structure, effects one by one, and the error before and after on links that took no part."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from radiotwin.channel import Links
from radiotwin.channel.likelihood import mean_if_detected
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.regression_kriging import RegressionKriging
from radiotwin.closeloop.bases import Base, LogDistanceBase, TwinBase
from radiotwin.closeloop.between_flights import search_between_flights
from radiotwin.closeloop.folds import Folds, make_folds
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import Records, make_records
from radiotwin.closeloop.search import Model, Search, add_shadowing, make_model, rmse_db, search_effects
from radiotwin.closeloop.structure import Driver, find_drivers, variables
from radiotwin.closeloop.trends import UnexplainedTrend
from radiotwin.effects import CATALOGUE
from radiotwin.effects.base import Effect, Parameter
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene

BASES = ("twin", "raytrace", "log-distance")
STRUCTURED = 0.01
LEAST_EFFECT_DB = 0.5  # a dependence that is weaker is of no use to anybody
MOST_TRENDS = 4  # variables, the strongest drivers
MOST_FOR_KRIGING = 30_000


@dataclass(eq=False)
class Loop:
    """What came out.

    Attributes:
        base: name of the base model.
        records: links that were used.
        folds: how they were held out.
        before, search: the base alone; base and effects.
        drivers_before, drivers_after: what the held-out residual depends on.
        baselines: (n,) held-out expectation of other models for each link [dB].
        noise_floor_db: from links measured twice at one place; NaN where there are none.
    """

    base: str
    records: Records
    folds: Folds
    before: Model
    search: Search
    drivers_before: list[Driver]
    drivers_after: list[Driver]
    baselines: dict[str, np.ndarray] = field(default_factory=dict)
    noise_floor_db: float = np.nan

    @property
    def after(self) -> Model:
        return self.search.model

    @property
    def remaining(self) -> list[Driver]:
        """Drivers that are left."""
        return significant(self.drivers_after)

    @property
    def verdict(self) -> str:
        """`effect`, `none` or `unexplained`."""
        parts = self.after.whole.parts
        if any(part.effect.explains for part in parts):
            return "effect"
        return "unexplained" if parts or self.after.shadowing or significant(self.drivers_before) else "none"

    @cached_property
    def parameters(self) -> list[dict[str, Parameter]]:
        """Of each kept effect; their intervals take a fit for each end."""
        whole = self.after.whole
        return [part.effect.parameters(whole.records, part.setting, found)
                for part, found in zip(whole.parts, whole.found(self.after.fits[0]))]


def significant(drivers: list[Driver]) -> list[Driver]:
    """Those that are no chance and strong enough to matter."""
    return [driver for driver in drivers if driver.p_value <= STRUCTURED and driver.effect_db >= LEAST_EFFECT_DB]


def close_loop(measurements: Measurements, scene: Scene | None = None, base: str = "auto", seed: int = 0,
               tell: Callable[[str], None] = lambda _: None, hold_out: str = "auto") -> Loop:
    """Find what a base model lacks.

    Args:
        measurements: links.
        scene: 3D map and radio; None: every link counts as one with line of sight.
        base: one of `BASES`, or `auto`: the one with the least held-out error.
        seed: of folds, fits and permutations.
        tell: called with what is being done.
        hold_out: which links are held out together, see `make_folds`.

    Raises:
        BadInput: an unknown base or way to hold out, or data of which nothing can be used.
    """
    if base not in (*BASES, "auto"):
        raise BadInput(f"base {base!r} is unknown; allowed are auto, {', '.join(BASES)}")
    if scene is None and base == "raytrace":
        raise BadInput("base 'raytrace' follows paths over a 3D map; give --scene, or take the base log-distance")
    records = make_records(measurements, scene)
    folds = make_folds(records, seed, hold_out)
    names = [base] if base != "auto" else ["twin", "raytrace"] if scene is not None else ["log-distance"]
    twin = TwinBase(scene, seed)
    bases: dict[str, Base] = {"twin": twin, "log-distance": LogDistanceBase(scene, seed)}
    if scene is not None:
        bases["raytrace"] = RaytraceBase(twin)
    models = {}
    for name in names:
        tell(f"fitting the base {name}")
        models[name] = make_model(records, bases[name], folds)
    everything = np.ones(len(records), dtype=bool)
    best = min(models, key=lambda name: rmse_db(models[name], everything))
    before = models[best]
    tell("looking at the residual")
    drivers_before = _drivers(before, seed)
    search = Search(before)
    search_effects(search, [effect() for effect in CATALOGUE], seed, tell)
    search_between_flights(search, bases[best], folds, seed, tell)
    search.explained = search.model
    tell("looking at what is left")
    drivers_after = _drivers(search.model, seed) if search.model is not before else drivers_before
    if significant(drivers_after):
        values = variables(search.model.whole.records, search.model.held_out_mean_db)
        trends: list[Effect] = [UnexplainedTrend(driver.variable) for driver in significant(drivers_after)
                  if values[driver.variable].dtype.kind == "f"]  # labels have no order that a curve could follow
        search_effects(search, trends[:MOST_TRENDS], seed, tell)
        tell("correlated_shadowing")
        add_shadowing(search, seed)
    tell("other models")
    return Loop(best, records, folds, before, search, drivers_before, drivers_after,
                _baselines(before, records), _noise_floor_db(records))


def _drivers(model: Model, seed: int) -> list[Driver]:
    mean_db = model.held_out_mean_db
    scale_db = model.held_out_expected[1]
    return find_drivers(model.whole.records, model.whole.records.level_db - mean_db, scale_db, mean_db, seed)


def _baselines(model: Model, records: Records) -> dict[str, np.ndarray]:
    """(n,) held-out expectation of the log-distance law and of regression kriging [dB], at the base's positions."""
    result = {}
    for name, channel in (("log_distance", LogDistance), ("regression_kriging", RegressionKriging)):
        if name == "regression_kriging" and len(records) > MOST_FOR_KRIGING:
            continue
        mean_db = np.full(len(records), np.nan)
        for number, side in enumerate(model.folds):
            test = (model.index == number) & side.usable
            train, links = side.train, side.records
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of classes with few links: nothing is predicted for them here
                fitted = channel().fit(_links(links, train), links.level_db[train], links.limit_db, 0)
            expected_db, sigma_db = fitted.predict(_links(links, test))
            mean_db[test] = expected_db if links.limit_db is None else mean_if_detected(
                expected_db, sigma_db, links.limit_db)
        result[name] = mean_db
    return result


def _links(records: Records, rows: np.ndarray) -> Links:
    part = records.select(rows)
    return Links(part.device_m[part.device], part.receiver_m, part.los, part.device)


def _noise_floor_db(records: Records) -> float:
    """Standard deviation of one measurement [dB], from links measured more than once at one place."""
    place = np.round(np.column_stack([records.receiver_m, records.device, records.receiver]), 1)
    group = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    seen = np.isfinite(records.level_db)
    count = np.bincount(group[seen], minlength=group.max() + 1)
    mean = np.bincount(group[seen], weights=records.level_db[seen], minlength=len(count)) / np.maximum(count, 1)
    again = seen & (count[group] > 1)
    freedom = int((count[count > 1] - 1).sum())
    if freedom < 30:
        return float("nan")
    return float(np.sqrt(((records.level_db - mean[group])[again] ** 2).sum() / freedom))
