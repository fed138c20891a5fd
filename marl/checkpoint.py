"""Checkpoints: written whole or not at all, and read without executing anything in them.

The format is that of safetensors: arrays, and a JSON document that refers to them. A key that
begins with `$` marks what JSON has no form for.

Checks of what a checkpoint holds, before it is used: compiled code checks no index.
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
from marl.mission import COSTS, MOVES, Mission
from radiotwin.errors import BadInput
from radiotwin.io.array_file import parse_arrays, write_arrays
from radiotwin.io.budgets import CHECKPOINT_BYTES
from radiotwin.io.files import atomic_file
from radiotwin.io.inputs import parse_json, read_bytes

NAME, OLD_NAME = "checkpoint.safetensors", "checkpoint.pt"
FORMAT = 4  # up to 3 they were pickled, with the twin's folder inside
_KEY = "checkpoint"
MAX_COUNT = 10**15
_GENERATOR = {"state": 2**128, "inc": 2**128, "has_uint32": 2, "uinteger": 2**32}


class Damaged(ValueError):
    """A checkpoint holds something else than this run would have written."""


def save_checkpoint(state: dict, path: Path) -> None:
    """Write a checkpoint.

    Args:
        state: nested dicts and lists of numbers, texts, arrays, tensors and tables; keys are texts.
        path: of the file.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, "state": _packed(state, arrays)}, allow_nan=False)
    with atomic_file(path) as file:
        write_arrays(file, arrays, _KEY, text)


def load_checkpoint(path: Path) -> dict:
    """Read a checkpoint of `save_checkpoint`; what it means is for the reader to check.

    Returns:
        the state; arrays are read-only.

    Raises:
        BadInput: it is damaged, or of another version.
    """
    arrays, text = parse_arrays(read_bytes(path, "checkpoint", CHECKPOINT_BYTES), _KEY, path)
    content = parse_json(text, path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        refuse_old(path)
    try:
        state = _unpacked(content["state"], arrays)
        if arrays or not isinstance(state, dict):
            raise Damaged("parts belong to nothing")
        return state
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        refuse_damaged(path, error)


def refuse_damaged(path: Path, error: Exception) -> NoReturn:
    """Raise the message of a damaged checkpoint.

    Raises:
        BadInput: always.
    """
    raise BadInput(f"{path} is damaged ({type(error).__name__}: {str(error)[:200]}); remove the "
                   "run's folder and start again") from None


def refuse_old(path: Path) -> NoReturn:
    """Raise the message of a checkpoint of another version.

    Raises:
        BadInput: always.
    """
    raise BadInput(
        f"{path} was written by another version of radiotwin, in a form that this one does not "
        "read; finish the run with that version, or remove its folder and start again")


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
    """Return a dict after a check that it has these names and no others.

    Raises:
        Damaged: it has not.
    """
    if not isinstance(state, dict) or set(state) != set(names):
        raise Damaged(f"a part should have the fields {', '.join(sorted(names))}")
    return state


def require_count(value: Any, high: int = MAX_COUNT) -> int:
    """Return a whole number from 0 to `high` after a check.

    Raises:
        Damaged: it is none.
    """
    if type(value) is not int or not 0 <= value <= high:
        raise Damaged(f"{str(value)[:40]} should be a whole number from 0 to {high}")
    return value


def require_array(value: Any, like: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return an array after a check of type, shape and range.

    Args:
        value: to check.
        like: of the same type and shape.
        low: least value; NaN is none.
        high: greatest value.

    Raises:
        Damaged: it differs.
    """
    if not isinstance(value, np.ndarray) or value.dtype != like.dtype or value.shape != like.shape:
        raise Damaged(f"an array should be {like.dtype.name} of the shape {like.shape}")
    if not ((value >= low) & (value <= high)).all():
        raise Damaged(f"an array should hold numbers from {low!s} to {high!s}")
    return value


def require_tensors(given: Any, like: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return named tensors after a check of names, types and shapes; all numbers are finite.

    Raises:
        Damaged: they differ.
    """
    for name, tensor in require_fields(given, like).items():
        if not isinstance(tensor, torch.Tensor) or tensor.dtype != like[name].dtype \
                or tensor.shape != like[name].shape or not tensor.isfinite().all():
            raise Damaged(f"weights {name} should be finite, of the shape "
                          f"{tuple(like[name].shape)}")
    return given


def require_generator(state: Any) -> dict:
    """Return the state of numpy's default generator after a check.

    Raises:
        Damaged: it is none.
    """
    require_fields(state, ("bit_generator", "state", "has_uint32", "uinteger"))
    require_fields(state["state"], ("state", "inc"))
    for name, end in _GENERATOR.items():
        require_count((state if name in state and name != "state" else state["state"])[name],
                      end - 1)
    if state["bit_generator"] != "PCG64":
        raise Damaged("the generator of random numbers is another one")
    return state


def require_plan(actions: Any, mission: Mission) -> np.ndarray:
    """Return (T, U) actions of a plan after a check that they can be flown.

    Args:
        actions: to check.
        mission: to be flown; its map does not matter.

    Raises:
        Damaged: one of them is not feasible.
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
