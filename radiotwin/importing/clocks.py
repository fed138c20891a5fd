"""Clocks that begin anew, or overlap: a receiver would be at two places at once."""

import numpy as np
import pandas as pd

NEAR_S = 1.0  # between two readings of which both places are known
ELSEWHERE_M = 20.0  # within that time, for which a receiver would have to fly
FAST_M_S = 100.0  # beyond this it does not fly
MIN_PAIRS = 3  # of readings at two places, that are no single bad fix
MIN_SHARE = 0.02  # of the pairs of readings that follow each other so fast


def clock_notes(links: pd.DataFrame) -> list[str]:
    """Return notes on receivers whose times put them at two places at once.

    Args:
        links: with receiver positions, and `time_s` or not.
    """
    if "time_s" not in links:
        return []
    notes = []
    columns = ["time_s", "flight", "receiver_x_m", "receiver_y_m"]
    for receiver, own in links.groupby("receiver", sort=False)[columns]:
        own = own.dropna().drop_duplicates(columns[0:1] + columns[2:]).sort_values("time_s",
                                                                                 kind="stable")
        step_s = np.diff(own["time_s"].to_numpy())
        step_m = np.linalg.norm(np.diff(own[columns[2:]].to_numpy(), axis=0), axis=1)
        near = step_s <= NEAR_S
        apart = near & (step_m > ELSEWHERE_M + FAST_M_S * step_s)
        if apart.sum() < max(MIN_PAIRS, MIN_SHARE * near.sum()):
            continue
        flight = own["flight"].to_numpy()
        at = np.flatnonzero(apart)
        others = at[flight[at] != flight[at + 1]]
        if len(others) > len(at) / 2:
            pair = sorted({flight[others[0]], flight[others[0] + 1]})
            notes.append(
                f"the times of flights {pair[0]!r} and {pair[1]!r} overlap, and receiver "
                f"{receiver!r} would be at two places at once ({len(at)} times): is a clock wrong, "
                "or are they several receivers (--columns receiver=\"by file\")?")
        else:
            notes.append(
                f"receiver {receiver!r} would be at two places at once ({len(at)} times, first in "
                f"flight {flight[at[0]]!r}): its clock began anew, or it is several receivers; "
                "split the log where the clock goes back, or name them")
    return notes
