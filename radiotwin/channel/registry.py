"""Every channel model by name: the built-in ones, and what installed packages add.

A package adds models under the entry-point group `radiotwin.channels`; a script adds one with
`register`.
"""

from radiotwin.channel.al_hourani import (
    AlHouraniDenseUrban,
    AlHouraniHighRise,
    AlHouraniSuburban,
    AlHouraniUrban,
)
from radiotwin.channel.base import ChannelModel
from radiotwin.channel.cost231 import WalfischIkegami, WalfischIkegamiMetropolitan
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.p1411 import P1411
from radiotwin.channel.path_kriging import PathKriging
from radiotwin.channel.regression_kriging import RegressionKriging
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.channel.segmented_nn import SegmentedNN
from radiotwin.channel.tr36777 import UrbanMacro, UrbanMicro
from radiotwin.errors import BadInput
from radiotwin.plugins import load_plugins

ENTRY_POINTS = "radiotwin.channels"  # group of the packages' entry points
BUILT_IN: tuple[type[ChannelModel], ...] = (
    LogDistance, SegmentedLogDistance, SegmentedNN, RegressionKriging, ImagePaths, PathKriging,
    UrbanMacro, UrbanMicro, AlHouraniSuburban, AlHouraniUrban, AlHouraniDenseUrban,
    AlHouraniHighRise, P1411, WalfischIkegami, WalfischIkegamiMetropolitan)
ALIASES = {"raytrace": ImagePaths.name}  # as the command line calls it

_registered: dict[str, type[ChannelModel]] = {}


def register(model: type[ChannelModel]) -> type[ChannelModel]:
    """Add a channel model to this process; usable as a decorator.

    Args:
        model: subclass of `ChannelModel`, with a name of its own.

    Returns:
        the class itself

    Raises:
        BadInput: not a channel model, or its name is taken.
    """
    if not (isinstance(model, type) and issubclass(model, ChannelModel)):
        raise BadInput(f"{model!r} is not a subclass of radiotwin.channel.ChannelModel")
    taken = {each.name: each for each in BUILT_IN} | _registered
    if taken.get(model.name, model) is not model:
        raise BadInput(f"the channel model {model.name!r} of {model.__module__} is in "
                       f"{taken[model.name].__module__} already; give it another name")
    _registered[model.name] = model
    return model


def channel_models() -> dict[str, type[ChannelModel]]:
    """Return all channel models by name: built-in, of installed packages, and registered.

    Warns where a package's model cannot be loaded, and goes on without it.
    """
    load_plugins(ENTRY_POINTS, register, "channel model")
    return {each.name: each for each in BUILT_IN} | _registered


def channel_named(name: str) -> type[ChannelModel]:
    """Return a channel model's class.

    Args:
        name: of the model, or an alias of it.

    Raises:
        BadInput: no such model is installed.
    """
    models = channel_models()
    name = ALIASES.get(name, name)
    if name not in models:
        allowed = [*(each for each in models if each not in ALIASES.values()), *ALIASES]
        raise BadInput(f"channel model {name!r} is unknown; allowed are {', '.join(allowed)}")
    return models[name]
