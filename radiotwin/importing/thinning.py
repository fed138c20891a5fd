"""One reading of a stay: a receiver that hovers reads one and the same error many times."""

import numpy as np
import pandas as pd

from radiotwin.importing.averaging import in_track_order, positions_m


def stay_representatives(links: pd.DataFrame, distance_m: float) -> np.ndarray:
    """Choose one reading of each stay: the one with the (lower) median level.

    A stay is a run of readings of one receiver, device and flight, in the order of time, that are
    within a distance of the first of them. A reading that was not detected is below all others.

    Args:
        links: n rows with receiver positions.
        distance_m: [m].

    Returns:
        (n,) bool, the readings that represent a stay.
    """
    track = links.groupby(["receiver", "device", "flight"], sort=False).ngroup().to_numpy()
    rows = pd.DataFrame({"row": np.arange(len(links)), "level_db": links["level_db"].to_numpy()})
    if "time_s" in links:
        rows["time_s"] = links["time_s"].to_numpy()
    ordered, track = in_track_order(rows, track)
    stay = _stays(positions_m(links)[ordered["row"].to_numpy()], track, distance_m)
    level_db = np.nan_to_num(ordered["level_db"].to_numpy(), nan=-np.inf)
    by_level = np.lexsort((np.arange(len(stay)), level_db, stay))
    count = np.bincount(stay)
    middle = np.cumsum(count) - count + (count - 1) // 2
    chosen = np.zeros(len(links), dtype=bool)
    chosen[ordered["row"].to_numpy()[by_level[middle]]] = True
    return chosen


def _stays(position_m: np.ndarray, track: np.ndarray, distance_m: float) -> np.ndarray:
    """Return the number of the stay of each reading, (n,) ascending."""
    stay = np.empty(len(track), dtype=np.int64)
    number, current, limit = -1, None, distance_m**2
    x0 = y0 = z0 = 0.0
    for i, (own, (x, y, z)) in enumerate(zip(track.tolist(), position_m.tolist())):
        if own != current or (x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2 > limit:
            number, current, x0, y0, z0 = number + 1, own, x, y, z
        stay[i] = number
    return stay
