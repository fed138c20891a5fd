"""Checkpoints: written whole or not at all, and read without executing anything in them.

The format is that of safetensors: arrays, and a JSON document that refers to them. A key that
begins with `$` marks what JSON has no form for.

All that a run resumes from is checked against its mission before it is used: compiled code checks
no index.
"""

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike

from marl.environment import ACTION_COUNT, feasible
from marl.learner import Learner
from marl.mission import COSTS, MOVES, Mission
from marl.settings import RunSettings
from radiotwin.errors import BadInput
from radiotwin.io.array_file import pack_arrays, parse_arrays
from radiotwin.io.budgets import CHECKPOINT_BYTES
from radiotwin.io.files import atomic_file
from radiotwin.io.inputs import parse_json, read_bytes
from radiotwin.links.cell_limits import MAX_LEVEL_DB
from radiotwin.maps.survey import HOVER_COST
from radiotwin.scene import Scene
from radiotwin.twin import Twin

NAME = "checkpoint.safetensors"
FORMAT = 4
_KEY = "checkpoint"
MAX_COUNT = 10**15
_GENERATOR = {"state": 2**128, "inc": 2**128, "has_uint32": 2, "uinteger": 2**32}
_COUNTS = ("round", "real_episodes", "simulated_episodes", "located", "evaluation_flights")
_NUMBERS = ("truth_ratio", "truth_ratio_std", "twin_ratio", "location_error_median_m",
            "location_error_worst_m", "learn_twin_s", "round_s")
_MAX_NUMBER = 1e30  # of a logged one; it may be NaN, but not infinite
_MAX_NAME = 100  # characters of what a learner logs


class Damaged(ValueError):
    """A checkpoint holds something else than this run would have written."""


def save_checkpoint(state: dict, path: Path) -> None:
    """Write dicts and lists of numbers, texts, arrays, tensors and tables; all keys are texts."""
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, "state": _packed(state, arrays)}, allow_nan=False)
    with atomic_file(path) as file:
        file.write(pack_arrays(arrays, _KEY, text))


