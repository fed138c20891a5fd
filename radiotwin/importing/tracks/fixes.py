"""`Fixes`: the track of a receiver, that is positions over time."""

from dataclasses import dataclass

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.importing.source import are_few
from radiotwin.links.plausible import MAX_DEGREES, height_placeholders

ANGLES = ("heading_deg", "pitch_deg", "roll_deg")
PLACE = ("latitude", "longitude", "altitude")
COLUMNS = (*PLACE, *ANGLES)


@dataclass(frozen=True)
class Fixes:
    """Positions of one receiver over time.

    Attributes:
        time_s: (n,) ascending [s since 1970 UTC].
        values: column of `COLUMNS` -> (n,) [deg, m]; NaN: unknown.
        notes: on the file.
    """

    time_s: np.ndarray
    values: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()

    def at(self, time_s: np.ndarray, max_gap_s: float) -> dict[str, np.ndarray]:
        """Interpolate positions and angles at times (m,) [s since 1970 UTC].

        Returns:
            column -> (m,); NaN before the first and after the last position, between positions
            more than `max_gap_s` [s] apart, and where one of both values is unknown.
        """
        after = np.searchsorted(self.time_s, time_s).clip(1, max(len(self.time_s) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.time_s) - 1)
        before = np.where(time_s == self.time_s[after], after, before)
        gap_s = np.where(time_s == self.time_s[before], 0.0,
                         self.time_s[after] - self.time_s[before])
        inside = (time_s >= self.time_s[before]) & (time_s <= self.time_s[after])
        inside &= gap_s <= max_gap_s
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(gap_s > 0, (time_s - self.time_s[before]) / gap_s, 0.0)
        result = {}
        for name, values in self.values.items():
            step = values[after] - values[before]
            if name in ("longitude", "heading_deg", "roll_deg"):  # across the date line, or north
                step = (step + 180) % 360 - 180
            step = np.where(share > 0, step, 0.0)  # at a position itself the next may be unknown
            result[name] = np.where(inside, values[before] + share * step, np.nan)
        if "longitude" in result:
            result["longitude"] = (result["longitude"] + 180) % 360 - 180
        if "heading_deg" in result:
            result["heading_deg"] %= 360
        return result


def make_fixes(source: object, time_s: np.ndarray, values: dict[str, np.ndarray],
               notes: tuple[str, ...] = ()) -> Fixes:
    """Sort positions by time (n,) [s since 1970 UTC]; of several at one time the last counts.

    Positions that are unknown or 0, 0 are left out; impossible altitudes become NaN, with a note.

    Raises:
        BadInput: fewer than two have a time and a position, or many are no latitude or longitude.
    """
    known = np.isfinite(time_s) & np.isfinite(values["latitude"]) & np.isfinite(values["longitude"])
    known &= (values["latitude"] != 0) | (values["longitude"] != 0)
    for name, limit in MAX_DEGREES.items():
        wrong = known & (np.abs(values[name]) > limit)
        if wrong.any():
            text = f"{values[name][wrong][0]:g} is no {name}"
            if not are_few(int(wrong.sum()), int(known.sum())):
                raise BadInput(f"{source}: {text}; allowed are -{limit:g} to {limit:g} degrees "
                               f"({wrong.sum()} such positions)")
            notes = (*notes, f"{source}: {wrong.sum()} positions left out: {text}")
            known &= ~wrong
    if "altitude" in values and (wrong := known & height_placeholders(values["altitude"])).any():
        notes = (*notes, f"{source}: {wrong.sum()} altitudes left out, such as "
                         f"{values['altitude'][wrong][0]:g} m")
        values = {**values, "altitude": np.where(wrong, np.nan, values["altitude"])}
    time_s = time_s[known]
    last_first = np.arange(len(time_s))[::-1]
    unique_s, first = np.unique(time_s[last_first], return_index=True)
    if len(unique_s) < 2:
        raise BadInput("; ".join((f"{source} has {len(unique_s)} positions with a time; at least "
                                  "two are needed", *notes)))
    order = last_first[first]
    return Fixes(unique_s, {name: column[known][order] for name, column in values.items()}, notes)
