"""Channel models: level of a link from its geometry, learnt from measurements."""

from radiotwin.channel.base import ChannelModel, check_fit_data
from radiotwin.channel.registry import channel_models, channel_named, register
from radiotwin.channel.store import fit_once, load_channel, save_channel

__all__ = ["ChannelModel", "channel_models", "channel_named", "check_fit_data", "fit_once",
           "load_channel", "register", "save_channel"]
