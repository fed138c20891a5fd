"""Clocks: whether the times of different flights can be compared."""

import numpy as np

Tracks = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""(receiver, flight) -> times (t,) in order [s] and positions (t, 3) then [m]."""

ELSEWHERE_M = 20.0  # a receiver is not at two places so far apart at one time
MIN_ELSEWHERE = 0.5  # share of the common times of two flights
SAME_START_S = 1.0  # flights that all begin within it begin when their clock does
MIN_FLIGHT_S = 10.0  # shorter ones may begin together by chance
MAX_FLIGHTS = 40  # of a receiver, of which neighbours are compared

RESTART_NOTE = ("time_s begins anew in each flight (flights of one receiver overlap): only times "
                "within a flight are compared, and no change from flight to flight is looked for")


def clocks_restart(tracks: Tracks) -> bool:
    """Return whether some receiver's clock begins anew in each flight.

    Then two of its flights begin at one time, or it would be at two places at once.
    """
    by_receiver: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for (receiver, _), track in tracks.items():
        by_receiver.setdefault(receiver, []).append(track)
    return any(_restarts(sorted(flights, key=lambda track: track[0][0])[:MAX_FLIGHTS])
               for flights in by_receiver.values() if len(flights) > 1)


def _restarts(flights: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Return whether flights of one receiver, by their start, are of a clock that begins anew."""
    starts_s = np.array([time_s[0] for time_s, _ in flights])
    lengths_s = np.array([time_s[-1] - time_s[0] for time_s, _ in flights])
    if np.ptp(starts_s) <= SAME_START_S and (lengths_s > MIN_FLIGHT_S).all():
        return True
    return any(_at_two_places(*pair) for pair in zip(flights, flights[1:], strict=False))


def _at_two_places(one: tuple[np.ndarray, np.ndarray],
                   other: tuple[np.ndarray, np.ndarray]) -> bool:
    (time_s, position_m), (other_s, other_m) = one, other
    both = (time_s >= other_s[0]) & (time_s <= other_s[-1])
    if both.sum() < 2:
        return False
    there_m = np.column_stack([np.interp(time_s[both], other_s, axis_m) for axis_m in other_m.T])
    apart_m = np.linalg.norm(position_m[both] - there_m, axis=1)
    return bool((apart_m > ELSEWHERE_M).mean() > MIN_ELSEWHERE)
