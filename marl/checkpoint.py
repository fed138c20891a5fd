"""Checkpoints: written whole or not at all, and read without executing anything in them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, atomic_path

FORMAT = 3  # 1 had the optimiser's state as torch.optim writes it


def save_checkpoint(state: dict, path: Path) -> None:
    """Write a checkpoint.

    Args:
        state: nested dicts and lists of numbers, texts, arrays, tensors and tables.
        path: of the file.
    """
    with atomic_path(path) as temporary:
        torch.save({"format": FORMAT, "state": _packed(state)}, temporary)


def load_checkpoint(path: Path) -> dict:
    """Read a checkpoint of `save_checkpoint`.

    Raises:
        BadInput: it is damaged, or of another version.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # zipfile, pickle and torch each have their own
        raise BadInput(f"{path} is damaged ({type(error).__name__}); remove the run's folder and "
                       "start again") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadInput(
            f"{path} was written by another version of radiotwin, in a form that this one does not "
            "read; finish the run with that version, or remove its folder and start again")
    return _unpacked(content["state"])


def folder_content(folder: Path) -> dict[str, np.ndarray]:
    """Return the files of a flat folder, for a checkpoint."""
    return {path.name: np.frombuffer(path.read_bytes(), np.uint8)
            for path in sorted(folder.iterdir())}


def restore_folder(content: dict[str, np.ndarray], folder: Path) -> None:
    """Write the files of `folder_content` again."""
    with atomic_folder(folder) as temporary:
        for name, data in content.items():
            (temporary / name).write_bytes(data.tobytes())


def _packed(value: Any) -> Any:
    if isinstance(value, pd.DataFrame):
        return {"__table__": {name: _packed(column.to_numpy()) if column.dtype.kind in "fiub"
                              else list(column) for name, column in value.items()}}
    if isinstance(value, np.ndarray):
        return {"__array__": torch.from_numpy(np.array(value))}
    if isinstance(value, dict):
        # The state of a random generator has integers of 128 bits, which only JSON keeps.
        if "bit_generator" in value:
            return {"__json__": json.dumps(value)}
        return {name: _packed(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(each) for each in value]
    return value


def _unpacked(value: Any) -> Any:
    if isinstance(value, dict):
        if "__table__" in value:
            return pd.DataFrame(_unpacked(value["__table__"]))
        if "__array__" in value:
            return value["__array__"].numpy()
        if "__json__" in value:
            return json.loads(value["__json__"])
        return {name: _unpacked(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_unpacked(each) for each in value]
    return value
