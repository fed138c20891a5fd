"""Reduce readings at one place: repeated rows, stays of a receiver, local means over fast fading.

A hovering receiver repeats one error, so one reading of each stay is kept. Fast fading changes the
level within half a wavelength, shadowing over tens of metres. A mean over 20 to 40 wavelengths
removes fading and keeps shadowing, and 36 to 50 readings bring it within 1 dB (W. C. Y. Lee,
"Estimate of local average power of a mobile radio signal", IEEE Trans. Veh. Technol. 34(1), 1985).
"""

from typing import Literal

import numpy as np
import pandas as pd

from radiotwin.importing.source import Source
from radiotwin.importing.tracks.fixes import ANGLES

WAVELENGTHS = (20, 40)  # Lee 1985


def average(links: pd.DataFrame, length_m: float,
            method: Literal["power", "median"]) -> pd.DataFrame:
    """Average levels in bins along the track of each receiver, device and flight.

    A track is ordered by time, or as in the file without times. A reading that was not detected
    counts as zero power in the mean, and as the smallest value in the median; a bin with more than
    half of them is not detected. With at most half of them the mean is off by at most 3 dB.

    Args:
        links: from `build_links`, with receiver positions.
        length_m: length of the bins [m].
        method: `power`, the mean of the linear power, or `median`.

    Returns:
        one row per bin: levels by `method`, means of positions and times, circular means of
        headings, pitches and rolls (-180 to 180 degrees), and the number of readings in `quality`.
    """
    links = links.reset_index(drop=True)
    track = links.groupby(["receiver", "device", "flight"], sort=False).ngroup().to_numpy()
    links, track = _in_track_order(links, track)
    bin_index, first = _bins(links, track, length_m)
    count = np.bincount(bin_index)
    means = {name: _mean(links[name].to_numpy(dtype=float), bin_index, len(count))
             for name in links
             if links[name].dtype.kind == "f" and name not in ("level_db", *ANGLES)}
    for name in (name for name in ANGLES if name in links):
        angle_rad = np.radians(links[name].to_numpy(dtype=float))
        sine, cosine = (_mean(part, bin_index, len(count))
                        for part in (np.sin(angle_rad), np.cos(angle_rad)))
        means[name] = np.degrees(np.arctan2(sine, cosine))
    if "heading_deg" in means:
        means["heading_deg"] %= 360
    means["level_db"] = _level(links["level_db"].to_numpy(), bin_index, count, method)
    bins = links.iloc[first].reset_index(drop=True)
    return bins.assign(**means, quality=count.astype(float))


