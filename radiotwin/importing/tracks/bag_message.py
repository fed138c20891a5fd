"""A message of a recording as its container has it."""

from typing import NamedTuple

FIX = "sensor_msgs/msg/NavSatFix"
"""Type of the messages that are read."""


class BagMessage(NamedTuple):
    """A message that is not decoded yet.

    Attributes:
        topic: that it was sent to.
        time_ns: when it was recorded, since 1970.
        data: serialised.
        is_ros1: whether as ROS 1 does, else CDR as ROS 2.
    """

    topic: str
    time_ns: int
    data: bytes
    is_ros1: bool


def is_fix(kind: str) -> bool:
    """Return whether a type, as ROS 1 or ROS 2 names it, is that of the messages to read."""
    return kind in (FIX, "sensor_msgs/NavSatFix")
