"""State that a run resumes from, checked against the mission before it is used."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marl.checkpoint import (
    NAME,
    OLD_NAME,
    Damaged,
    load_checkpoint,
    refuse_damaged,
    refuse_old,
    require_count,
    require_fields,
)
from marl.learner import Learner
from marl.settings import RunSettings
from radiotwin.links.measurements import MAX_LEVEL_DB
from radiotwin.maps.survey import HOVER_COST
from radiotwin.scene import Scene
from radiotwin.twin import Twin

_COUNTS = ("round", "real_episodes", "simulated_episodes", "located", "evaluation_flights")
_NUMBERS = ("truth_ratio", "truth_ratio_std", "twin_ratio", "location_error_median_m",
            "location_error_worst_m", "learn_twin_s", "round_s")
_MAX_NUMBER = 1e30  # of a logged one; it may be NaN, but not infinite
_MAX_NAME = 100  # characters of what a learner logs


def has_checkpoint(folder: Path) -> bool:
    """Return whether a run's folder has a checkpoint.

    Raises:
        BadInput: it has one of an earlier version.
    """
    if (folder / OLD_NAME).exists():
        refuse_old(folder / OLD_NAME)
    return (folder / NAME).exists()


def restored(path: Path, run: RunSettings, scene: Scene,
             learner: Learner) -> tuple[list[dict], list[dict], list[pd.DataFrame], Twin | None]:
    """Read a checkpoint, and have the learner go on from it.

    Args:
        path: of the checkpoint.
        run: settings of the run.
        scene: its devices and UAVs.
        learner: its state is loaded.

    Returns:
        rows and blocks of the log, the measurements, and the twin; None where none is needed.

    Raises:
        BadInput: it is damaged, or not of this run.
    """
    state = load_checkpoint(path)
    try:
        has_twin = run.twin != "truth"
        require_fields(state, ("rows", "blocks", "tables", "strategy", *["twin"] * has_twin))
        rows, blocks = check_rows(state["rows"], 1, run.real_episodes), _blocks(state["blocks"])
        tables = state["tables"]
        if not isinstance(tables, list) or len(tables) != len(rows) * has_twin:
            raise Damaged("each round has one table of measurements")
        for number, table in enumerate(tables):
            check_table(table, number, scene)
        learner.load_state(state["strategy"])
        twin = stored_twin(state["twin"], path, scene) if has_twin else None
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        refuse_damaged(path, error)
    return rows, blocks, tables, twin


def check_rows(rows: Any, least: int, most: int) -> list[dict]:
    """Return the rows of a log after a check that there are `least` to `most` of them.

    Raises:
        Damaged: there are not, or they are none.
    """
    if not isinstance(rows, list) or not least <= len(rows) <= most:
        raise Damaged(f"a run has {least} to {most} rounds")
    for number, row in enumerate(rows):
        require_fields(row, (*_COUNTS, *_NUMBERS))
        for name in _COUNTS:
            require_count(row[name])
        for name in _NUMBERS:
            require_number(row[name])
        if row["round"] != number + 1:
            raise Damaged("rounds are not in order")
    return rows


def _blocks(blocks: Any) -> list[dict]:
    if not isinstance(blocks, list):
        raise Damaged("blocks of training are missing")
    for block in blocks:
        for name in ("round", "episodes"):
            require_count(block[name])
        for name, value in block.items():
            if not 0 < len(name) <= _MAX_NAME or not name.isprintable():
                raise Damaged(f"{name[:_MAX_NAME]!r} is no name")
            # A learner of one's own may log whether it has converged, and diverge.
            if type(value) not in (bool, int, float):
                raise Damaged(f"{str(value)[:40]} should be a number")
    return blocks


def require_number(value: Any) -> float:
    """Return a number of a log after a check.

    Raises:
        Damaged: it is none.
    """
    if type(value) not in (int, float) or not (math.isnan(value) or abs(value) <= _MAX_NUMBER):
        raise Damaged(f"{str(value)[:40]} should be a number")
    return value


def check_table(table: Any, number: int, scene: Scene) -> None:
    """Refuse a table of a flight that this scene's UAVs cannot have measured."""
    config, lattice = scene.config, scene.lattice
    known = {"flight": [f"f{number}"], "receiver": [uav.uav for uav in config.uavs],
             "device": [device.device for device in config.devices]}
    slots = max(uav.battery for uav in config.uavs) / HOVER_COST + 1
    ranges = {"time_s": (0.0, config.mission.slot_s * slots * (number + 1)),
              "heading_deg": (0.0, 360.0), "gain_db": (-MAX_LEVEL_DB, MAX_LEVEL_DB)} | {
        f"receiver_{axis}_m": (values.min(), values.max())
        for axis, values in zip("xyz", (lattice.x_m, lattice.y_m, lattice.z_m), strict=True)}
    if not isinstance(table, pd.DataFrame) or set(table) != set(known) | set(ranges):
        raise Damaged("a table of measurements has other columns")
    longest = sum(uav.battery / HOVER_COST + 1 for uav in config.uavs) * len(config.devices)
    if not 1 <= len(table) <= longest:
        raise Damaged(f"a flight measures 1 to {longest:.0f} links")
    for name, values in known.items():
        if not table[name].isin(values).all():
            raise Damaged(f"{name} of a measurement is none of this run")
    for name, (low, high) in ranges.items():
        column = table[name]
        blank = column.isna() & (name == "gain_db")
        if column.dtype != float or not (column.between(low, high) | blank).all():
            raise Damaged(f"{name} of a measurement is no number from {low:g} to {high:g}")


def stored_twin(content: Any, path: Path, scene: Scene) -> Twin:
    """Return the twin of a checkpoint after a check that it is of the scene's devices.

    Raises:
        Damaged: it is not.
    """
    require_fields(content, ("record", "channel"))
    channel = content["channel"]
    if not isinstance(content["record"], str) or not isinstance(channel, np.ndarray) \
            or channel.dtype != np.uint8 or channel.ndim != 1:
        raise Damaged("the twin is not a text and bytes")
    twin = Twin.decode(content["record"], channel.tobytes(), f"the twin in {path}")
    if [each.device for each in twin.devices] != [each.device for each in scene.config.devices] \
            or twin.level != "gain_db":
        raise Damaged("the twin is of other devices")
    return twin
