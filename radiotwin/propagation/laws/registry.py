"""Look up channel models by name; write and read fitted ones as safetensors files.

A package adds models under the entry-point group `radiotwin.channels`; a script adds one with
`register`. A file holds arrays and JSON; loading it runs no code.
"""

from __future__ import annotations

import json

import numpy as np

from radiotwin.errors import BadInput, MissingPackage
from radiotwin.inference.gaussian import Limit
from radiotwin.io.array_file import pack_arrays, parse_arrays
from radiotwin.io.inputs import parse_json
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.aerial import (
    AlHouraniDenseUrban,
    AlHouraniHighRise,
    AlHouraniSuburban,
    AlHouraniUrban,
    UrbanMacro,
    UrbanMicro,
)
from radiotwin.propagation.laws.base import ChannelModel
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.propagation.laws.published import P1411, WalfischIkegami, WalfischIkegamiMetropolitan
from radiotwin.propagation.laws.segmented_nn import SegmentedNN
from radiotwin.runtime.pieces import cached
from radiotwin.runtime.plugins import load_plugins

ENTRY_POINTS = "radiotwin.channels"  # entry-point group
BUILT_IN: tuple[type[ChannelModel], ...] = (
    LogDistance, SegmentedLogDistance, SegmentedNN, RegressionKriging, ImagePaths, PathKriging,
    UrbanMacro, UrbanMicro, AlHouraniSuburban, AlHouraniUrban, AlHouraniDenseUrban,
    AlHouraniHighRise, P1411, WalfischIkegami, WalfischIkegamiMetropolitan)
_registered: dict[str, type[ChannelModel]] = {}
BESIDE = "beside/"  # prefix of arrays in the file that do not belong to the model
# Distances and heights [m] at which a decoded model must predict finite levels.
_TRIED_M = np.array([(1.0, 0.0), (30.0, 10.0), (300.0, -50.0), (3e3, 100.0), (1e5, 3e3)])


def register(model: type[ChannelModel]) -> type[ChannelModel]:
    """Add a channel model to this process and return its class; usable as a decorator.

    Raises:
        BadInput: not a channel model, or another model has its name.
    """
    if not (isinstance(model, type) and issubclass(model, ChannelModel)):
        raise BadInput(f"{model!r} is not a subclass of radiotwin.propagation.laws.ChannelModel")
    known = {each.name: each for each in BUILT_IN} | _registered
    if known.get(model.name, model) is not model:
        raise BadInput(f"the channel model {model.name!r} of {model.__module__} is in "
                       f"{known[model.name].__module__} already; give it another name")
    _registered[model.name] = model
    return model


def channel_models() -> dict[str, type[ChannelModel]]:
    """Return all channel models by name: built-in, of installed packages, and registered.

    A model of a package that cannot be loaded is left out with a warning.
    """
    load_plugins(ENTRY_POINTS, register, "channel model")
    return {each.name: each for each in BUILT_IN} | _registered


def channel_named(name: str) -> type[ChannelModel]:
    """Return the class of a channel model by its name.

    Raises:
        BadInput: no such model is installed.
    """
    models = channel_models()
    if name not in models:
        raise BadInput(f"channel model {name!r} is unknown; allowed are {', '.join(models)}")
    return models[name]


def fit_once(kind: type[ChannelModel], links: LinkGeometry, level_db: np.ndarray,
             limit_db: Limit, seed: int) -> ChannelModel:
    """Fit a new model of the class `kind`, or load it if an earlier run fitted the same data.

    The other arguments, and errors, are those of `ChannelModel.fit`.
    """
    return cached("channel", (kind, links, level_db, limit_db, seed),
                  lambda: kind().fit(links, level_db, limit_db, seed), kind.state, kind.from_state)


def encode_channel(model: ChannelModel, beside: dict[str, np.ndarray] | None = None) -> bytes:
    """Encode a fitted model, and optional other arrays beside it, as a safetensors file."""
    arrays, settings = model.state()
    arrays = arrays | {f"{BESIDE}{name}": array for name, array in (beside or {}).items()}
    header = json.dumps({"model": model.name, "settings": settings}, sort_keys=True)
    return pack_arrays({name: np.atleast_1d(array) for name, array in arrays.items()}, "channel",
                       header)


def decode_both(data: bytes, source: object) -> tuple[ChannelModel, dict[str, np.ndarray]]:
    """Decode a file of `encode_channel`: the model, and the other arrays beside it.

    Args:
        data: content of the file.
        source: path of the file, for the message.

    Raises:
        BadInput: the file is damaged or no channel, or its model is not known.
        MissingPackage: the model needs a package that is not installed.
    """
    models = channel_models()
    try:
        arrays, text = parse_arrays(data, "channel", source)
        header = parse_json(text, source)
        bad = [name for name, array in arrays.items() if not np.isfinite(array).all()]
        if bad:
            raise ValueError(f"{', '.join(bad)} holds values that are not finite")
        beside = {name.removeprefix(BESIDE): array for name, array in arrays.items()
                  if name.startswith(BESIDE)}
        # A model may keep its arrays and change them.
        model = models[header["model"]].from_state(
            {name: array.copy() for name, array in arrays.items() if not name.startswith(BESIDE)},
            header["settings"])
        if type(model) in BUILT_IN:  # a model of another package may need a map
            _try_to_predict(model)
        return model, beside
    except MissingPackage:
        raise
    except (BadInput, LookupError, ValueError, TypeError, AttributeError, ArithmeticError,
            RuntimeError) as error:
        raise BadInput(f"{source}: not a whole channel model of one of {', '.join(models)} "
                       f"({type(error).__name__}: {str(error)[:300]}); run `radiotwin fit` "
                       "again") from error


def _try_to_predict(model: ChannelModel) -> None:
    """Raise ValueError unless `quick` predicts finite mean and sd ≥ 0 of links without a map."""
    horizontal_m, rise_m = np.tile(_TRIED_M, (2, 1)).T
    count, zero = len(rise_m), np.zeros(len(rise_m))
    links = LinkGeometry(np.zeros((count, 3)), np.column_stack([horizontal_m, zero, rise_m]),
                         np.arange(count) % 2 == 1, np.zeros(count, dtype=int))
    with np.errstate(all="ignore"):
        mean_db, sd_db = model.quick.predict(links)
    if not (np.isfinite(mean_db).all() and np.isfinite(sd_db).all() and (sd_db >= 0).all()):
        raise ValueError("it predicts levels that are no numbers")
