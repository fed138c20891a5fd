"""A fitted channel model as one safetensors file: arrays and JSON, no code that loading could run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from radiotwin.channel.base import ChannelModel
from radiotwin.channel.registry import channel_models
from radiotwin.errors import BadInput
from radiotwin.files import atomic_path

def save_channel(model: ChannelModel, path: str | Path) -> None:
    """Writes a fitted model; `load_channel` gives one with equal predictions."""
    arrays, settings = model.state()
    # One key, because safetensors writes several in an order that changes from run to run.
    header = {"channel": json.dumps({"model": model.name, "settings": settings}, sort_keys=True)}
    with atomic_path(Path(path)) as temporary:
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, temporary, header)


def load_channel(path: str | Path) -> ChannelModel:
    """Reads what `save_channel` wrote. Raises BadInput where the file is missing, damaged or of something else."""
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads(file.metadata()["channel"])
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
        bad = [name for name, array in arrays.items() if not np.isfinite(array).all()]
        if bad:
            raise ValueError(f"{', '.join(bad)} holds values that are not finite")
        return channel_models()[header["model"]].from_state(arrays, header["settings"])
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        raise BadInput(
            f"{path}: not a whole channel model of one of {', '.join(channel_models())} ({type(error).__name__}: {error}); "
            "run `radiotwin fit` again"
        ) from error
