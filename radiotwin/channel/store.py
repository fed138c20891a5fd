"""A fitted channel model as one safetensors file: arrays and JSON, no code that loading runs."""

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
from radiotwin.links import LinkGeometry
from radiotwin.pieces import kept


def save_channel(model: ChannelModel, path: str | Path) -> None:
    """Write a fitted model, so that `load_channel` returns one with equal predictions.

    Args:
        model: fitted.
        path: file to write; replaced if it is there.
    """
    arrays, settings = model.state()
    # One key, because safetensors writes several in an order that changes from run to run.
    header = {"channel": json.dumps({"model": model.name, "settings": settings}, sort_keys=True)}
    with atomic_path(Path(path)) as temporary:
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, temporary,
                  header)


def fit_once(kind: type[ChannelModel], links: LinkGeometry, level_db: np.ndarray,
             limit_db: float | None, seed: int) -> ChannelModel:
    """Fit a new model, or take it from an earlier run that was to fit the same.

    Args:
        kind: of model.
        links: n links.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: level below which the receiver does not detect [dB]; None: unknown.
        seed: as of `ChannelModel.fit`.

    Raises:
        BadInput: as of `ChannelModel.fit`.
    """
    return kept("channel", (kind, links, level_db, limit_db, seed),
                lambda: kind().fit(links, level_db, limit_db, seed), kind.state, kind.from_state)


def load_channel(path: str | Path) -> ChannelModel:
    """Read a model that `save_channel` wrote.

    Args:
        path: file to read.

    Returns:
        fitted model

    Raises:
        BadInput: the file is missing, damaged, of a model that is not installed, or of something
            else.
    """
    models = channel_models()
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads(file.metadata()["channel"])
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
        bad = [name for name, array in arrays.items() if not np.isfinite(array).all()]
        if bad:
            raise ValueError(f"{', '.join(bad)} holds values that are not finite")
        return models[header["model"]].from_state(arrays, header["settings"])
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, IndexError,
            RuntimeError) as error:
        raise BadInput(
            f"{path}: not a whole channel model of one of {', '.join(models)} "
            f"({type(error).__name__}: {error}); run `radiotwin fit` again") from error
