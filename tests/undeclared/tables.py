"""Traced gains in one archive: steps of 0.02 dB in 16 bits, a case as the difference from its world."""

import json
from functools import cache
from pathlib import Path

import numpy as np

from radiotwin.io.files import atomic_path
from tests.undeclared.worlds import World

PATH = Path(__file__).parent / "traces.npz"
STEP_DB = 0.02
NO_PATH = -32768


def world_key(group: str, seed: int) -> str:
    """Return the archive's name of a world with nothing hidden."""
    return f"world-{group}-{seed}"  # a group may be called as a family is


def case_key(family: str, seed: int) -> str:
    """Return the archive's name of a traced case."""
    return f"{family}-{seed}"


@cache
def keys() -> frozenset[str]:
    """Return the names of all tables in the archive."""
    if not PATH.is_file():
        return frozenset()
    with np.load(PATH, allow_pickle=False) as archive:
        return frozenset(name.split("/")[0] for name in archive.files)


def save(key: str, world: World, gain_db: np.ndarray, effects: list[dict]) -> None:
    """Add a table (k, p) to the archive, or replace it; the archive is rewritten as a whole or not at all."""
    steps = np.where(np.isnan(gain_db), NO_PATH, np.round(np.nan_to_num(gain_db) / STEP_DB)).astype(np.int16)
    content = {}
    if PATH.is_file():
        with np.load(PATH, allow_pickle=False) as archive:
            content = dict(archive.items())
    if effects:
        steps = steps - content[f"{world_key(world.group, world.seed)}/steps"]  # overflows, and `load` undoes it
    content |= {f"{key}/steps": steps, f"{key}/positions_m": _positions_m(world),
                f"{key}/effects": np.array(json.dumps(effects))}
    with atomic_path(PATH) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **content)
    keys.cache_clear()


def load(key: str, world: World) -> tuple[np.ndarray, list[dict]]:
    """Read a table: (k, p) gain [dB], NaN where there is no path, and the effects in it.

    ValueError: the table was traced for other positions than the world has now.
    """
    with np.load(PATH, allow_pickle=False) as archive:
        if not np.allclose(archive[f"{key}/positions_m"], _positions_m(world), atol=0.02):
            raise ValueError(f"{key} in {PATH.name} belongs to an earlier draw of this world; run "
                             f"`python -m tests.undeclared.make --only {key.rsplit('-', 1)[0]} --again`")
        steps, effects = archive[f"{key}/steps"], json.loads(str(archive[f"{key}/effects"]))
        if effects:
            steps = steps + archive[f"{world_key(world.group, world.seed)}/steps"]
    return np.where(steps == NO_PATH, np.nan, steps * STEP_DB), effects


def _positions_m(world: World) -> np.ndarray:
    """Return some of the positions that a trace depends on: enough to notice another draw of the world."""
    return np.concatenate([world.device_m, world.points_m[::90]]).astype(np.float32)
