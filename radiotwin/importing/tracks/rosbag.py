"""Positions of a ROS bag: messages of type sensor_msgs/NavSatFix, decoded by rosbags.

rosbags makes Python code of the message definitions that a bag brings along, and runs it. Those of
a stranger's bag are not given to it: the type is decoded by the definition that rosbags has.
"""

from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.budgets import ENTRIES, ROWS
from radiotwin.cells import listed
from radiotwin.errors import BadInput
from radiotwin.importing.tracks.bag_message import FIX, BagMessage
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.importing.tracks.mcap import mcap_messages
from radiotwin.importing.tracks.ros1_bag import ros1_messages
from radiotwin.importing.tracks.ros2_tables import ros2_table_messages
from radiotwin.inputs import require_within

_CONTAINERS: dict[str, Callable[[Path], Iterator[BagMessage]]] = {
    ".bag": ros1_messages, ".mcap": mcap_messages, ".db3": ros2_table_messages}
_COLUMNS = 4  # time [s], latitude, longitude [degrees], altitude [m]


def is_rosbag(path: Path) -> bool:
    """Return whether a path is that of a ROS bag: a file by its name, or a folder."""
    return path.suffix.lower() in (*_CONTAINERS, ".zstd") or path.is_dir()


def read_rosbag(path: Path, topic: str | None = None) -> Fixes:
    """Read the positions of a ROS 1 bag (.bag) or a ROS 2 bag (.mcap, .db3, or the folder of it).

    Times are those of the messages' headers, else those of the recording. Messages without a fix
    are left out.

    Args:
        path: of the file or folder.
        topic: with the positions; None: the only one.

    Raises:
        BadInput: rosbags is not installed, the bag is damaged or has no such topic, or several.
    """
    decode = _decoders(path)
    topics: dict[str, array[float]] = {}
    for part in _parts(path):
        for message in _CONTAINERS[part.suffix.lower()](part):
            rows = topics.setdefault(message.topic, array("d"))
            try:
                fix = decode[message.is_ros1](message.data, FIX)
                rows.extend(_row(fix, message.time_ns))
            except Exception as error:  # rosbags has its own, and those of struct and numpy
                raise BadInput(f"{part}: a message of {message.topic[:60]!r} cannot be decoded "
                               f"({str(error)[:100]}); fetch it again") from None
            ROWS.check(len(rows) / _COLUMNS, part)
            ENTRIES.check(len(topics), part)
    columns = np.array(_chosen(path, topics, topic)).reshape(-1, _COLUMNS).T
    return make_fixes(path, columns[0], dict(zip(("latitude", "longitude", "altitude"),
                                                 columns[1:])),
                      (f"{path.name}: altitudes are above the WGS84 ellipsoid, as NavSatFix has "
                       "them; that of --origin must be, too",))


def _decoders(path: Path) -> tuple[Callable[[bytes, str], Any], Callable[[bytes, str], Any]]:
    """Return what decodes messages of ROS 2, and of ROS 1."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise BadInput(f"{path}: ROS bags need the package rosbags; `pip install radiotwin[ros]`, "
                       "or convert its positions to GPX or a table") from None
    return (get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr,
            get_typestore(Stores.ROS1_NOETIC).deserialize_ros1)


def _parts(path: Path) -> list[Path]:
    """Return the files of a bag."""
    if path.is_dir():
        found = sorted(each for each in path.iterdir() if each.suffix.lower() in (".mcap", ".db3"))
        if not found:
            raise BadInput(f"{path} holds no .mcap or .db3 file; give a ROS 2 bag (decompress "
                           "files that end in .zstd: zstd -d)")
        return [require_within(path, each, str(path)) for each in found]
    if path.suffix.lower() not in _CONTAINERS:
        raise BadInput(f"{path} is compressed as a whole; decompress it: zstd -d {path.name}")
    return [path]


def _row(fix: Any, time_ns: int) -> tuple[float, float, float, float]:
    """Return time, latitude, longitude and altitude; NaN where there was no fix."""
    stamp = fix.header.stamp
    time_s = stamp.sec + stamp.nanosec / 1e9 or time_ns / 1e9
    is_known = fix.status.status >= 0  # STATUS_NO_FIX is -1
    return time_s, fix.latitude if is_known else np.nan, fix.longitude, fix.altitude


def _chosen(path: Path, topics: dict[str, "array[float]"], topic: str | None) -> "array[float]":
    """Return the rows of the declared topic, or of the only one."""
    if topic is None and len(topics) == 1:
        return next(iter(topics.values()))
    if not topics:
        raise BadInput(f"{path} has no messages of type sensor_msgs/NavSatFix, which hold "
                       "positions; give a bag that has, or convert its positions to a table")
    if topic not in topics:
        given = f"has no topic {topic!r}" if topic else "has several topics with positions"
        raise BadInput(f"{path} {given}: name one of {listed(topics)} with --track-topic")
    return topics[topic]
