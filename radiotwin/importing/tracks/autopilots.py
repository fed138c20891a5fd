"""Read tracks from flight logs: ArduPilot's DataFlash and MAVLink logs, and PX4's ULog.

A DataFlash log (.bin, or as text .log) describes itself: FMT messages have the name, length and
fields of each kind [1]. A telemetry log (.tlog) has MAVLink packets [2], each after the time of its
arrival [us, UTC].

A ULog (.ulg) [3] is a header of 16 bytes and messages: size (2 bytes), type (1 byte), body. pyulog
is slow on damaged files and allocates as many fields as a format declares, so it gets only the
messages that a track needs, after a check.

[1] ArduPilot, libraries/AP_Logger/LogStructure.h: the letters of formats
[2] https://mavlink.io/en/guide/serialization.html and message_definitions/common.xml
[3] https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

import io
import math
import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput, optional_package
from radiotwin.importing.tracks.fixes import PLACE, Fixes, make_fixes
from radiotwin.io.budgets import FILE_BYTES, ROWS
from radiotwin.io.inputs import open_input, read_bytes

_LETTERS = {"a": "64s", "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f",
            "d": "d", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I",
            "L": "i", "M": "B", "q": "q", "Q": "Q", "g": "e"}
_FACTORS = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
_MAGIC, _FMT, _FMT_BYTES = b"\xa3\x95", 128, 89
_GPS_EPOCH_S = 315_964_800  # 1980-01-06 in UTC
_WEEK_S = 604_800.0
_LEAPS = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (1_230_768_000, 15),
          (1_136_073_600, 14), (915_148_800, 13))
"""Start [s, UTC] and GPS time minus UTC [s] (IERS Bulletin C)."""
_FIX_3D = 3  # GPS_Status with a height
_POSITION, _ATTITUDE = 33, 30  # GLOBAL_POSITION_INT, ATTITUDE
_PACKETS = {_POSITION: ("<IiiiihhhH", 104), _ATTITUDE: ("<Iffffff", 39)}
"""Message -> struct of its fields, and the extra byte of its check sum (CRC_EXTRA)."""
_ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
_ULOG_MAGIC = b"ULog\x01\x12\x35"
_MAX_BODY = 2**16  # of a message, by the format
_FIELD = re.compile(r"(?:u?int(?:8|16|32|64)_t|float|double|bool|char)(?:\[(\d{1,5})\])? \w+")
_GPS = ("vehicle_gps_position", "sensor_gps")
_TOPICS = ["vehicle_global_position", *_GPS, "vehicle_attitude"]


def read_dataflash(path: Path) -> Fixes:
    """Read 3D fixes of the first GPS receiver, and attitude, from a DataFlash log; or BadInput."""
    content = read_bytes(path, "flight log of ArduPilot")
    is_text = content[:4] == b"FMT,"
    gps: list[list[float]] = []  # since boot [s], GPS week, time of week [s], lat, lon, altitude
    attitude: list[list[float]] = []  # since boot [s], roll, pitch, yaw [deg]
    for name, fields in _text_messages(content) if is_text else _messages(content):
        clock_s = fields.get("TimeUS", fields.get("TimeMS", math.nan) * 1e3) / 1e6
        if name == "ATT":
            attitude.append([clock_s, *(fields.get(each, math.nan)
                                        for each in ("Roll", "Pitch", "Yaw"))])
        elif fields.get("Status", 0) >= _FIX_3D and fields.get("I", 0) == 0:
            gps.append([clock_s, fields.get("GWk", fields.get("Week", math.nan)),
                        fields.get("GMS", fields.get("TimeMS", math.nan)) / 1e3,
                        *(fields.get(each, math.nan) for each in ("Lat", "Lng", "Alt"))])
        ROWS.check(len(gps) + len(attitude), path)
    if not gps:
        raise BadInput(f"{path} has no message GPS with a fix in three dimensions; is it a "
                       "DataFlash log of ArduPilot?")
    columns = np.array(gps, dtype=float).T
    time_s = _GPS_EPOCH_S + columns[1] * _WEEK_S + columns[2]
    leap_s = np.full(len(time_s), float(_LEAPS[-1][1]))
    for since_s, number in reversed(_LEAPS):
        leap_s[time_s - number >= since_s] = number
    values = dict(zip(PLACE, columns[3:]))
    values |= _nearest(np.array(attitude, dtype=float).reshape(-1, 4), columns[0])
    return make_fixes(path, time_s - leap_s, values)


def _nearest(attitude: np.ndarray, clock_s: np.ndarray) -> dict[str, np.ndarray]:
    """Return roll, pitch and yaw (n,) [deg] at the nearest time, however far, of rows (m, 4).

    A row is time [s], roll, pitch, yaw.
    """
    if not len(attitude):
        return {}
    after = np.searchsorted(attitude[:, 0], clock_s).clip(0, len(attitude) - 1)
    before = (after - 1).clip(0)
    nearer = np.abs(attitude[before, 0] - clock_s) < np.abs(attitude[after, 0] - clock_s)
    return dict(zip(_ANGLES, attitude[np.where(nearer, before, after), 1:].T))


def _messages(content: bytes) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the GPS and ATT messages of a binary ArduPilot log: name, and label -> number."""
    lengths = {_FMT: _FMT_BYTES}
    kinds: dict[int, tuple[str, str, list[str]]] = {}
    at = content.find(_MAGIC)
    while 0 <= at <= len(content) - 3:
        length = lengths.get(content[at + 2], 0)
        if content[at:at + 2] != _MAGIC or not length:
            at = content.find(_MAGIC, at + 1)
            continue
        body = content[at + 3:at + length]
        if len(body) < length - 3:
            return  # cut off
        if content[at + 2] == _FMT:
            number, size, name, letters, labels = struct.unpack("<BB4s16s64s", body)
            lengths[number] = max(size, 3)
            text = [part.rstrip(b"\0").decode("ascii", "replace")
                    for part in (name, letters, labels)]
            if text[0] in ("GPS", "ATT") and all(letter in _LETTERS for letter in text[1]):
                kinds[number] = text[0], text[1], text[2].split(",")
        elif content[at + 2] in kinds:
            name_, letters_, labels_ = kinds[content[at + 2]]
            form = "<" + "".join(_LETTERS[letter] for letter in letters_)
            if struct.calcsize(form) == len(body):
                yield name_, {
                    label: value * _FACTORS.get(letter, 1.0) for label, value, letter in
                    zip(labels_, struct.unpack(form, body), letters_)
                    if isinstance(value, (int, float))}
        at += length


