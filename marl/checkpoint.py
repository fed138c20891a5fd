"""Write checkpoints atomically; read and validate them without executing anything in them.

The format is safetensors: arrays, and a JSON document that refers to them. Keys that begin with
`$` mark types that JSON lacks.

A checkpoint may come from a stranger. Before use, each part is compared with the form that this run
would have written, since compiled code does not check indices.
"""

import json
import math
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from marl.environment import ACTION_COUNT, feasible
from marl.mission import COSTS, MOVES, Mission
from radiotwin.errors import BadInput
from radiotwin.io.array_file import pack_arrays, parse_arrays
from radiotwin.io.budgets import CHECKPOINT_BYTES
from radiotwin.io.files import atomic_file
from radiotwin.io.inputs import parse_json, read_bytes
from radiotwin.links.plausible import MAX_LEVEL_DB
from radiotwin.maps.survey import HOVER_COST
from radiotwin.scene import Scene
from radiotwin.twin import Twin

NAME = "checkpoint.safetensors"
FORMAT = 7
_KEY = "checkpoint"
_MAX_NAME = 100  # longest name of a logged value [characters]


class Damaged(ValueError):
    """A checkpoint differs in form from what this run would have written."""


def save_checkpoint(state: dict, path: Path) -> None:
    """Write nested dicts and lists of numbers, texts, arrays, tensors and tables to a file.

    Tuples are read back as lists, and tables without their index, with columns that hold neither
    numbers nor booleans as texts. Keys that begin with `$` raise TypeError.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, "state": _packed(state, arrays)}, allow_nan=False)
    with atomic_file(path) as file:
        file.write(pack_arrays(arrays, _KEY, text))


def load_checkpoint(path: Path) -> dict:
    """Read the state written by `save_checkpoint`; the caller validates its content (`require`).

    Raises:
        BadInput: the file is damaged, or of another version.
    """
    arrays, text = parse_arrays(read_bytes(path, "checkpoint", CHECKPOINT_BYTES), _KEY, path)
    content = parse_json(text, path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadInput(
            f"{path} was written by another version of radiotwin, in a form that this one does "
            "not read; finish the run with that version, or remove its folder and start again")
    with refusing(path):
        state = _unpacked(content["state"], arrays)
        if arrays or not isinstance(state, dict):
            raise Damaged("parts belong to nothing")
        return state


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Convert exceptions raised by a damaged checkpoint into BadInput."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError,
            RecursionError) as error:
        raise BadInput(f"{path} is damaged ({type(error).__name__}: {str(error)[:200]}); remove "
                       "the run's folder and start again") from None


def _is_tensor(value: Any) -> bool:
    """Return whether a value is a tensor of torch, which is imported only where there are any."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Convert a value for JSON, moving its arrays to `arrays`."""
    if isinstance(value, pd.DataFrame):
        columns = {str(name): column.to_numpy() if column.dtype.kind in "fiub"
                   else [str(text) for text in column] for name, column in value.items()}
        return {"$table": _packed(columns, arrays)}
    if isinstance(value, np.generic):
        value = value.item()
    if _is_tensor(value):
        return {"$tensor": _packed(value.detach().cpu().numpy(), arrays)["$array"]}
    if isinstance(value, np.ndarray):
        name = str(len(arrays))
        arrays[name] = value
        return {"$array": name}
    if isinstance(value, float) and not math.isfinite(value):
        return {"$number": str(value)}
    if isinstance(value, dict):
        if not all(isinstance(name, str) and not name.startswith("$") for name in value):
            raise TypeError("the keys of a learner's state are texts that do not begin with $")
        return {name: _packed(each, arrays) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(each, arrays) for each in value]
    return value


