"""What may be wrong with measured data: levels that say nothing, names, places and units that may not be meant."""

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene

MIN_LINKS = 60
MIN_LINKS_OF_RECEIVER = 5
CLOSE_M, MIN_PLACES = 0.1, 3  # so many places so close to each other are hardly in metres
MAX_NAMED = 5
MAX_OUTSIDE = 0.5  # share of the links


def refuse_empty_levels(level_db: np.ndarray, column: str) -> None:
    """Raise BadInput where levels say nothing."""
    if not np.isfinite(level_db).any():
        raise BadInput(f"nothing was detected: {column} is empty in all {len(level_db):,} rows, and at least "
                       f"{MIN_LINKS // 2} links need a level. Check that column, and that devices were in range")
    if len(level_db) > MIN_LINKS_OF_RECEIVER and np.nanmin(level_db) == np.nanmax(level_db):
        raise BadInput(f"all levels are {np.nanmin(level_db):g}, so there is nothing to explain; check the column "
                       f"{column}")


def check_names(measurements: Measurements) -> list[str]:
    """Names that may not be meant, a remark each."""
    notes = []
    for what, names in (("receivers", measurements.table["receiver"].unique()),
                        ("devices", measurements.devices["device"]), ("flights", measurements.flights)):
        names = pd.Series(names, dtype=str)
        alike = names[names.str.casefold().duplicated(keep=False)]
        if len(alike):
            notes.append(f"{what} {_some(alike)} differ in upper and lower case only; they are taken for different "
                           "ones")
    idle = measurements.devices["device"][~np.isin(np.arange(len(measurements.devices)), measurements.device_index)]
    if len(idle):
        notes.append(f"no link is to device {_some(idle)}")
    return notes


def check_positions(receiver_m: np.ndarray, device_m: np.ndarray, scene: Scene | None) -> list[str]:
    """Positions (n, 3), (k, 3) that may be in another unit or frame, a remark each.

    Raises:
        BadInput: receivers and devices are all at one place but for millimetres.
    """
    both = "receivers and devices"
    notes = {}
    for what, place_m in (("receivers", receiver_m), ("devices", device_m), (both, np.vstack([receiver_m, device_m]))):
        places = np.unique(place_m[np.isfinite(place_m[:, :2]).all(axis=1), :2], axis=0)
        if len(places) >= MIN_PLACES and np.ptp(places, axis=0).max() < CLOSE_M:
            notes[what] = (f"all {len(places):,} places of {what} lie within {np.ptp(places, axis=0).max():.2g} m: "
                             "positions are to be in metres; degrees are not converted")
    if both in notes:
        raise BadInput(notes[both])
    return [*notes.values(), *(_beside_the_map(receiver_m, scene) if scene is not None else [])]


def _beside_the_map(receiver_m: np.ndarray, scene: Scene) -> list[str]:
    known = np.isfinite(receiver_m).all(axis=1)
    inside = np.zeros(len(receiver_m), dtype=bool)
    inside[known] = scene.city.inside(receiver_m[known])
    low, high = scene.city.vertices.min(axis=0)[:2], scene.city.vertices.max(axis=0)[:2]
    outside = ((receiver_m[:, :2] < low) | (receiver_m[:, :2] > high)).any(axis=1)
    if outside.mean() > MAX_OUTSIDE:
        raise BadInput(
            f"{outside.sum():,} of {len(outside):,} links have their receiver outside the 3D map, which goes from "
            f"{_place(low)} to {_place(high)} m: give measurements and scene in one frame, in metres; feet and degrees "
            "are not converted")
    return [f"{odd.sum():,} of {len(odd):,} links have their receiver {where}: do measurements and scene share one "
            "frame and unit?" for odd, where in ((inside, "inside a building"), (outside, "outside the 3D map"))
            if odd.any()]


def _place(corner_m: np.ndarray) -> str:
    return f"({corner_m[0]:.0f}, {corner_m[1]:.0f})"


def useless_receivers(table: pd.DataFrame, level_db: np.ndarray, keep: np.ndarray) -> list[tuple[np.ndarray, str]]:
    """Links (n,) of receivers that tell nothing, and why; only the links `keep` (n,) count."""
    end, names = pd.factorize(table["receiver"], sort=True)
    links = np.bincount(end[keep], minlength=len(names))
    seen = keep & np.isfinite(level_db)
    low, high = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    np.minimum.at(low, end[seen], level_db[seen])
    np.maximum.at(high, end[seen], level_db[seen])
    heard = np.bincount(end[seen], minlength=len(names))  # one that heard once among many blanks is not stuck
    dead, stuck = (links > 0) & np.isinf(low), (heard > MIN_LINKS_OF_RECEIVER) & (low == high)
    few = (links > 0) & (links < MIN_LINKS_OF_RECEIVER) & ~dead
    count = f"{links[few].max(initial=0)} {'only' if few.sum() < 2 else 'at most'}"
    return [(dead[end], f"receiver {_some(names[dead])} never detected anything"),
            (stuck[end], f"receiver {_some(names[stuck])} always reads {_some([f'{v:g}' for v in low[stuck]])}"),
            (few[end], f"receiver {_some(names[few])} has {count}; {MIN_LINKS_OF_RECEIVER} are needed")]


def unheard_devices(table: pd.DataFrame, level_db: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, str]:
    """Links (n,) of devices that nobody detected although many tried, and what is said of them.

    A device that is off would pass for one with a huge loss. One with few links may be a place of a device that moves,
    and then its blanks are worth as much as anybody's.
    """
    end, names = pd.factorize(table["device"], sort=True)
    links, heard = (np.bincount(end[rows], minlength=len(names)) for rows in (keep, keep & np.isfinite(level_db)))
    dead = (links >= MIN_LINKS) & (heard == 0)
    return dead[end], f"device {_some(names[dead])} was never detected; is it on, and in range?"


def find_fill_value(level_db: np.ndarray) -> tuple[float | None, float]:
    """The lowest value and its share, where it stands for "not detected": far more often there than a tail would be,
    and with a gap, or a heap, that no tail has."""
    seen = level_db[np.isfinite(level_db)]
    if len(seen) < MIN_LINKS:
        return None, 0.0
    values, counts = np.unique(seen, return_counts=True)
    if len(values) < 3:
        return None, 0.0
    steps = np.diff(values)
    heap = counts[0] >= 10 and counts[0] > 5 * counts[1:6].max()
    gap = counts[0] >= 3 and steps[0] > 10 * np.median(steps[:20]) and steps[0] > 3.0
    return (float(values[0]), counts[0] / len(seen)) if heap or gap else (None, 0.0)


def _some(names) -> str:
    names = [str(name) for name in names]
    return ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED:,} more" if len(names) > MAX_NAMED else "")
