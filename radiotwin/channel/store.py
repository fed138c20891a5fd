"""A fitted channel model as one safetensors file: arrays and JSON, no code that loading could run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from radiotwin.channel.base import ChannelModel
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.regression_kriging import RegressionKriging
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.channel.segmented_nn import SegmentedNN
from radiotwin.errors import BadInput
from radiotwin.files import atomic_path

MODELS: dict[str, type[ChannelModel]] = {
    model.name: model for model in (LogDistance, SegmentedLogDistance, SegmentedNN, RegressionKriging)
}


def save_channel(model: ChannelModel, path: str | Path) -> None:
    """Writes a fitted model; `load_channel` gives one with equal predictions."""
    arrays, settings = model.state()
    metadata = {"model": model.name, "settings": json.dumps(settings, sort_keys=True)}
    with atomic_path(Path(path)) as temporary:
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, temporary, metadata)


def load_channel(path: str | Path) -> ChannelModel:
    """Reads what `save_channel` wrote. Raises BadInput where the file is missing, damaged or of something else."""
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (OSError, SafetensorError) as error:
        raise BadInput(f"{path}: cannot be read as a channel model ({error}): run `radiotwin fit` again") from error
    if metadata.get("model") not in MODELS:
        raise BadInput(
            f"{path}: holds the model {metadata.get('model')!r}; known are {', '.join(MODELS)}"
        )
    bad = [name for name, array in arrays.items() if not np.isfinite(array).all()]
    if bad:
        raise BadInput(f"{path}: {', '.join(bad)} holds values that are not finite: run `radiotwin fit` again")
    try:
        return MODELS[metadata["model"]].from_state(arrays, json.loads(metadata["settings"]))
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        raise BadInput(
            f"{path}: is not a complete {metadata['model']} model ({type(error).__name__}: {error}): "
            "run `radiotwin fit` again"
        ) from error
