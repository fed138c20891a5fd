"""Channel models: predict the level of a link from its geometry, learnt from measurements."""

from radiotwin.propagation.laws.base import ChannelModel, check_fit_data
from radiotwin.propagation.laws.registry import channel_models, channel_named, fit_once, register

__all__ = ["ChannelModel", "channel_models", "channel_named", "check_fit_data", "fit_once",
           "register"]
