"""Measurements with a hidden effect, and the answer.

    case("missing_obstacle", 0).measurements    # what a user would have
    case("missing_obstacle", 0).scene           # what a user would declare
    case("missing_obstacle", 0).answer          # what neither of them says

A case reads its tables and draws the rest from its seed, in a fraction of a second and without a ray tracer.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene
from tests.undeclared import faults, tables
from tests.undeclared.cities import declared_scene
from tests.undeclared.families import (
    FAMILIES,
    GROUP,
    OUTSIDE,
    SEEDS,
    is_traced,
    rng_of,
    untraced,
    world_of,
)
from tests.undeclared.worlds import World

__all__ = ["FAMILIES", "OUTSIDE", "SEEDS", "Case", "case", "stored"]

NOISE_DB = 1.0
STEP_DB = 0.25  # of the receivers' readings


@dataclass(frozen=True, eq=False)
class Case:
    """One world's measurements; n = 10,800 links, in the order of `measurements.table`.

    Attributes:
        family, seed: which case.
        measurements: as the user has them; NaN gain = not detected.
        scene: as declared; it names no device.
        answer: `effects`, a list of what is hidden, each with its `name` and true parameters, and `device_m`, the
            true position of every unknown device [m].
        clean_gain_db: (n,) what ideal, infinitely sensitive receivers would read in this world, with all that is
            hidden in it (their faults, too) but without noise and steps [dB]; NaN where there is no path.
        plain_gain_db: (n,) the same in the same world with nothing hidden [dB].
    """

    family: str
    seed: int
    measurements: Measurements
    scene: Scene
    answer: dict
    clean_gain_db: np.ndarray
    plain_gain_db: np.ndarray


def case(family: str, seed: int) -> Case:
    """A case by its family (`FAMILIES`, `OUTSIDE`) and seed (`SEEDS`).

    Raises:
        KeyError: its tables are not stored.
        ValueError: no such family, or tables of an earlier draw.
    """
    if family not in GROUP:
        raise ValueError(f"family {family!r} does not exist; there are {', '.join(GROUP)}")
    where = world_of(family, seed)
    plain_db, effects = tables.load(tables.world_key(where.group, where.seed), where)
    traced_db = plain_db
    if is_traced(family, seed):
        traced_db, effects = tables.load(tables.case_key(family, seed), where)
    untraced_effects, arriving_db, clean_db = untraced(family, seed, traced_db)
    read_db = _read(clean_db, arriving_db, declared_scene(where.city).config.gain_limit_db,
                    rng_of(family, seed, "noise"))
    unknown = {where.names[row]: where.device_m[row].tolist() for row in np.flatnonzero(~where.is_anchor)}
    written_m = next((faults.written_m(effect, where) for effect in untraced_effects
                      if effect["name"] == "receiver_clock_offset"), where.points_m)
    measurements = Measurements(_links(where, written_m, read_db), _devices(where))
    return Case(family, seed, measurements, declared_scene(where.city),
                {"family": family, "effects": effects + untraced_effects, "device_m": unknown},
                clean_db.T.ravel(), plain_db.T.ravel())


def stored(family: str, seed: int) -> bool:
    """Return whether the tables of a case are there."""
    needed = {tables.world_key(GROUP[family], seed)}
    if is_traced(family, seed):
        needed.add(tables.case_key(family, seed))
    return needed <= tables.keys()


def _read(clean_db: np.ndarray, arriving_db: np.ndarray, limit_db: float, rng: np.random.Generator) -> np.ndarray:
    """(k, p) readings with noise, in steps; NaN where nothing is detected.

    A receiver detects what arrives above its noise and reports what it reads above its threshold. So a fault that
    raises its readings does not let it hear more, and one that lowers them makes it report less.
    """
    noise_db = rng.normal(0, NOISE_DB, clean_db.shape)
    with np.errstate(invalid="ignore"):
        detected = (arriving_db + noise_db >= limit_db) & (clean_db + noise_db >= limit_db)
    return np.where(detected, np.round((clean_db + noise_db) / STEP_DB) * STEP_DB, np.nan)


def _links(where: World, points_m: np.ndarray, read_db: np.ndarray) -> pd.DataFrame:
    devices, points = read_db.shape
    columns = {"time_s": where.time_s, "flight": np.array([f"f{number}" for number in where.flight], dtype=object),
               "receiver": np.array([f"uav{number}" for number in where.receiver], dtype=object)}
    columns |= {f"receiver_{axis}_m": points_m[:, i] for i, axis in enumerate("xyz")}
    table = {name: np.repeat(column, devices) for name, column in columns.items()}
    table |= {"device": np.tile(np.array(where.names, dtype=object), points), "gain_db": read_db.T.ravel()}
    for name in ("heading_deg", "pitch_deg", "roll_deg"):
        table[name] = np.repeat(getattr(where, name), devices)
    return pd.DataFrame(table)


def _devices(where: World) -> pd.DataFrame:
    """What is declared: where the anchors were put, as their owner believes, and the height of the others."""
    plane_m = np.where(where.is_anchor[:, None], where.device_m[:, :2], np.nan)
    return pd.DataFrame({"device": where.names, "x_m": plane_m[:, 0], "y_m": plane_m[:, 1],
                         "z_m": where.device_m[:, 2], "role": np.where(where.is_anchor, "anchor", "unknown")})
