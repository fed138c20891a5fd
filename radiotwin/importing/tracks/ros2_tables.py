"""Messages of a ROS 2 bag in SQLite (.db3), of any version of its tables."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from radiotwin.budgets import ROWS
from radiotwin.errors import BadInput
from radiotwin.importing.tracks.bag_chunks import Chunks
from radiotwin.importing.tracks.bag_message import BagMessage, is_fix
from radiotwin.sqlite_tables import open_tables, require_table, scan

_ZSTD = b"\x28\xb5\x2f\xfd"  # a message that was compressed by itself; CDR begins with 0


def ros2_table_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the position messages of a ROS 2 bag in SQLite.

    Args:
        path: of the `.db3` file.

    Raises:
        BadInput: no such bag, damaged, or too large.
    """
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