def load_checkpoint(path: Path) -> dict:
    """Return what `save_checkpoint` was given; what it means is for the reader to check.

    Raises:
        BadInput: it is damaged, or of another version.
    """
    arrays, text = parse_arrays(read_bytes(path, "checkpoint", CHECKPOINT_BYTES), _KEY, path)
    content = parse_json(text, path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadInput(
            f"{path} was written by another version of radiotwin, in a form that this one does "
            "not read; finish the run with that version, or remove its folder and start again")
    try:
        state = _unpacked(content["state"], arrays)
        if arrays or not isinstance(state, dict):
            raise Damaged("parts belong to nothing")
        return state
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        refuse_damaged(path, error)


def refuse_damaged(path: Path, error: Exception) -> NoReturn:
    """Raise the message of a damaged checkpoint, BadInput."""
    raise BadInput(f"{path} is damaged ({type(error).__name__}: {str(error)[:200]}); remove the "
                   "run's folder and start again") from None


def _packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a value as JSON has it, and add its arrays to `arrays`."""
    if isinstance(value, pd.DataFrame):
        return {"$table": {str(name): _packed_column(column, arrays)
                           for name, column in value.items()}}
    if isinstance(value, torch.Tensor):
        return {"$tensor": _named(value.detach().cpu().numpy(), arrays)}
    if isinstance(value, np.ndarray):
        return {"$array": _named(value, arrays)}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return {"$number": str(value)}
    if isinstance(value, dict):
        if not all(isinstance(name, str) and not name.startswith("$") for name in value):
            raise TypeError("the keys of a learner's state are texts that do not begin with $")
        return {name: _packed(each, arrays) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(each, arrays) for each in value]
    return value


def _packed_column(column: pd.Series, arrays: dict[str, np.ndarray]) -> Any:
    if column.dtype.kind in "fiub":
        return _packed(column.to_numpy(), arrays)
    codes, texts = pd.factorize(column)
    return {"$texts": [str(text) for text in texts], "codes": _packed(codes, arrays)}


def _named(array: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    name = str(len(arrays))
    arrays[name] = array
    return name


def _unpacked(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return what `_packed` was given, and take its arrays from `arrays`."""
    if isinstance(value, list):
        return [_unpacked(each, arrays) for each in value]
    if not isinstance(value, dict):
        return value
    if "$array" in value:
        return arrays.pop(value["$array"])
    if "$tensor" in value:
        return torch.from_numpy(arrays.pop(value["$tensor"]).copy())
    if "$number" in value:
        return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[value["$number"]]
    if "$texts" in value:
        codes = _unpacked(value["codes"], arrays)
        return np.array(value["$texts"], dtype=object)[codes]
    if "$table" in value:
        return pd.DataFrame(_unpacked(value["$table"], arrays))
    return {name: _unpacked(each, arrays) for name, each in value.items()}


def require_fields(state: Any, names: Collection[str]) -> dict:
    """Return a dict that has these names and no others; raise Damaged for anything else."""
    if not isinstance(state, dict) or set(state) != set(names):
        raise Damaged(f"a part should have the fields {', '.join(sorted(names))}")
    return state


def require_count(value: Any, high: int = MAX_COUNT) -> int:
    """Return a whole number from 0 to `high`; raise Damaged for anything else."""
    if type(value) is not int or not 0 <= value <= high:
        raise Damaged(f"{str(value)[:40]} should be a whole number from 0 to {high}")
    return value


def require_array(value: Any, like: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return an array of a type and shape, and within a range; raise Damaged for anything else.

    NaN is outside every range.
    """
    if not isinstance(value, np.ndarray) or value.dtype != like.dtype or value.shape != like.shape:
        raise Damaged(f"an array should be {like.dtype.name} of the shape {like.shape}")
    if not ((value >= low) & (value <= high)).all():
        raise Damaged(f"an array should hold numbers from {low!s} to {high!s}")
    return value


def require_tensors(given: Any, like: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return finite tensors of these names, types and shapes; raise Damaged for anything else."""
    for name, tensor in require_fields(given, like).items():
        if not isinstance(tensor, torch.Tensor) or tensor.dtype != like[name].dtype \
                or tensor.shape != like[name].shape or not tensor.isfinite().all():
            raise Damaged(f"weights {name} should be finite, of the shape "
                          f"{tuple(like[name].shape)}")
    return given


def require_generator(state: Any) -> dict:
    """Return a state of numpy's default generator; raise Damaged for anything else."""
    require_fields(state, ("bit_generator", "state", "has_uint32", "uinteger"))
    require_fields(state["state"], ("state", "inc"))
    for name, end in _GENERATOR.items():
        require_count((state if name in state and name != "state" else state["state"])[name],
                      end - 1)
    if state["bit_generator"] != "PCG64":
        raise Damaged("the generator of random numbers is another one")
    return state


def require_plan(actions: Any, mission: Mission) -> np.ndarray:
    """Return (T, U) actions that can be flown in a mission; raise Damaged for anything else.

    The mission's map does not matter.
    """
    like = np.zeros((mission.longest, mission.uavs), np.int8)
    require_array(actions, like, 0, ACTION_COUNT - 1)
    possible = np.zeros(ACTION_COUNT, dtype=np.bool_)
    for uav in range(mission.uavs):
        (row, column), battery = map(int, mission.start[uav]), int(mission.battery[uav])
        for action in map(int, actions[:, uav]):
            feasible(mission, uav, row, column, battery, possible)
            if not possible[action]:
                raise Damaged("a plan leaves the map, or does not come home")
            row, column = row + int(MOVES[action, 0]), column + int(MOVES[action, 1])
            battery -= int(COSTS[action])
    return actions


def restored(path: Path, run: RunSettings, scene: Scene,
             learner: Learner) -> tuple[list[dict], list[dict], list[pd.DataFrame], Twin | None]:
    """Read a checkpoint, and have the learner go on from it.

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
    """Return `least` to `most` rows of a log; raise Damaged for anything else."""
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
    """Return a number of a log, which may be NaN; raise Damaged for anything else."""
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


def keep_twin(twin: Twin, folder: Path) -> dict:
    """Write a twin to the folder `twin` in a run's; return it as a checkpoint has it."""
    twin.save(folder / "twin")
    record, channel = twin.encode()
    return {"record": record, "channel": np.frombuffer(channel, np.uint8)}


def stored_twin(content: Any, path: Path, scene: Scene) -> Twin:
    """Return the twin of a checkpoint; raise Damaged if it is not of the scene's devices."""
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
