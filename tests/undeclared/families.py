"""Which effects a family hides, in which worlds, and how they are drawn."""

import zlib

import numpy as np

from tests.undeclared import faults, hidden, losses, outside
from tests.undeclared.worlds import World, world

SEEDS = range(5)
GROUP = {
    "nothing": "receivers", "receiver_gain_offset": "receivers", "receiver_drift": "receivers",
    "receiver_saturation": "receivers", "excess_attenuation": "receivers", "device_drift": "receivers",
    "receiver_clock_offset": "receivers",
    "foliage": "devices", "antenna_pattern": "devices", "device_position_error": "devices",
    "missing_obstacle": "obstacles", "removed_obstacle": "obstacles", "pairs": "pairs",
    "duty_cycled_jammer": "receivers", "agc_hysteresis": "receivers", "refractive_fading": "receivers",
}
OUTSIDE = ("duty_cycled_jammer", "agc_hysteresis", "refractive_fading")
BEFORE_RECEIVERS = ("foliage", "excess_attenuation", "refractive_fading", "device_drift")
FAMILIES = tuple(name for name in GROUP if name not in OUTSIDE)
DIPOLE_SEEDS, STEP_SEEDS = (3, 4), (3, 4)  # of antenna_pattern, and of the two drifts: the second kind of each
PAIRS = (("missing_obstacle", "receiver_drift"), ("device_position_error", "antenna_pattern"),
         ("foliage", "receiver_gain_offset"), ("missing_obstacle", "device_position_error"),
         ("removed_obstacle", "receiver_saturation"))


def world_of(family: str, seed: int) -> World:
    """The world of a case."""
    return world(GROUP[family], seed)


def names(family: str, seed: int) -> tuple[str, ...]:
    """Names of the effects that a case hides."""
    if family == "nothing":
        return ()
    return PAIRS[seed] if family == "pairs" else (family,)


def rng_of(family: str, seed: int, name: str) -> np.random.Generator:
    """Random numbers for one purpose of one case."""
    return np.random.default_rng([seed, zlib.crc32(f"{family}/{name}".encode())])


def is_traced(family: str, seed: int) -> bool:
    """Whether a case has a trace of its own beside that of its world."""
    return any(name in hidden.TRACED for name in names(family, seed))


def traced_effects(family: str, seed: int) -> list[dict]:
    """The effects of a case that its trace must contain; slow where buildings are tried one by one."""
    found = []
    for name in names(family, seed):
        if name not in hidden.TRACED:
            continue
        rng, where = rng_of(family, seed, name), world_of(family, seed)
        if name != "antenna_pattern":
            found.append(getattr(hidden, name)(where, rng))
        elif family == "antenna_pattern" and seed in DIPOLE_SEEDS:
            found.append(hidden.tilted_dipole(where, rng))
        else:
            moved = next((effect["device"] for effect in found if effect["name"] == "device_position_error"), None)
            found.append(hidden.sector_antenna(where, rng, but=moved))
    return found


def untraced(family: str, seed: int, clean_db: np.ndarray) -> tuple[list[dict], np.ndarray, np.ndarray]:
    """Draw and apply the effects that need no trace, those in the air before those in the receivers.

    Returns entries of the answer, what arrives at the receivers, and what they would read without noise (k, p) [dB].
    """
    where, found, arriving_db = world_of(family, seed), [], clean_db
    for name in sorted(names(family, seed), key=lambda name: name.startswith("receiver")):
        rng = rng_of(family, seed, name)
        if name == "foliage":
            found.append(losses.foliage(where, rng))
            clean_db = clean_db - losses.foliage_loss_db(found[-1], where.device_m, where.points_m)
        elif name == "excess_attenuation":
            found.append(losses.excess_attenuation(where, rng))
            clean_db = clean_db - losses.haze_loss_db(found[-1], where.device_m, where.points_m)
        elif name == "receiver_clock_offset":  # of places; levels stay
            found.append(faults.receiver_clock_offset(where, rng))
        elif name in OUTSIDE:
            found.append(getattr(outside, name)(where, rng, clean_db))
            clean_db = outside.reading_db(found[-1], where, clean_db)
        elif name not in hidden.TRACED:
            second = family != "pairs" and seed in STEP_SEEDS
            draw = {"receiver_drift": faults.step if second else faults.warm_up,
                    "device_drift": faults.device_change if second else faults.battery}
            found.append((draw.get(name) or getattr(faults, name))(where, rng, clean_db))
            clean_db = faults.reading_db(found[-1], where, clean_db)
        if name in BEFORE_RECEIVERS:
            arriving_db = clean_db
    return found, arriving_db, clean_db
