"""Chunks of recordings, decompressed within budgets.

A few bytes of bz2, lz4 or Zstandard can stand for gigabytes, and readers of ROS bags decompress a
chunk whole.
"""

import bz2
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from radiotwin.budgets import BAG_CHUNK_BYTES, FILE_BYTES
from radiotwin.errors import BadInput


class Chunks:
    """Decompresses the chunks of one recording.

    Args:
        path: of the recording, for messages.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._total = path, 0

    def open(self, compression: str, data: bytes) -> bytes:
        """Decompress a chunk.

        Args:
            compression: `none` or nothing, `bz2`, `lz4`, `zstd`.
            data: of the chunk.

        Raises:
            BadInput: unknown compression, damaged, or more than the budget of a chunk or a file.
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
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd.ZstdDecompressor()


_MAKERS: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": _lz4, "zstd": _zstd}