def _in_track_order(links: pd.DataFrame, track: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
    """Sort links by track (n,), and within a track by time if all its times are known."""
    time_s = np.zeros(len(links))
    if "time_s" in links:
        time_s = links["time_s"].to_numpy(dtype=float)
        incomplete = np.bincount(track, weights=np.isnan(time_s)) > 0
        time_s = np.where(incomplete[track], 0.0, time_s)
    order = np.lexsort((np.arange(len(links)), time_s, track))
    return links.iloc[order].reset_index(drop=True), track[order]


def positions_m(links: pd.DataFrame) -> np.ndarray:
    """Return receiver positions (n, 3) [m]; z is above the datum, else above the ground, else 0."""
    position_m = links[["receiver_x_m", "receiver_y_m", "receiver_z_m"]].to_numpy(copy=True)
    if "receiver_above_ground_m" in links:
        low = np.isnan(position_m[:, 2])
        position_m[low, 2] = links["receiver_above_ground_m"].to_numpy()[low]
    return np.nan_to_num(position_m)


def _bins(links: pd.DataFrame, track: np.ndarray,
          length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide tracks (sorted, n labels) into bins along them; return each row's bin, first rows."""
    position_m = positions_m(links)
    step_m = np.linalg.norm(np.diff(position_m, axis=0, prepend=position_m[:1]), axis=1)
    starts = np.diff(track, prepend=-1) != 0
    step_m[starts] = 0.0
    along_m = np.cumsum(step_m)
    along_m -= along_m[starts][np.cumsum(starts) - 1]
    cell = np.floor(along_m / length_m)
    new = starts | (np.diff(cell, prepend=-1) != 0)
    return np.cumsum(new) - 1, np.flatnonzero(new)


def _mean(values: np.ndarray, bin_index: np.ndarray, bins: int) -> np.ndarray:
    """Return the mean of the known values in each bin, (bins,); NaN if there are none."""
    known = ~np.isnan(values)
    if not known.any():
        return np.full(bins, np.nan)
    offset = values[known][0]  # a sum of epoch seconds would have no decimals left
    total = np.bincount(bin_index[known], weights=values[known] - offset, minlength=bins)
    count = np.bincount(bin_index[known], minlength=bins)
    return np.where(count > 0, total / np.maximum(count, 1) + offset, np.nan)


def _level(level_db: np.ndarray, bin_index: np.ndarray, count: np.ndarray,
           method: str) -> np.ndarray:
    """Return the level of each bin [dB]: mean power, or with the `method` median the median.

    Levels not detected (NaN) count as zero power (-inf dB); with more than half a bin is NaN, too.
    """
    missed = np.isnan(level_db)
    if method == "power":
        power = np.where(missed, 0.0, 10 ** (np.nan_to_num(level_db) / 10))
        with np.errstate(divide="ignore"):
            result = 10 * np.log10(np.bincount(bin_index, weights=power) / count)
    else:
        finite = pd.Series(np.where(missed, -np.inf, level_db))
        result = finite.groupby(bin_index).median().to_numpy()
    mostly_missed = np.bincount(bin_index, weights=missed) > count / 2
    return np.where(mostly_missed | ~np.isfinite(result), np.nan, result)


def stay_representatives(links: pd.DataFrame, distance_m: float) -> np.ndarray:
    """Select the reading with the (lower) median level of each stay of a receiver, as a mask (n,).

    A stay is a run of readings of one receiver, device and flight, in the order of time, within
    `distance_m` of its first one. Readings that were not detected are the lowest levels.
    """
    track = links.groupby(["receiver", "device", "flight"], sort=False).ngroup().to_numpy()
    rows = pd.DataFrame({"row": np.arange(len(links)), "level_db": links["level_db"].to_numpy()})
    if "time_s" in links:
        rows["time_s"] = links["time_s"].to_numpy()
    ordered, track = _in_track_order(rows, track)
    stay = _stays(positions_m(links)[ordered["row"].to_numpy()], track, distance_m)
    level_db = np.nan_to_num(ordered["level_db"].to_numpy(), nan=-np.inf)
    by_level = np.lexsort((np.arange(len(stay)), level_db, stay))
    count = np.bincount(stay)
    middle = np.cumsum(count) - count + (count - 1) // 2
    chosen = np.zeros(len(links), dtype=bool)
    chosen[ordered["row"].to_numpy()[by_level[middle]]] = True
    return chosen


def _stays(position_m: np.ndarray, track: np.ndarray, distance_m: float) -> np.ndarray:
    """Return the stay of each reading, an index (n,), of readings in the order of time."""
    stay = np.empty(len(track), dtype=np.int64)
    number, current, limit_m2 = -1, None, distance_m**2
    x0 = y0 = z0 = 0.0
    for i, (label, (x, y, z)) in enumerate(zip(track.tolist(), position_m.tolist())):
        if label != current or (x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2 > limit_m2:
            number, current, x0, y0, z0 = number + 1, label, x, y, z
        stay[i] = number
    return stay


def without_repetition(source: Source) -> tuple[Source, list[int]]:
    """Drop rows that equal an earlier one in every column; return also the indices of these."""
    table = source.table
    objects = [name for name in table if table[name].dtype == object]  # lists have no hash
    comparable = table.astype(dict.fromkeys(objects, str)) if objects else table
    repeats = comparable.duplicated().to_numpy()
    return source.select(~repeats), list(table.index[repeats])
