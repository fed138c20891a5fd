"""Checkpoints: written whole or not at all, and read without executing anything in them.

The format is that of safetensors: arrays, and a JSON document that refers to them. A key that
begins with `$` marks what JSON has no form for.
"""

import json
import math
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import torch

from radiotwin.array_file import parse_arrays, write_arrays
from radiotwin.budgets import CHECKPOINT_BYTES
from radiotwin.errors import BadInput
from radiotwin.files import atomic_file
from radiotwin.inputs import parse_json, read_bytes

NAME, OLD_NAME = "checkpoint.safetensors", "checkpoint.pt"
FORMAT = 4  # up to 3 they were pickled, with the twin's folder inside
_KEY = "checkpoint"


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
