"""What a box in a known map would block: paths that are followed once, and held against each box.

Nothing is followed anew: what a box itself reflects is missing, and paths that bend at its edges
are there for the straight line only, as those of knife edges, which the caller adds.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from radiotwin.channel.followed_paths import followed_from_m, free_space
from radiotwin.links import LinkGeometry
from radiotwin.paths.powers import paths_with_points
from radiotwin.scene.citymap import CityMap

LINK_CHUNK = 1000  # whose paths are held before the weakest go: tens of megabytes
WEAKEST = 1e-3  # of a link's strongest path: most are weaker, and together they carry little
MIN_STEP_M = 1e-9  # a shorter leg along an axis is none along it


class UprightBox(NamedTuple):
    """Where a box stands.

    Attributes:
        centre_m: x and y [m].
        half_m: half of its length and of its width [m].
        turn_rad: of the length, counter-clockwise from east [rad].
        top_m: z of its roof [m]; below it reaches any depth.
    """

    centre_m: tuple[float, float]
    half_m: tuple[float, float]
    turn_rad: float
    top_m: float


class Power(NamedTuple):
    """Power gains (n,) of links, linear: of the direct path, of all others, of these past a box."""

    direct: np.ndarray
    others: np.ndarray
    others_past: np.ndarray


class KnownPaths:
    """The stronger paths of n links over a map, each link's followed when it is first asked for."""

    def __init__(self, geometry: LinkGeometry, city: CityMap) -> None:
        self._geometry, self._city = geometry, city
        self._is_followed = np.zeros(len(geometry), dtype=bool)
        self._direct = np.zeros(len(geometry))
        self._paths: tuple[np.ndarray, ...] = ()  # link, power, points and their number, (p, ...)

    def past(self, box: UprightBox, rows: np.ndarray) -> Power:
        """Return the power of some links (r,), without a box and past one."""
        self.follow(rows)
        if not self._paths:
            nothing = np.zeros(len(rows))
            return Power(self._direct[rows], nothing, nothing)
        link, power, points_m, count = self._paths
        power_past, n = power * ~_blocked(points_m, count, *box), len(self._geometry)
        return Power(self._direct[rows], np.bincount(link, power, n)[rows],
                     np.bincount(link, power_past, n)[rows])

    def follow(self, rows: np.ndarray) -> None:
        """Follow the paths of links (r,), of which some may be known."""
        geometry, parts = self._geometry, [self._paths] if self._paths else []
        rows = rows[~self._is_followed[rows]]
        if not len(rows):
            return
        for device in np.unique(geometry.device[rows]):
            of_device = rows[geometry.device[rows] == device]
            position_m = np.array(followed_from_m(geometry, int(of_device[0])))
            for first in range(0, len(of_device), LINK_CHUNK):
                mine = of_device[first:first + LINK_CHUNK]
                found = paths_with_points(self._city, position_m, geometry.receiver_m[mine],
                                          geometry.frequency_hz)
                strongest = np.zeros(len(mine))
                np.maximum.at(strongest, found.receiver, found.power)
                kept = found.power > WEAKEST * strongest[found.receiver]
                parts.append((mine[found.receiver[kept]], found.power[kept],
                              found.points_m[kept], found.points[kept]))
        self._paths = tuple(np.concatenate(each) for each in zip(*parts, strict=True))
        followed = geometry.select(rows)
        self._direct[rows] = np.where(followed.los, free_space(followed), 0.0)
        self._is_followed[rows] = True


@njit(cache=True, nogil=True, error_model="numpy")
def _blocked(points_m: np.ndarray, count: np.ndarray, centre_m: tuple[float, float],
             half_m: tuple[float, float], turn_rad: float, top_m: float) -> np.ndarray:
    """Return whether a leg of each path (p,) goes through a box."""
    out = np.zeros(len(count), dtype=np.bool_)
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    reach_m = np.hypot(half_m[0], half_m[1])
    for path in range(len(count)):
        for leg in range(count[path] - 1):
            x, y = points_m[path, leg, 0] - centre_m[0], points_m[path, leg, 1] - centre_m[1]
            to_x = points_m[path, leg + 1, 0] - centre_m[0]
            to_y = points_m[path, leg + 1, 1] - centre_m[1]
            if min(x, to_x) > reach_m or max(x, to_x) < -reach_m or min(y, to_y) > reach_m \
                    or max(y, to_y) < -reach_m:  # as nearly all
                continue
            z, dx, dy = points_m[path, leg, 2], to_x - x, to_y - y
            enter, leave = _within(cosine * x + sine * y, cosine * dx + sine * dy, -half_m[0],
                                   half_m[0], 0.0, 1.0)
            enter, leave = _within(cosine * y - sine * x, cosine * dy - sine * dx, -half_m[1],
                                   half_m[1], enter, leave)
            enter, leave = _within(z, points_m[path, leg + 1, 2] - z, -np.inf, top_m, enter, leave)
            if enter < leave:
                out[path] = True
                break
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _within(start_m: float, step_m: float, low_m: float, high_m: float, enter: float,
            leave: float) -> tuple[float, float]:
    """Return the part of a leg from `enter` to `leave` in which it is between two planes."""
    if abs(step_m) < MIN_STEP_M:
        return (enter, leave) if low_m <= start_m <= high_m else (1.0, 0.0)
    first, second = (low_m - start_m) / step_m, (high_m - start_m) / step_m
    return max(enter, min(first, second)), min(leave, max(first, second))
