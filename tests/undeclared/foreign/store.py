"""Traced paths of a world in one small archive: directions in steps of 1.4°, levels of 0.1 dB, legs of 0.5 m.

What is rounded is the truth: clean levels, levels with effects and the oracle's all come from it.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

from radiotwin.io.files import atomic_path
from tests.undeclared.foreign.paths import Paths
from tests.undeclared.foreign.worlds import World, all_names, world

FOLDER = Path(__file__).parent / "traces"
TOTAL_STEP_DB, BELOW_STEP_DB, LEG_STEP_M = 0.02, 0.1, 0.5
ELEVATION_STEP_RAD, AZIMUTH_STEP_RAD = np.pi / 2 / 127, 2 * np.pi / 256


def stored() -> list[str]:
    """Return the names of the worlds that are traced, calibrate and judge in turn."""
    return [name for name in all_names() if _path(name).is_file()]


def _path(name: str) -> Path:
    return FOLDER / f"{name}.npz"


def save(where: World, paths: list[Paths]) -> None:
    """Write the paths of a world: those of each of its devices with its points."""
    points = len(where.campaign.points_m)
    counts = np.concatenate([np.bincount(one.link, minlength=points) for one in paths])
    power, leaves, arrives, first, last, bounces = (
        np.concatenate([getattr(one, name) for one in paths])
        for name in ("power_db", "leaves_rad", "arrives_rad", "first_m", "last_m", "bounces"))
    direct = (bounces == 0)
    starts = np.cumsum(counts) - counts
    strongest = np.repeat(power[starts[counts > 0]], counts[counts > 0])
    angles = np.column_stack([leaves, arrives])
    angles[direct], first[direct], last[direct] = 0, 0, 0  # follow from the positions
    FOLDER.mkdir(exist_ok=True)
    with atomic_path(_path(where.name)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, positions=_positions(where), counts=counts.astype(np.uint8),
            strongest=np.round(power[starts[counts > 0]] / TOTAL_STEP_DB).astype(np.int16),
            below=np.round((strongest - power) / BELOW_STEP_DB).clip(0, 255).astype(np.uint8),
            elevations=np.round(angles[:, ::2] / ELEVATION_STEP_RAD).astype(np.int8),
            azimuths=(np.round(angles[:, 1::2] / AZIMUTH_STEP_RAD).astype(int) % 256).astype(np.uint8),
            first=np.round(first / LEG_STEP_M).astype(np.uint16), last=np.round(last / LEG_STEP_M).astype(np.uint16),
            bounces=bounces.astype(np.uint8))


@lru_cache(8)
def load(name: str) -> Paths:
    """Read the paths of a world; link = device * p + point. ValueError: traced for other positions than it has now."""
    where = world(name)
    with np.load(_path(name), allow_pickle=False) as archive:
        content = dict(archive.items())
    if not np.array_equal(content["positions"], _positions(where)):
        raise ValueError(f"{name}.npz belongs to an earlier draw of this world; delete it and run "
                         f"`python -m tests.undeclared.foreign.make --only {name}`")
    counts = content["counts"].astype(int)
    link = np.repeat(np.arange(len(counts)), counts)
    power_db = (np.repeat(content["strongest"] * TOTAL_STEP_DB, counts[counts > 0])
                - content["below"] * BELOW_STEP_DB)
    angles = np.empty((len(link), 4))
    angles[:, ::2] = content["elevations"] * ELEVATION_STEP_RAD
    angles[:, 1::2] = content["azimuths"] * AZIMUTH_STEP_RAD
    first_m, last_m = content["first"] * LEG_STEP_M, content["last"] * LEG_STEP_M
    bounces = content["bounces"].astype(int)
    points = len(where.campaign.points_m)
    direct = bounces == 0
    way_m = where.campaign.points_m[link[direct] % points] - where.device_m[link[direct] // points]
    length_m = np.linalg.norm(way_m, axis=1)
    elevation, azimuth = np.arcsin(way_m[:, 2] / length_m), np.arctan2(way_m[:, 1], way_m[:, 0])
    angles[direct] = np.column_stack([elevation, azimuth, -elevation, azimuth + np.pi])
    first_m[direct] = last_m[direct] = length_m
    return Paths(link, power_db, angles[:, :2], angles[:, 2:], first_m, last_m, bounces)


def _positions(where: World) -> np.ndarray:
    """Some of the positions that a trace depends on: enough to notice another draw of the world."""
    roofs = [(one.footprint_m[0, 0], one.footprint_m[0, 1], one.height_m) for one in where.true if one is not None]
    return np.round(np.concatenate([where.device_m, where.campaign.points_m[::50], roofs]) * 100).astype(np.int32)
