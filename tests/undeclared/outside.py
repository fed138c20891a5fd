"""Three effects that no catalogue of the product has: a jammer, a clumsy gain control, and bending air."""

import numpy as np

from tests.undeclared.cities import RADIO, SIDE_M
from tests.undeclared.worlds import UAVS, World

LIGHT_M_S = 299_792_458.0


def duty_cycled_jammer(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """A sender in the ground of one quarter that is on for part of each period; its power adds to what is read.

    It is heard where its distance is below `reach_m`: beyond, its own roof hides it.
    """
    return {"name": "duty_cycled_jammer", "centre_m": rng.uniform(120, SIDE_M - 120, 2).round(1).tolist(),
            "relative_power_db": round(float(rng.uniform(-12, -4)), 1), "reach_m": round(float(rng.uniform(130, 200))),
            "period_s": round(float(rng.uniform(15, 40)), 1), "on_share": round(float(rng.uniform(0.35, 0.65)), 2)}


def agc_hysteresis(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """All receivers switch gain in coarse steps that are not quite what their tables say, and switch back late."""
    middle_db = np.nanquantile(clean_db, 0.55)
    edges_db = middle_db + np.array([-12.0, 0.0, 12.0]) + rng.uniform(-2, 2, 3)
    errors_db = rng.choice([-1, 1]) * np.array([0, 1, -0.6, 1.2]) * rng.uniform(3, 5)
    return {"name": "agc_hysteresis", "edges_db": edges_db.round(1).tolist(), "errors_db": errors_db.round(2).tolist(),
            "hysteresis_db": round(float(rng.uniform(4, 8)), 1)}


def refractive_fading(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """Layers of air off the water bend far links together, up and down over minutes."""
    return {"name": "refractive_fading", "from_m": round(float(rng.uniform(170, 230))),
            "amplitudes_db": rng.uniform(2, 4.5, 3).round(2).tolist(),
            "periods_s": [round(float(value)) for value in rng.uniform((150, 400, 900), (300, 700, 1500))],
            "phases_rad": rng.uniform(0, 2 * np.pi, 3).round(3).tolist()}


def reading_db(effect: dict, world: World, level_db: np.ndarray) -> np.ndarray:
    """What the receivers read in place of the level (k, p) at their antennas in quiet air; (k, p) [dB]."""
    return {"duty_cycled_jammer": _jammed, "agc_hysteresis": _switched, "refractive_fading": _bent}[effect["name"]](
        effect, world, level_db)


def _jammed(effect: dict, world: World, level_db: np.ndarray) -> np.ndarray:
    away_m = np.hypot(np.hypot(*(world.points_m[:, :2] - effect["centre_m"]).T), world.points_m[:, 2])
    friis_db = 20 * np.log10(LIGHT_M_S / (4 * np.pi * RADIO[world.city].frequency_hz * away_m))
    on = (world.time_s % effect["period_s"]) < effect["on_share"] * effect["period_s"]
    jam = np.where(on & (away_m < effect["reach_m"]), 10 ** ((friis_db + effect["relative_power_db"]) / 10), 0.0)
    return 10 * np.log10(10 ** (level_db / 10) + jam)


def _switched(effect: dict, world: World, level_db: np.ndarray) -> np.ndarray:
    """Each receiver hears the devices of a slot one after another, and keeps its gain until an edge is well passed."""
    edges, late = np.array(effect["edges_db"]), effect["hysteresis_db"] / 2
    errors = np.array(effect["errors_db"])
    read_db = level_db.copy()
    for uav in range(UAVS):
        state = 0
        for point in np.flatnonzero(world.receiver == uav):
            for device, level in enumerate(level_db[:, point].tolist()):
                if np.isnan(level):
                    continue
                while state < len(edges) and level > edges[state] + late:
                    state += 1
                while state > 0 and level < edges[state - 1] - late:
                    state -= 1
                read_db[device, point] = level + errors[state]
    return read_db


def _bent(effect: dict, world: World, level_db: np.ndarray) -> np.ndarray:
    away_m = np.linalg.norm(world.points_m[None] - world.device_m[:, None], axis=-1)
    far = np.clip((away_m - effect["from_m"]) / 60, 0, 1)
    waves = zip(effect["amplitudes_db"], effect["periods_s"], effect["phases_rad"])
    fade_db = sum(a * np.sin(2 * np.pi * world.time_s / period + phase) for a, period, phase in waves)
    return level_db + far * fade_db
