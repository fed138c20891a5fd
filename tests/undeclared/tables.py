"""Traced gains on disk: 0.02 dB steps in 16 bits, a case's table as the difference from its world's."""

import json
from pathlib import Path

import numpy as np

from radiotwin.files import atomic_path
from tests.undeclared.worlds import World

FOLDER = Path(__file__).parent / "tables"
STEP_DB = 0.02
NO_PATH = -32768


def path_of(family: str, seed: int) -> Path:
    """File of a case's trace."""
    return FOLDER / f"{family}-{seed}.npz"


def save(path: Path, world: World, gain_db: np.ndarray, effects: list[dict]) -> None:
    """Write a table, whole or not at all.

    Args:
        path: see `path_of`.
        world: of the table.
        gain_db: (k, p), NaN where there is no path.
        effects: that the trace contains.
    """
    steps = np.where(np.isnan(gain_db), NO_PATH, np.round(np.nan_to_num(gain_db) / STEP_DB)).astype(np.int16)
    if effects:
        steps = steps - _steps(world_path(world))  # wraps round, and back again
    path.parent.mkdir(exist_ok=True)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, steps=steps, places_m=_places_m(world), effects=np.array(json.dumps(effects)))


def load(path: Path, world: World) -> tuple[np.ndarray, list[dict]]:
    """(k, p) gain [dB], NaN where there is no path, and the effects in it.

    Raises:
        ValueError: the table was traced for other places than the world has now.
    """
    with np.load(path, allow_pickle=False) as table:
        if not np.allclose(table["places_m"], _places_m(world), atol=0.02):
            raise ValueError(f"{path.name} belongs to an earlier draw of this world; delete it and run "
                             "`python -m tests.undeclared.make`")
        steps, effects = table["steps"], json.loads(str(table["effects"]))
    if effects:
        steps = steps + _steps(world_path(world))
    return np.where(steps == NO_PATH, np.nan, steps * STEP_DB), effects


def world_path(world: World) -> Path:
    """File of the trace of a world with nothing hidden."""
    return FOLDER / f"world-{world.group}-{world.seed}.npz"  # a group may be called as a family is


def _steps(path: Path) -> np.ndarray:
    with np.load(path, allow_pickle=False) as table:
        return table["steps"]


def _places_m(world: World) -> np.ndarray:
    """Some of the places that a trace depends on: enough to notice that a world is not what it was."""
    return np.concatenate([world.device_m, world.points_m[::90]]).astype(np.float32)
