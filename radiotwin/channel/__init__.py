"""Channel models: gain of a link from its geometry, learned from measurements."""

from radiotwin.channel.base import ChannelModel, check_fit_data
from radiotwin.channel.links import Links, make_links
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance

MODELS: dict[str, type[ChannelModel]] = {
    model.name: model for model in (LogDistance, SegmentedLogDistance)
}

__all__ = ["MODELS", "ChannelModel", "Links", "check_fit_data", "make_links"]