def _text_messages(content: bytes) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the GPS and ATT messages of an ArduPilot log in text form: name, label -> number."""
    labels: dict[str, list[str]] = {}
    for line in content.decode("ascii", "replace").splitlines():
        fields = [field.strip() for field in line.split(",")]
        if fields[0] == "FMT" and len(fields) > 5:
            labels[fields[3]] = fields[5:]
        elif fields[0] in ("GPS", "ATT") and fields[0] in labels:
            numbers = {}
            for label, field in zip(labels[fields[0]], fields[1:]):
                try:
                    numbers[label] = float(field)
                except ValueError:
                    continue
            yield fields[0], numbers


def read_tlog(path: Path) -> Fixes:
    """Read a MAVLink telemetry log: the track of the vehicle with most positions; or BadInput."""
    positions: dict[int, list[list[float]]] = {}
    attitudes: dict[int, list[list[float]]] = {}
    damaged = 0
    for time_s, system, number, body in _packets(read_bytes(path, "telemetry log")):
        if body is None:
            damaged += 1
            continue
        fields = struct.unpack(_PACKETS[number][0], body)
        if number == _ATTITUDE:
            roll, pitch, yaw = (math.degrees(value) for value in fields[1:4])
            attitudes.setdefault(system, []).append([time_s, roll, pitch, yaw % 360])
        else:
            positions.setdefault(system, []).append(
                [time_s, fields[1] * 1e-7, fields[2] * 1e-7, fields[3] * 1e-3])
        ROWS.check(sum(map(len, positions.values())) + sum(map(len, attitudes.values())), path)
    if not positions:
        raise BadInput(f"{path} has no message GLOBAL_POSITION_INT; is it a telemetry log (.tlog) "
                       "of MAVLink?")
    system = Counter({each: len(rows) for each, rows in positions.items()}).most_common(1)[0][0]
    columns = np.array(positions[system], dtype=float).T
    notes = [f"{path.name}: {damaged} damaged messages are left out"] if damaged else []
    if len(positions) > 1:
        notes.append(f"{path.name}: of {len(positions)} vehicles number {system} is read")
    values = dict(zip(PLACE, columns[1:]))
    values |= _nearest(np.array(attitudes.get(system, []), dtype=float).reshape(-1, 4), columns[0])
    return make_fixes(path, columns[0], values, tuple(notes))


def _packets(content: bytes) -> Iterator[tuple[float, int, int, bytes | None]]:
    """Yield time [s], vehicle, message number and body of needed packets; damaged: body None."""
    at = 0
    while at + 16 < len(content):
        magic, length = content[at + 8], content[at + 9]
        if magic == 0xFE:
            header, number, system, end = 6, content[at + 13], content[at + 11], 2
        elif magic == 0xFD:
            header, system = 10, content[at + 13]
            number = int.from_bytes(content[at + 15:at + 18], "little")
            end = 15 if content[at + 10] & 1 else 2
        else:
            at += 1
            continue
        start = at + 8 + header
        packet = content[at + 9:start + length]
        check = content[start + length:start + length + 2]
        if number in _PACKETS and len(check) == 2:
            form, extra = _PACKETS[number]
            size = struct.calcsize(form)
            whole = _checksum(packet + bytes([extra])) == int.from_bytes(check, "little")
            body = packet[header - 1:].ljust(size, b"\0")[:size]  # zeros at its end are cut off
            time_s = int.from_bytes(content[at:at + 8], "big") / 1e6
            yield time_s, system, number, body if whole else None
        at = start + length + end


def _checksum(data: bytes) -> int:
    """Return the check sum of MAVLink, CRC-16/MCRF4XX."""
    value = 0xFFFF
    for byte in data:
        low = byte ^ (value & 0xFF)
        low = (low ^ (low << 4)) & 0xFF
        value = (value >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return value


def _needed_messages(path: Path, topics: Collection[str]) -> io.BytesIO:
    """Copy what concerns some topics from a PX4 log (ULog), up to where it is cut off."""
    result = io.BytesIO()
    subscribed: set[bytes] = set()
    count = 0
    with open_input(path, "PX4 flight log (.ulg)") as file:
        head = file.read(16)
        if not head.startswith(_ULOG_MAGIC):
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
    """Raise BadInput if a topic of a PX4 log has nested fields, or arrays that are too large."""
    found = [_FIELD.fullmatch(field) for field in fields.rstrip(";").split(";")]
    if not all(found) or sum(int(each[1] or 1) for each in found if each) > _MAX_BODY:
        raise BadInput(f"{path}: its topic {name} has an unusual format; convert its position to "
                       "GPX or a table")


def read_ulog(path: Path) -> Fixes:
    """Read positions (estimated, else of the GNSS receiver) and attitude from a PX4 flight log.

    Its times count from the start of the autopilot; the GNSS receiver gives UTC.

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
    """Return the positions of a PX4 log: estimated ones, else of the GNSS receiver; with angles."""
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
