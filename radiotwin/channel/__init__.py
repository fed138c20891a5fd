"""Channel models: gain of a link from its geometry, learned from measurements."""

from radiotwin.channel.base import ChannelModel, check_fit_data
from radiotwin.channel.links import Links, make_links
from radiotwin.channel.store import MODELS, load_channel, save_channel

__all__ = ["MODELS", "ChannelModel", "Links", "check_fit_data", "load_channel", "make_links", "save_channel"]
