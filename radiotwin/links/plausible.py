"""Plausibility of values in measurements and tables of sites: ranges, placeholders, slips, names.

Values outside the range of their column are refused. Odd values, sites far away, and names that
nearly match give notes.
"""

import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path

import numpy as np

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.io.forms import MAX_POSITION_M

LEVELS = ["gain_db", "rssi_dbm"]
READS = "reads_levels"  # 1: levels are read at the device, as by a gateway, of what receivers send
# A measured value outside these ranges is in another unit, or a placeholder.
MAX_LEVEL_DB = 300.0  # magnitude of levels [dB] and powers [dBm]
FREQUENCIES_HZ = (1e6, 450e9)  # same as in a scene; materials of ITU-R P.2040 end at 450 GHz
MAX_TIME_S = 1e11  # the year 5138; milliseconds since 1970 exceed it
MAX_SPAN_S = 3.2e9  # a century, longer than any campaign
MAX_TILT_DEG = 90.0
MAX_AZIMUTH_DEG = 720.0  # of a fixed antenna; 999 and 65535 are placeholders
MAX_ANGLE_DEG = 1e6  # some compasses count thousands of turns
MAX_CABLE_LOSS_DB = 100.0
MAX_QUALITY = 1e15  # floats are exact whole numbers up to there
MAX_DEGREES = {"latitude": 90.0, "longitude": 360.0}
FAR_M, MAX_APART_M = 100_000.0, 1e6  # from the readings: noted; refused, as no link is so long
HEIGHTS_M = (-3_000.0, 60_000.0)  # about the deepest mine (Kidd), the highest balloon (JAXA 2013)
HIGH_M = 200.0  # above the ground: higher than masts, so probably an altitude above the sea
_EARTH_M = 6_371_008.8  # mean radius (Moritz 2000, GRS80)

_RANGES: dict[str, tuple[float, float, str]] = {
    **dict.fromkeys(LEVELS, (-MAX_LEVEL_DB, MAX_LEVEL_DB, "is no level; allowed are {} to {}")),
    "frequency_hz": (*FREQUENCIES_HZ, "is no frequency; allowed are {} to {} Hz; the unit is Hz"),
    "time_s": (-MAX_TIME_S, MAX_TIME_S,
               "is no time; allowed are {} to {} s; the unit is s, not ms"),
    "tilt_deg": (-MAX_TILT_DEG, MAX_TILT_DEG,
                 "is no tilt; allowed are {} (down) to {} (up)"),
    "azimuth_deg": (-MAX_AZIMUTH_DEG, MAX_AZIMUTH_DEG,
                    "is no azimuth; allowed are 0 (north) to 360, clockwise; leave the cell empty "
                    "where it is not known"),
    "cable_loss_db": (0.0, MAX_CABLE_LOSS_DB, "is no loss; allowed are {} to {} dB"),
    "_m": (-MAX_POSITION_M, MAX_POSITION_M,
           "is too far away; allowed are {} to {} m in the scene's frame"),
    **{ending: (-limit, limit, "is out of range; allowed are {} to {}") for ending, limit in (
        ("_deg", MAX_ANGLE_DEG), ("tx_power_dbm", MAX_LEVEL_DB), ("eirp_dbm", MAX_LEVEL_DB),
        ("quality", MAX_QUALITY))}}
"""Column, or the end of its name -> smallest and largest value, and why others are refused."""


def refuse_implausible(refuse: Callable[[np.ndarray, str], None], name: str,
                  numbers: np.ndarray) -> None:
    """Refuse values (n,) outside the plausible range of their column `name`; NaN passes.

    `refuse` is called with a mask (n,) of bad values and the reason; it raises if any is true.
    """
    for ending, (low, high, reason) in _RANGES.items():
        if name == ending or name.endswith(ending):
            refuse((numbers < low) | (numbers > high), reason.format(f"{low:g}", f"{high:g}"))
    if name == "gain_db":
        refuse(numbers > 0,
               "is above 0 dB, which no channel gain is; received power [dBm] goes into a column "
               "rssi_dbm, and a path loss needs a minus sign")
    if name == "time_s" and np.isfinite(numbers).any():
        refuse(numbers - np.nanmin(numbers) > MAX_SPAN_S,
               f"is more than a century ({MAX_SPAN_S:g} s) after the first time, "
               f"{np.nanmin(numbers):g} s; is one of them wrong, or in another unit?")
    if name == READS:
        refuse(~np.isin(numbers, (0, 1)) & ~np.isnan(numbers),
               "is neither 0 (levels are read at the receiver) nor 1 (at the device)")


def height_placeholders(height_m: np.ndarray) -> np.ndarray:
    """Return which heights (k,) [m] are placeholders, such as -9999 and 99999."""
    return (height_m < HEIGHTS_M[0]) | (height_m > HEIGHTS_M[1])


def tilt_notes(tilt_deg: np.ndarray) -> list[str]:
    """Note tilts (k,) [deg, upwards] that are probably downtilts: some above zero, none below."""
    up, known = tilt_deg > 0, np.isfinite(tilt_deg)
    if not up.any() or (tilt_deg < 0).any():
        return []
    return [f"{up.sum()} of {known.sum()} declared tilts are above zero, which is upwards, and "
            "none is below; where the table counts downtilts, call the column downtilt_deg"]


