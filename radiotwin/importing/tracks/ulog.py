"""Positions and attitude of a PX4 flight log (ULog [1]), read by pyulog.

A ULog is a header of 16 bytes and messages: size (2 bytes), type (1 byte), body. pyulog looks for
messages from every byte of damage on, and takes memory for as many fields as a format declares: it
gets only the messages that a track needs, checked before.

[1] https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

import io
import re
import struct
from collections.abc import Collection
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput, optional_package
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.io.budgets import FILE_BYTES, ROWS
from radiotwin.io.inputs import open_input

_MAGIC = b"ULog\x01\x12\x35"
_MAX_BODY = 2**16  # of a message, by the format
_FIELD = re.compile(r"(?:u?int(?:8|16|32|64)_t|float|double|bool|char)(?:\[(\d{1,5})\])? \w+")
_GPS = ("vehicle_gps_position", "sensor_gps")
_TOPICS = ["vehicle_global_position", *_GPS, "vehicle_attitude"]


def _needed_messages(path: Path, topics: Collection[str]) -> io.BytesIO:
    """Return a ULog with the formats, subscriptions and data of some topics only.

    One that was cut off ends with its last whole message.
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


def read_ulog(path: Path) -> Fixes:
    """Read a flight log: the estimated position, else that of the GNSS receiver; and the attitude.

    Times count from the start of the autopilot; the GNSS receiver's UTC places them.

    Raises:
        BadInput: pyulog is not installed, the log is damaged, or has no position or no UTC.
    """
    messages = _needed_messages(path, _TOPICS)
    pyulog = optional_package(
        "pyulog", f"{path}: PX4 flight logs need the package pyulog; `pip install "
                  "radiotwin[tracks]`, or convert it to GPX")
    try:
        with redirect_stdout(io.StringIO()):  # on which it remarks on damage
            log = pyulog.ULog(messages, disable_str_exceptions=True)
        topics = {each.name: each.data for each in reversed(log.data_list)}  # instance 0 counts
        return _fixes(path, topics)
    except BadInput:
        raise
    except Exception as error:  # pyulog has its own, and those of struct and numpy
        raise BadInput(f"{path} cannot be read as a PX4 flight log ({str(error)[:200]}); fetch it "
                       "again") from None


def _fixes(path: Path, topics: dict[str, Any]) -> Fixes:
    gps = next((topics[name] for name in _GPS if name in topics), None)
    if gps is None:
        raise BadInput(f"{path} has no GNSS position ({' or '.join(_GPS)}), without which its "
                       "times have no date")
    utc_us, boot_us = (gps[name].astype(float) for name in ("time_utc_usec", "timestamp"))
    if not (utc_us > 0).any():
        raise BadInput(f"{path}: its GNSS receiver never had a date; its times cannot be joined "
                       "with those of a log")
    start_s = float(np.median((utc_us - boot_us)[utc_us > 0])) / 1e6
    place = topics.get("vehicle_global_position")
    if place is not None:
        values = {"latitude": place["lat"], "longitude": place["lon"], "altitude": place["alt"]}
    else:
        place = gps
        values = ({"latitude": gps["latitude_deg"], "longitude": gps["longitude_deg"],
                   "altitude": gps["altitude_msl_m"]} if "latitude_deg" in gps else
                  {"latitude": gps["lat"] * 1e-7, "longitude": gps["lon"] * 1e-7,
                   "altitude": gps["alt"] * 1e-3})
    time_s = place["timestamp"].astype(float) / 1e6 + start_s
    columns = {name: np.asarray(column, dtype=float) for name, column in values.items()}
    if "vehicle_attitude" in topics:
        columns |= _attitude(topics["vehicle_attitude"], place["timestamp"].astype(float))
    return make_fixes(path, time_s, columns)


def _attitude(topic: dict[str, np.ndarray], time_us: np.ndarray) -> dict[str, np.ndarray]:
    """Return heading, pitch and roll [degrees] at the last attitude before each time.

    The quaternion turns the body's axes (forward, right, down) to north, east, down
    (PX4, VehicleAttitude).
    """
    row = np.searchsorted(topic["timestamp"].astype(float), time_us, side="right") - 1
    w, x, y, z = (topic[f"q[{i}]"].astype(float)[row.clip(0)] for i in range(4))
    heading_rad = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    angles = {"heading_deg": np.degrees(heading_rad) % 360,
              "pitch_deg": np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))),
              "roll_deg": np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2)))}
    return {name: np.where(row >= 0, angle, np.nan) for name, angle in angles.items()}
