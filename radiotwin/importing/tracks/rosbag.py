"""Read tracks from ROS bags: of ROS 1 [1], and of ROS 2 in SQLite (.db3) or MCAP [2].

A bag of ROS 1 is a sequence of records: length and fields of a header, length and data; chunks hold
connections (topic and type) and messages. An MCAP file is also a sequence: type (1 byte), length (8
bytes), content. Their index is not used: a truncated recording has none, and a hostile one may
refer to one place many times. Chunks are decompressed within budgets, as a few bytes of bz2, lz4 or
Zstandard can expand to gigabytes.

Messages of type sensor_msgs/NavSatFix are decoded by rosbags with its own definition of the type.
rosbags would compile and run the definitions in a stranger's bag.

[1] https://wiki.ros.org/Bags/Format/2.0
[2] https://mcap.dev/spec
"""

import bz2
import io
import sqlite3
import struct
import sys
from array import array
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from radiotwin.errors import BadInput, optional_package
from radiotwin.importing.tracks.fixes import PLACE, Fixes, make_fixes
from radiotwin.io.budgets import BAG_CHUNK_BYTES, ENTRIES, FILE_BYTES, ROW_BYTES, ROWS
from radiotwin.io.cells import listed
from radiotwin.io.inputs import open_input, require_within
from radiotwin.io.sqlite_tables import open_tables, require_table, scan

FIX = "sensor_msgs/msg/NavSatFix"
"""Type of position messages."""
_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7  # values of the field `op`
_STANDARD_MD5 = ("2d3a8cd499b9b4a0249fb98fd05cfa48", "*")  # of NavSatFix
Fields = dict[bytes, bytes]
_ZSTD = b"\x28\xb5\x2f\xfd"  # start of a single compressed message; CDR starts with 0
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _DATA_END = 3, 4, 5, 6, 15
_ENCODINGS = {"cdr": False, "ros1": True}
_COLUMNS = 4  # time [s], latitude, longitude [degrees], altitude [m]


class Chunks:
    """Decompresses the chunks of one recording."""

    def __init__(self, path: Path) -> None:
        self._path, self._total = path, 0

    def open(self, compression: str, data: bytes) -> bytes:
        """Decompress a chunk (`none`, `""`, `bz2`, `lz4` or `zstd`) within the budgets.

        Raises:
            BadInput: unknown compression, damaged, or too large.
        """
        if compression in ("none", ""):
            result = data
        elif compression in _MAKERS:
            decompressor = _MAKERS[compression]()
            try:
                result = decompressor.decompress(data, max_length=BAG_CHUNK_BYTES.limit + 1)
            except Exception as error:  # lz4 and zstd each have their own
                raise BadInput(f"{self._path}: a chunk is damaged ({str(error)[:100]}); fetch it "
                               "again") from None
            BAG_CHUNK_BYTES.check(len(result), f"{self._path}: a chunk, decompressed")
            if not decompressor.eof:
                raise BadInput(f"{self._path}: a chunk is cut off; fetch it again")
        else:
            raise BadInput(f"{self._path}: a chunk is compressed by {compression[:20]!r}; readable "
                           "are none, bz2, lz4 and zstd: record it again, or convert it")
        self._total += len(result)
        FILE_BYTES.check(self._total, f"{self._path}, decompressed")
        return result


def _lz4() -> Any:
    from lz4.frame import LZ4FrameDecompressor

    return LZ4FrameDecompressor()


def _zstd() -> Any:
    """Return a decompressor of Zstandard."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd.ZstdDecompressor()


_MAKERS: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": _lz4, "zstd": _zstd}


class BagMessage(NamedTuple):
    """A message that is not decoded yet, in the serialisation of ROS 1 or ROS 2 (CDR)."""

    topic: str
    time_ns: int
    data: bytes
    is_ros1: bool


def is_fix(kind: str) -> bool:
    """Return whether a type, named by ROS 1 or ROS 2, is that of position messages."""
    return kind in (FIX, "sensor_msgs/NavSatFix")


def _ros1_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of a ROS 1 bag, up to the last complete chunk."""
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
    """Yield the position messages of a ROS 1 chunk; new connections go to `topics`, in place."""
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
    """Yield header fields and data of a ROS 1 bag's wanted records, until one is cut off."""
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
    """Parse the fields `name=value` in the header of a ROS 1 record, each after its length."""
    fields, at = {}, 0
    while at < len(header):
        size, = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4:at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields


def _ros2_table_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of a ROS 2 bag in SQLite."""
    chunks = Chunks(path)
    try:
        with open_tables(path, "ROS 2 bag (.db3)") as database:
            for name in ("topics", "messages"):
                require_table(database, name)
            topics = {number: str(name)[:1000] for number, name, kind, encoding in scan(
                database, "topics", ["id", "name", "type", "serialization_format"])
                if is_fix(str(kind)) and encoding == "cdr"}
            for number, time_ns, data in scan(
                    database, "messages", ["topic_id", "timestamp", "data"], ROWS):
                if number in topics and isinstance(data, bytes) and isinstance(time_ns, int):
                    is_compressed = data.startswith(_ZSTD)
                    yield BagMessage(topics[number], time_ns,
                                     chunks.open("zstd" if is_compressed else "", data), False)
    except sqlite3.Error as error:
        raise BadInput(f"{path} is not a readable ROS 2 bag ({error}); fetch it again") from None


def _mcap_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of an MCAP file, up to the last complete chunk."""
    reader = _McapReader(path)
    with open_input(path, "recording (.mcap)") as file:
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise BadInput(f"{path} is no MCAP file; fetch it again")
        try:
            yield from reader.messages(file)
        except (struct.error, UnicodeDecodeError) as error:
            raise BadInput(f"{path} is damaged ({error}); fetch it again") from None


class _McapReader:
    """Walk over the records of an MCAP file, with the channels of positions found so far."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._chunks = Chunks(path)
        self._schemas: set[int] = set()
        self._channels: dict[int, tuple[str, bool]] = {}  # topic, and whether of ROS 1

    def messages(self, file: IO[bytes], is_chunk: bool = False) -> Iterator[BagMessage]:
        """Yield the position messages of an MCAP file, or of a chunk in it, until it is cut off."""
        begin = file.tell()
        end = file.seek(0, io.SEEK_END)
        file.seek(begin)
        while len(start := file.read(9)) == 9:
            kind, size = struct.unpack("<BQ", start)
            if kind == _DATA_END:
                return
            wanted = kind in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK)
            if not wanted or kind == _MCAP_CHUNK and is_chunk:
                if size > end - file.tell():
                    return
                file.seek(size, io.SEEK_CUR)
                continue
            BAG_CHUNK_BYTES.check(size, f"{self._path}: a chunk")
            body = file.read(size)
            if len(body) < size:
                return
            if kind == _MCAP_CHUNK:
                yield from self.messages(io.BytesIO(self._chunk(body)), True)
            elif kind == _MCAP_MESSAGE:
                number, _, time_ns = struct.unpack_from("<HIQ", body)
                if number in self._channels:
                    topic, is_ros1 = self._channels[number]
                    yield BagMessage(topic, time_ns, body[22:], is_ros1)
            else:
                self._declare(kind, body)

    def _chunk(self, body: bytes) -> bytes:
        compression, at = _text(body, 28)  # after the first and last time, the size and the CRC
        size, = struct.unpack_from("<Q", body, at)
        return self._chunks.open(compression, body[at + 8:at + 8 + size])

    def _declare(self, kind: int, body: bytes) -> None:
        """Note a schema if it is of positions, or a channel if its schema is one."""
        number, = struct.unpack_from("<H", body)
        if kind == _SCHEMA:
            if is_fix(_text(body, 2)[0]):
                self._schemas.add(number)
            return
        schema, = struct.unpack_from("<H", body, 2)
        topic, at = _text(body, 4)
        encoding, _ = _text(body, at)
        if schema in self._schemas and encoding in _ENCODINGS:
            self._channels[number] = topic[:1000], _ENCODINGS[encoding]


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Read a text with its length before it; return also the position after it."""
    size, = struct.unpack_from("<I", body, at)
    return body[at + 4:at + 4 + size].decode(), at + 4 + size


_CONTAINERS: dict[str, Callable[[Path], Iterator[BagMessage]]] = {
    ".bag": _ros1_messages, ".mcap": _mcap_messages, ".db3": _ros2_table_messages}


def is_rosbag(path: Path) -> bool:
    """Return whether a path is a ROS bag: a file with such a suffix, or a folder."""
    return path.suffix.lower() in (*_CONTAINERS, ".zstd") or path.is_dir()


def read_rosbag(path: Path, topic: str | None = None) -> Fixes:
    """Read the positions of a ROS 1 bag (.bag) or a ROS 2 bag (.mcap, .db3, or its folder).

    Times are those of the messages' headers, else of the recording. Messages without a fix are left
    out. `topic` None: the only topic with positions.

    Raises:
        BadInput: rosbags is not installed, the bag is damaged, or the topic is missing.
    """
    decode = _decoders(path)
    topics: dict[str, array[float]] = {}
    for part in _parts(path):
        for message in _CONTAINERS[part.suffix.lower()](part):
            rows = topics.setdefault(message.topic, array("d"))
            try:
                fix = decode[message.is_ros1](message.data, FIX)
                rows.extend(_fix_row(fix, message.time_ns))
            except Exception as error:  # rosbags has its own, and those of struct and numpy
                raise BadInput(f"{part}: a message of {message.topic[:60]!r} cannot be decoded "
                               f"({str(error)[:100]}); fetch it again") from None
            ROWS.check(len(rows) / _COLUMNS, part)
            ENTRIES.check(len(topics), part)
    columns = np.array(_rows_of_topic(path, topics, topic)).reshape(-1, _COLUMNS).T
    return make_fixes(path, columns[0], dict(zip(PLACE, columns[1:])),
                      (f"{path.name}: altitudes are above the WGS84 ellipsoid, as NavSatFix has "
                       "them; that of --origin must be, too",))


def _decoders(path: Path) -> tuple[Callable[[bytes, str], Any], Callable[[bytes, str], Any]]:
    """Return two functions that decode messages: of ROS 2, and of ROS 1."""
    types = optional_package(
        "rosbags.typesys", f"{path}: ROS bags need the package rosbags; `pip install "
                           "radiotwin[ros]`, or convert its positions to GPX or a table")
    return (types.get_typestore(types.Stores.ROS2_HUMBLE).deserialize_cdr,
            types.get_typestore(types.Stores.ROS1_NOETIC).deserialize_ros1)


def _parts(path: Path) -> list[Path]:
    """Return the files of a bag: those in a folder, or the file; BadInput if compressed."""
    if path.is_dir():
        found = sorted(each for each in path.iterdir() if each.suffix.lower() in (".mcap", ".db3"))
        if not found:
            raise BadInput(f"{path} holds no .mcap or .db3 file; give a ROS 2 bag (decompress "
                           "files that end in .zstd: zstd -d)")
        return [require_within(path, each, str(path)) for each in found]
    if path.suffix.lower() not in _CONTAINERS:
        raise BadInput(f"{path} is compressed as a whole; decompress it: zstd -d {path.name}")
    return [path]


def _fix_row(fix: Any, time_ns: int) -> tuple[float, float, float, float]:
    """Return time [s], latitude, longitude [deg] and altitude [m]; NaN latitude without a fix."""
    stamp = fix.header.stamp
    time_s = stamp.sec + stamp.nanosec / 1e9 or time_ns / 1e9
    is_known = fix.status.status >= 0  # STATUS_NO_FIX is -1
    return time_s, fix.latitude if is_known else np.nan, fix.longitude, fix.altitude


def _rows_of_topic(path: Path, topics: dict[str, "array[float]"], topic: str | None
                   ) -> "array[float]":
    """Return the rows of a topic (None: the only one); BadInput if it is not there."""
    if topic is None and len(topics) == 1:
        return next(iter(topics.values()))
    if not topics:
        raise BadInput(f"{path} has no messages of type sensor_msgs/NavSatFix, which hold "
                       "positions; give a bag that has, or convert its positions to a table")
    if topic not in topics:
        given = f"has no topic {topic!r}" if topic else "has several topics with positions"
        raise BadInput(f"{path} {given}: name one of {listed(topics)} with --track-topic")
    return topics[topic]
