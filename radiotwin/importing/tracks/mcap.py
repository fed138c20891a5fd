"""Messages of an MCAP file (https://mcap.dev/spec).

A file is a sequence of records: type (1 byte), length (8 bytes), content. Its index is not used: it
is what a recording that was cut off lacks, and it can name any place of the file.
"""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from radiotwin.budgets import BAG_CHUNK_BYTES
from radiotwin.errors import BadInput
from radiotwin.importing.tracks.bag_chunks import Chunks
from radiotwin.importing.tracks.bag_message import BagMessage, is_fix
from radiotwin.inputs import open_input

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _DATA_END = 3, 4, 5, 6, 15
_ENCODINGS = {"cdr": False, "ros1": True}


def mcap_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of an MCAP file; one that was cut off ends with its last chunk.

    Args:
        path: of the file.

    Raises:
        BadInput: no such file, damaged, or too large.
    """
    walk = _Walk(path)
    with open_input(path, "recording (.mcap)") as file:
        if file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise BadInput(f"{path} is no MCAP file; fetch it again")
        try:
            yield from walk.messages(file)
        except (struct.error, UnicodeDecodeError) as error:
            raise BadInput(f"{path} is damaged ({error}); fetch it again") from None


class _Walk:
    """Knows the channels of positions that have been met."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._chunks = Chunks(path)
        self._schemas: set[int] = set()
        self._channels: dict[int, tuple[str, bool]] = {}  # topic, and whether of ROS 1

    def messages(self, file: IO[bytes], is_chunk: bool = False) -> Iterator[BagMessage]:
        begin = file.tell()
        end = file.seek(0, io.SEEK_END)
        file.seek(begin)
        while len(start := file.read(9)) == 9:
            kind, size = struct.unpack("<BQ", start)
            if kind == _DATA_END:
                return
            if kind not in (_SCHEMA, _CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK) or kind == _MCAP_CHUNK and is_chunk:
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
        """Note a schema of positions, or a channel that has one."""
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
    """Return a text with its length before it, and where it ends."""
    size, = struct.unpack_from("<I", body, at)
    return body[at + 4:at + 4 + size].decode(), at + 4 + size