def _unpacked(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Invert `_packed`, taking arrays out of `arrays`."""
    if isinstance(value, list):
        return [_unpacked(each, arrays) for each in value]
    if not isinstance(value, dict):
        return value
    if "$array" in value:
        return arrays.pop(value["$array"])
    if "$tensor" in value:
        import torch

        return torch.from_numpy(arrays.pop(value["$tensor"]).copy())
    if "$number" in value:
        return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[value["$number"]]
    if "$table" in value:
        return pd.DataFrame(_unpacked(value["$table"], arrays))
    return {name: _unpacked(each, arrays) for name, each in value.items()}


@dataclass(frozen=True)
class Within:
    """Form of an array: type and shape `like` another one, and a range of values without NaN."""

    like: np.ndarray
    low: ArrayLike
    high: ArrayLike


COUNT = range(10**15 + 1)
GENERATOR = {"bit_generator": "PCG64", "has_uint32": range(2), "uinteger": range(2**32),
             "state": {"state": range(2**128), "inc": range(2**128)}}
"""Form of a state of numpy's default generator."""


def require(value: Any, form: Any, what: str = "the state") -> Any:
    """Return a part of a checkpoint if it has a form; raise Damaged otherwise.

    Args:
        value: part of a stranger's file.
        form: required form. A dict: exactly these fields, each of its form. A list: one item of
            each form. A range: a whole number in it. A text: this text. A tensor: a finite one of
            its type and shape. `Within`: such an array. `...`: anything, checked elsewhere.
        what: name of the part, for messages.
    """
    match form:
        case dict():
            if not isinstance(value, dict) or set(value) != set(form):
                raise Damaged(f"{what} should have the fields {', '.join(sorted(form))}")
            for name, each in form.items():
                require(value[name], each, name)
        case list():
            if not isinstance(value, list) or len(value) != len(form):
                raise Damaged(f"{what} should be a list of {len(form)}")
            for part, each in zip(value, form):
                require(part, each, what)
        case range():
            if type(value) is not int or value not in form:
                raise Damaged(f"{what}, {str(value)[:40]}, should be a whole number from "
                              f"{form[0]} to {form[-1]}")
        case _ if _is_tensor(form):
            if not _is_tensor(value) or value.dtype != form.dtype \
                    or value.shape != form.shape or not value.isfinite().all():
                raise Damaged(f"{what} should be finite, of the shape {tuple(form.shape)}")
        case Within(like=like):
            if not isinstance(value, np.ndarray) or value.dtype != like.dtype \
                    or value.shape != like.shape:
                raise Damaged(f"{what} should be {like.dtype.name} of the shape {like.shape}")
            if not ((value >= form.low) & (value <= form.high)).all():
                raise Damaged(f"{what} should be from {form.low!s} to {form.high!s}")
        case _:
            if form is not ... and value != form:
                raise Damaged(f"{what} should be {form!r}")
    return value


def require_log(records: Any, counts: Collection[str], others: Collection[str] = (),
                largest: float = math.inf) -> list[dict]:
    """Return the records of a log, name -> number, if they are valid; raise Damaged otherwise.

    `counts` are required whole numbers from 0, `others` required numbers. More names are allowed.
    All values but counts are numbers within ±`largest`, or NaN; whole ones are from 0.
    """
    if not isinstance(records, list):
        raise Damaged("a log should be a list")
    for record in records:
        if not {*counts, *others} <= set(record):
            raise Damaged(f"a log should have {', '.join((*counts, *others))}")
        for name, value in record.items():
            if not 0 < len(name) <= _MAX_NAME or not name.isprintable():
                raise Damaged(f"{name[:_MAX_NAME]!r} is no name")
            if name in counts or type(value) is int:
                require(value, COUNT, name)
            elif type(value) not in (bool, float) or abs(value) > largest:
                raise Damaged(f"{name}, {str(value)[:40]}, should be a number")
    return records


def require_plan(actions: Any, mission: Mission) -> np.ndarray:
    """Return actions (T, U) if they are feasible in a mission; raise Damaged otherwise."""
    require(actions, Within(np.zeros((mission.longest, mission.uavs), np.int8), 0,
                            ACTION_COUNT - 1), "a plan")
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


def require_tables(tables: list, scene: Scene) -> list[pd.DataFrame]:
    """Return tables of measurements if a scene's UAVs can have made them, else raise Damaged."""
    config, lattice = scene.config, scene.lattice
    slots = [uav.battery / HOVER_COST + 1 for uav in config.uavs]
    for flight, table in enumerate(tables):
        known = {"flight": [f"f{flight}"], "receiver": [uav.uav for uav in config.uavs],
                 "device": [device.device for device in config.devices]}
        ranges = {"time_s": (0.0, config.mission.slot_s * max(slots) * (flight + 1)),
                  "heading_deg": (0.0, 360.0), "gain_db": (-MAX_LEVEL_DB, MAX_LEVEL_DB)} | {
            f"receiver_{axis}_m": (values.min(), values.max())
            for axis, values in zip("xyz", (lattice.x_m, lattice.y_m, lattice.z_m), strict=True)}
        if not isinstance(table, pd.DataFrame) or set(table) != set(known) | set(ranges):
            raise Damaged("a table of measurements has other columns")
        if not 1 <= len(table) <= sum(slots) * len(config.devices):
            raise Damaged("a flight measures more links, or fewer")
        for name, values in known.items():
            if not table[name].isin(values).all():
                raise Damaged(f"{name} of a measurement is none of this run")
        for name, (low, high) in ranges.items():
            column = table[name]
            blank = column.isna() & (name == "gain_db")
            if column.dtype != float or not (column.between(low, high) | blank).all():
                raise Damaged(f"{name} of a measurement is no number from {low:g} to {high:g}")
    return tables


def keep_twin(twin: Twin, folder: Path) -> dict:
    """Write a twin to the subfolder `twin` of a run; return its entry in a checkpoint."""
    twin.save(folder / "twin")
    record, channel = twin.encode()
    return {"record": record, "channel": np.frombuffer(channel, np.uint8)}


def stored_twin(content: Any, path: Path, scene: Scene) -> Twin:
    """Decode the twin of a checkpoint; raise Damaged if it is not of the scene's devices."""
    if set(content) != {"record", "channel"} or not isinstance(content["record"], str):
        raise Damaged("the twin is not a text and bytes")
    channel = np.asarray(content["channel"])
    require(content["channel"], Within(np.empty(channel.size, np.uint8), 0, 255), "the channel")
    twin = Twin.decode(content["record"], channel.tobytes(), f"the twin in {path}")
    if [each.device for each in twin.devices] != [each.device for each in scene.config.devices] \
            or twin.level != "gain_db":
        raise Damaged("the twin is of other devices")
    return twin
