"""Messages of a ROS 1 bag, format 2.0 (https://wiki.ros.org/Bags/Format/2.0).

A bag is a sequence of records: length and fields of a header, length and data. Chunks hold
connections (topic and type) and messages. Its index is not used: it is what a recording that was
cut off lacks, and a few bytes of it can name one chunk many times.
"""

import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO

from radiotwin.budgets import BAG_CHUNK_BYTES, ENTRIES, ROW_BYTES
from radiotwin.errors import BadInput
from radiotwin.importing.tracks.bag_chunks import Chunks
from radiotwin.importing.tracks.bag_message import BagMessage, is_fix
from radiotwin.inputs import open_input

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7  # values of the field `op`
_STANDARD_MD5 = ("2d3a8cd499b9b4a0249fb98fd05cfa48", "*")  # of NavSatFix
Fields = dict[bytes, bytes]


def ros1_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of a ROS 1 bag; one that was cut off ends with its last chunk.

    Args:
        path: of the bag.

    Raises:
        BadInput: no such bag, damaged, or too large.
    """
    topics: dict[bytes, str] = {}
    chunks = Chunks(path)
    with open_input(path, "ROS bag (.bag)") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BadInput(f"{path} is no ROS 1 bag of format 2.0; fetch it again, or convert it "
                           "(rosbag migrate)")
        try:
            for fields, data in _records(path, file, (_CHUNK,)):
                chunk = chunks.open(fields[b"compression"].decode("ascii", "replace"), data)
                yield from _messages(path, chunk, topics)
        except (KeyError, struct.error) as error:
            raise BadInput(f"{path} is damaged ({error}); fetch it again") from None


def _messages(path: Path, chunk: bytes, topics: dict[bytes, str]) -> Iterator[BagMessage]:
    """Yield the messages of a chunk; adds to the topics, by the number of their connection."""
    for fields, data in _records(path, io.BytesIO(chunk), (_MESSAGE, _CONNECTION)):
        if fields[b"op"][0] == _MESSAGE:
            topic = topics.get(fields[b"conn"])
            if topic is not None:
                seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                yield BagMessage(topic, seconds * 10**9 + nanoseconds, data, True)
            continue
        declared = _fields(data)
        if is_fix(declared[b"type"].decode("utf-8", "replace")):
            topic = fields[b"topic"].decode("utf-8", "replace")
            if declared[b"md5sum"].decode("ascii", "replace") not in _STANDARD_MD5:
                raise BadInput(f"{path}: topic {topic[:60]!r} has a NavSatFix of its own, not that "
                               "of sensor_msgs; convert its positions to GPX or a table")
            topics[fields[b"conn"]] = topic
            ENTRIES.check(len(topics), path)


def _records(path: Path, file: IO[bytes],
             wanted: Collection[int]) -> Iterator[tuple[Fields, bytes]]:
    """Yield fields and data of the wanted records, up to one that is cut off."""
    while len(start := file.read(4)) == 4:
        size, = struct.unpack("<I", start)
        ROW_BYTES.check(size, f"{path}: a record's header")
        header, length = file.read(size), file.read(4)
        if len(header) < size or len(length) < 4:
            return
        fields = _fields(header)
        size, = struct.unpack("<I", length)
        if fields[b"op"][:1] and fields[b"op"][0] in wanted:
            BAG_CHUNK_BYTES.check(size, f"{path}: a chunk")
            data = file.read(size)
            if len(data) < size:
                return
            yield fields, data
        else:
            file.seek(size, io.SEEK_CUR)


def _fields(header: bytes) -> Fields:
    """Return the fields of a header, each with its length before `name=value`."""
    fields, at = {}, 0
    while at < len(header):
        size, = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4:at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields
