"""All that studies use of `radiotwin.closeloop` beyond `closeloop.json` and public functions."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pandas as pd

from radiotwin import Loop, Measurements, Scene
from radiotwin.closeloop.bases import TwinBase
from radiotwin.closeloop.folds import make_folds
from radiotwin.closeloop.locate import Corrected, calibrated_temper, locate, whole_area
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import make_records
from radiotwin.closeloop.search import Model, make_model, rmse_db
from radiotwin.effects.sector_antenna import SectorAntenna
from tests.undeclared.cases import case

STEP_DB, DOF = 0.25, 5.0  # of the levels and errors that `draw_from_base` makes
DEVICES_A_FOLD = 150  # that are located


def base_rmse_db(measurements: Measurements, scene: Scene, base: str, hold_out: str) -> float:
    """Return the held-out error of a base (`twin`, `raytrace`) without effects [dB]."""
    records, twin = make_records(measurements, scene), TwinBase(scene, 0)
    kind = {"twin": twin, "raytrace": RaytraceBase(twin)}[base]
    model = make_model(records, kind, make_folds(records, 0, hold_out))
    return rmse_db(model, np.ones(len(records), dtype=bool))


def draw_from_base(world: int, base: str, seed: int) -> Measurements:
    """Return the case `nothing`, `world`, with levels drawn from a base that was fitted to it.

    Errors are Student's t with the fitted scale; levels are in the receivers' steps, and blank
    below the limit.
    """
    measurements = case("nothing", world).measurements
    side, fit = _fitted(world, base)
    errors = np.random.default_rng(seed).standard_t(DOF, len(side.records))
    level_db = side.expect(fit).mean_db + fit.scale_db[side.group] * errors
    level_db = np.round(level_db / STEP_DB) * STEP_DB
    table = measurements.table.copy()
    table["gain_db"] = np.where(level_db >= side.records.limit_db, level_db, np.nan)
    # A device that the base could not locate has no links in its world.
    return Measurements(table[side.usable].reset_index(drop=True), measurements.devices)


@lru_cache
def _fitted(world: int, base: str) -> tuple:
    hidden = case("nothing", world)
    records, twin = make_records(hidden.measurements, hidden.scene), TwinBase(hidden.scene, 0)
    learnt = {"twin": twin, "raytrace": RaytraceBase(twin)}[base].fit(records)
    side = Side.make(records, np.ones(len(records), dtype=bool), learnt, DOF)
    return side, side.fit()


def named_rmse_db(loop: Loop) -> float:
    """Return the held-out error with the named effects, without interpolation of the rest [dB]."""
    return rmse_db(loop.search.explained, np.ones(len(loop.records), dtype=bool))


def turned_rmse_db(loop: Loop) -> float:
    """Return the same with every sector antenna turned by 180° and all else fitted again [dB]."""
    model, sides, fits = loop.search.explained, [], []
    for side in model.sides:
        parts = []
        for part in side.parts:
            if isinstance(part.effect, SectorAntenna):
                turned = {device: [pattern[0] + 180.0, *pattern[1:]]
                          for device, pattern in part.setting["devices"].items()}
                part = side.part(part.effect, {"devices": turned})
            parts.append(part)
        sides.append(side.with_parts(parts))
        fits.append(sides[-1].fit())
    turned_model = Model(sides[0], sides[1:], fits, model.index)
    return rmse_db(turned_model, np.ones(len(model.index), dtype=bool))


def locate_held_out(loop: Loop, after: bool) -> pd.DataFrame:
    """Locate devices of each fold by what was learnt from the others, with calibrated radii.

    Args:
        loop: with a flight a fold.
        after: with the effects, or by the base alone.

    Returns:
        A row for each of at most 150 devices a fold: `flight`, `error_m`, `radius_m` (90 %).
    """
    model, records = loop.after if after else loop.before, loop.records
    models = [Corrected.of(side, fit) for side, fit in zip(model.folds, model.fits[1:])]
    folds = [records.select(model.index == index) for index in range(len(models))]
    area_m, rng, rows = whole_area(models[0], records), np.random.default_rng(0), []
    for index, (corrected, fold) in enumerate(zip(models, folds)):
        others, elsewhere = (each[:index] + each[index + 1:] for each in (models, folds))
        power = calibrated_temper(others, elsewhere, area_m, 0)
        chosen = rng.permutation(np.unique(fold.device))[:DEVICES_A_FOLD]
        asked = fold.select(np.isin(fold.device, chosen))
        for found in locate(replace(corrected, temper=power), asked, area_m):
            away_m = records.device_m[found.device, :2] - (found.x_m, found.y_m)
            rows.append({"flight": fold.flight_names[fold.flight[0]], "error_m": np.hypot(*away_m),
                         "radius_m": found.radius_m})
    return pd.DataFrame(rows)
