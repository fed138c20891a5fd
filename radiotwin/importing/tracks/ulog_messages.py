"""The messages of a ULog that a track needs, checked before pyulog decodes them.

A ULog is a header of 16 bytes and messages: size (2 bytes), type (1 byte), body
(https://docs.px4.io/main/en/dev_log/ulog_file_format). pyulog looks for messages from every byte of
damage on, and takes memory for as many fields as a format declares.
"""

import io
import re
import struct
from collections.abc import Collection
from pathlib import Path

from radiotwin.budgets import FILE_BYTES, ROWS
from radiotwin.errors import BadInput
from radiotwin.inputs import open_input

_MAGIC = b"ULog\x01\x12\x35"
_MAX_BODY = 2**16  # of a message, by the format
_FIELD = re.compile(r"(?:u?int(?:8|16|32|64)_t|float|double|bool|char)(?:\[(\d{1,5})\])? \w+")


def needed_messages(path: Path, topics: Collection[str]) -> io.BytesIO:
    """Return a ULog with the formats, subscriptions and data of some topics only.

    Args:
        path: of the log; one that was cut off ends with its last whole message.
        topics: names.

    Raises:
        BadInput: no ULog, damaged, or a format of one of these topics is unusual.
    """
    result = io.BytesIO()
    subscribed: set[bytes] = set()
    count = 0
    with open_input(path, "PX4 flight log (.ulg)") as file:
        head = file.read(16)
        if not head.startswith(_MAGIC):
            raise BadInput(f"{path} is no PX4 flight log (ULog); fetch it again")
        result.write(head)
        while len(start := file.read(3)) == 3:
            size, kind = struct.unpack("<HB", start)
            body = file.read(size)
            if len(body) < size:
                break
            if not size or not chr(kind).isalpha() or kind > 127:
                raise BadInput(f"{path}: byte {file.tell() - size - 2} is none of a ULog; it is "
                               "damaged: fetch it again")
            if kind == ord("F"):
                name, _, fields = body.decode("ascii", "replace").partition(":")
                if name not in topics:
                    continue
                _check_fields(path, name, fields)
            elif kind == ord("A"):
                if body[3:].decode("ascii", "replace") not in topics:
                    continue
                subscribed.add(body[1:3])
            elif kind != ord("D") or body[:2] not in subscribed:
                continue
            count += 1
            ROWS.check(count, path)
            result.write(start + body)
            FILE_BYTES.check(result.tell(), path)
    result.seek(0)
    return result


def _check_fields(path: Path, name: str, fields: str) -> None:
    """Refuse nested fields, and arrays that no message can hold."""
    found = [_FIELD.fullmatch(field) for field in fields.rstrip(";").split(";")]
    if not all(found) or sum(int(each[1] or 1) for each in found if each) > _MAX_BODY:
        raise BadInput(f"{path}: its topic {name} has an unusual format; convert its position to "
                       "GPX or a table")
