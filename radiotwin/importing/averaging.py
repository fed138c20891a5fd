"""Local means over fast fading.

The phase of the paths turns within half a wavelength, and with it the level; shadowing changes over tens of metres. A
mean over 20 to 40 wavelengths removes the first and keeps the second (W. C. Y. Lee, "Estimate of local average power
of a mobile radio signal", IEEE Trans. Veh. Technol. 34(1), 1985), and 36 to 50 readings bring it within 1 dB.
"""

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

WAVELENGTHS = (20, 40)
TRACK = ["receiver", "device", "flight"]


def average(links: pd.DataFrame, length_m: float, how: str) -> pd.DataFrame:
    """One row for each bin of `length_m` along the way of each (receiver, device, flight).

    The way is walked in the order of time, or of the file where a track has no times. `how` is `power`, the mean of the
    linear power, or `median`. A reading that was not detected counts as the least of all, as zero power in the mean;
    where more than half were, so is the bin. With at most half of them below the limit that is off by 3 dB at worst.
    Positions and times are means, headings circular ones; `quality` is the number of readings.
    """
    links = links.reset_index(drop=True)
    track = links.groupby(TRACK, sort=False).ngroup().to_numpy()
    links, track = _walk(links, track)
    bin_of, first = _bins(links, track, length_m)
    count = np.bincount(bin_of)
    means = {name: _mean(links[name].to_numpy(dtype=float), bin_of, len(count)) for name in links
             if links[name].dtype.kind == "f" and name not in ("level_db", "heading_deg")}
    if "heading_deg" in links:
        radians = np.radians(links["heading_deg"].to_numpy())
        means["heading_deg"] = np.degrees(np.arctan2(_mean(np.sin(radians), bin_of, len(count)),
                                                     _mean(np.cos(radians), bin_of, len(count)))) % 360
    means["level_db"] = _level(links["level_db"].to_numpy(), bin_of, count, how)
    return links.iloc[first].reset_index(drop=True).assign(**means, quality=count.astype(float))


def in_wavelengths(length_m: float, frequency_hz: float) -> float:
    """A length in wavelengths."""
    return length_m * frequency_hz / speed_of_light


def _walk(links: pd.DataFrame, track: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
    """Tracks one after the other, each in the order of its way."""
    when = np.zeros(len(links))
    if "time_s" in links:
        when = links["time_s"].to_numpy(dtype=float)
        gaps = np.bincount(track, weights=np.isnan(when)) > 0
        when = np.where(gaps[track], 0.0, when)
    order = np.lexsort((np.arange(len(links)), when, track))
    return links.iloc[order].reset_index(drop=True), track[order]


def _bins(links: pd.DataFrame, track: np.ndarray, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(n,) number of each row's bin, rising, and the first row of each bin."""
    place_m = links[["receiver_x_m", "receiver_y_m", "receiver_z_m"]].fillna(0.0).to_numpy()
    step_m = np.linalg.norm(np.diff(place_m, axis=0, prepend=place_m[:1]), axis=1)
    starts = np.diff(track, prepend=-1) != 0
    step_m[starts] = 0.0
    way_m = np.cumsum(step_m)
    way_m -= way_m[starts][np.cumsum(starts) - 1]
    cell = np.floor(way_m / length_m)
    new = starts | (np.diff(cell, prepend=-1) != 0)
    return np.cumsum(new) - 1, np.flatnonzero(new)


def _mean(values: np.ndarray, bin_of: np.ndarray, bins: int) -> np.ndarray:
    """(bins,) means of what is known; NaN where nothing is."""
    known = ~np.isnan(values)
    if not known.any():
        return np.full(bins, np.nan)
    offset = values[known][0]  # epoch seconds would lose their decimals in a sum
    total = np.bincount(bin_of[known], weights=values[known] - offset, minlength=bins)
    count = np.bincount(bin_of[known], minlength=bins)
    return np.where(count > 0, total / np.maximum(count, 1) + offset, np.nan)


def _level(level_db: np.ndarray, bin_of: np.ndarray, count: np.ndarray, how: str) -> np.ndarray:
    blank = np.isnan(level_db)
    if how == "power":
        power = np.where(blank, 0.0, 10 ** (np.nan_to_num(level_db) / 10))
        with np.errstate(divide="ignore"):
            result = 10 * np.log10(np.bincount(bin_of, weights=power) / count)
    else:
        result = pd.Series(np.where(blank, -np.inf, level_db)).groupby(bin_of).median().to_numpy()
    too_weak = np.bincount(bin_of, weights=blank) > count / 2
    return np.where(too_weak | ~np.isfinite(result), np.nan, result)