def high_notes(above_ground_m: np.ndarray) -> list[str]:
    """Note heights above the ground (k,) [m] that look like altitudes above the sea.

    They do if all that are known are `HIGH_M` or more.
    """
    known_m = above_ground_m[np.isfinite(above_ground_m)]
    if not len(known_m) or known_m.min() < HIGH_M:
        return []
    return [f"the lowest of {len(known_m)} sites is {known_m.min():.0f} m above the ground; if "
            "those are altitudes above the sea, call the column altitude_m, and give the ground's "
            "in the origin"]


def far_notes(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str],
              where: Callable[[int], str], what: str) -> list[str]:
    """Note sites that are more than `FAR_M` from the readings or the map.

    `place` (k, 2) are latitude and longitude [deg], or x and y [m], NaN: unknown; `middle` (2,) is
    called `what` in messages, and a row `where(row)`. BadInput if the farthest site is farther away
    than any link is long, or a typing error explains its position.
    """
    apart_m = _distance_m(place, middle, axes)
    far = np.flatnonzero(apart_m > FAR_M)  # not of NaN
    if not len(far):
        return []
    row = int(far[np.argmax(apart_m[far])])
    slip = _slip(place[row], middle, axes)
    text = (f"{where(row)} at {axes[0]} {place[row, 0]:.10g}, {axes[1]} {place[row, 1]:.10g} is "
            f"{apart_m[row] / 1000:,.0f} km from {what} ({axes[0]} {middle[0]:.10g}, {axes[1]} "
            f"{middle[1]:.10g})" + (f"; {len(far)} are so far away" if len(far) > 1 else ""))
    if slip or apart_m[row] > MAX_APART_M:
        raise BadInput(f"{text}: {slip or 'both need one frame, and one unit'}")
    return [text]


def _slip(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str]) -> str:
    """Guess which typing error put a position (2,) too far away, as a question; `""` if none.

    Around the origin of a local frame nothing is tried, as dividing any x and y by ten often enough
    would bring them there.
    """
    if "latitude" not in axes and np.linalg.norm(middle) <= FAR_M:
        return ""
    if "latitude" in axes and not place.any():
        return "0, 0 is a placeholder; leave both empty where they are not known"
    tries = [(place[::-1], f"are {axes[0]} and {axes[1]} swapped?")]
    for sign in ([-1, 1], [1, -1], [-1, -1]):
        turned = place * sign
        tries.append((turned, f"is a sign wrong ({turned[0]:.10g}, {turned[1]:.10g})?"))
    for power in (1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6):
        for axis in ([1, 0], [0, 1], [1, 1]):
            moved = place * 10.0 ** (power * np.array(axis))
            tries.append((moved, f"has a decimal point slipped ({moved[0]:.10g}, "
                                 f"{moved[1]:.10g})?"))
    return next((text for moved, text in tries
                 if _distance_m(moved[None], middle, axes)[0] <= FAR_M), "")


def _distance_m(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str]) -> np.ndarray:
    """Return the distance (k,) [m] of positions (k, 2) from one, on the globe or in a plane."""
    if "latitude" in axes:
        return distances_m(place, middle)
    return np.linalg.norm(place - middle, axis=1)


def distances_m(place_deg: np.ndarray, middle_deg: np.ndarray) -> np.ndarray:
    """Return great-circle distances [m] from places (k, 2) to one place (2,), latitude first [deg].

    A latitude beyond 90 degrees is infinitely far away (inf).
    """
    (lat, lon), (middle_lat, middle_lon) = np.radians(place_deg).T, np.radians(middle_deg)
    chord = (np.sin((lat - middle_lat) / 2)**2
             + np.cos(lat) * np.cos(middle_lat) * np.sin((lon - middle_lon) / 2)**2)
    apart_m = 2 * _EARTH_M * np.arcsin(np.sqrt(np.clip(chord, 0, 1)))
    return np.where(np.abs(place_deg[:, 0]) > MAX_DEGREES["latitude"], np.inf, apart_m)


def unmatched_notes(path: Path | str, names: Iterable[str], read: Collection[str], end: str
                    ) -> list[str]:
    """Note names that only a table of sites has; then also those that only the log (`read`) has."""
    idle = list(dict.fromkeys(name for name in names if name not in read))
    lacking = sorted(set(read) - set(names))
    notes, file = [], Path(path).name
    if idle:
        loose = {_loosely(name): name for name in lacking}
        pairs = [f"{name} ({loose[_loosely(name)]} there)" for name in idle
                 if _loosely(name) in loose]
        notes.append(f"{file}: {len(idle)} of {len(set(names)):,} names occur in no row of the "
                     f"log: {some(pairs or idle)}"
                     + ("; names are compared letter by letter: make them equal" if pairs else ""))
    if lacking and idle:
        notes.append(f"{file}: {len(lacking)} of {len(read):,} {end}s of the log are not in it: "
                     f"{some(lacking)}")
    return notes


def _loosely(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, without case, punctuation and leading zeros."""
    parts = re.findall(r"\d+|[^\W\d_]+", re.sub(r"(?<=\d)\.0+$", "", name.casefold()))
    return tuple(part.lstrip("0") or "0" if part.isdigit() else part for part in parts)
