"""Powers and directions of the paths of links, each followed once."""

from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.closeloop.records import Records
from radiotwin.paths import path_powers
from radiotwin.paths.powers import COMPONENTS, SECTORS
from radiotwin.scene.citymap import CityMap

GRID_M = 1.0  # estimated positions of devices, which no estimate tells better, are rounded to it and share their paths
KEPT = 300_000  # links that are remembered: 200 MB
FEWEST_KEPT = 2  # devices, however many links they have


def paths_of(records: Records, kinds: tuple[str, ...]) -> np.ndarray:
    """(n,) power gain of some kinds of paths, followed once for each pair of positions."""
    power = np.zeros(len(records))
    for rows, followed, place in _by_device(records):
        power[rows] = sum(followed.powers[place, COMPONENTS.index(kind)] for kind in kinds)
    return power


def rays_of(records: Records, end: str) -> np.ndarray:
    """(n, sectors, 3) power times direction of the paths of links at an end, `departures` or `arrivals`; see
    `radiotwin.paths.PathPowers`."""
    rays = np.zeros((len(records), SECTORS, 3), dtype=np.float32)
    for rows, followed, place in _by_device(records):
        rays[rows] = getattr(followed, end)[place]
    return rays


def free_space(records: Records) -> np.ndarray:
    """(n,) power gain along the straight line if nothing stood in the way (ITU-R P.525); 0 where there is no map, and
    the straight line is all that is known."""
    if records.city is None:
        return np.zeros(len(records))
    return (speed_of_light / records.frequency_hz / (4 * np.pi * records.distance_m)) ** 2


def through_antenna_db(power: np.ndarray, gain: np.ndarray, scattered: np.ndarray, mean_gain: float) -> np.ndarray:
    """(n,) what an antenna makes of links [dB].

    Args:
        power: (n, sectors) of the rays.
        gain: (n, sectors) of the antenna in their directions, linear.
        scattered: (n,) power from everywhere.
        mean_gain: of the antenna over all directions, linear.
    """
    return 10 * np.log10(((power * gain).sum(axis=1) + scattered * mean_gain) / (power.sum(axis=1) + scattered))


class _Followed(NamedTuple):
    """Paths from one place to ends.

    Attributes:
        city: the map; while it is held here, no other has its id.
        ends: (n,) keys of the ends, sorted.
        powers: (n, kinds)
        departures, arrivals: (n, sectors, 3)
    """

    city: CityMap
    ends: np.ndarray
    powers: np.ndarray
    departures: np.ndarray
    arrivals: np.ndarray


_remembered: OrderedDict[tuple, _Followed] = OrderedDict()


def _by_device(records: Records) -> Iterator[tuple[np.ndarray, _Followed, np.ndarray]]:
    """Of each device: its links, what was followed, and the rows of that."""
    assert records.city is not None  # paths are followed over a map
    for device in np.unique(records.device):
        rows = np.flatnonzero(records.device == device)
        place_m = records.device_m[device]
        if device not in records.anchors:
            rounded_m = np.append(np.round(place_m[:2] / GRID_M) * GRID_M, place_m[2])
            place_m = place_m if records.city.inside(rounded_m[None])[0] else rounded_m
        x_m, y_m, z_m = map(float, place_m)
        followed, place = _follow(records.city, (x_m, y_m, z_m), records.receiver_m[rows], records.frequency_hz)
        yield rows, followed, place


def _follow(city: CityMap, place_m: tuple[float, float, float], ends_m: np.ndarray,
            frequency_hz: float) -> tuple[_Followed, np.ndarray]:
    """The paths from one place to ends (n, 3), and the row of each; what was followed before is remembered."""
    key = (id(city), place_m, frequency_hz)
    wanted = _keys(ends_m)
    no_rays = np.zeros((0, SECTORS, 3), dtype=np.float32)
    nothing = _Followed(city, wanted[:0], np.zeros((0, len(COMPONENTS))), no_rays, no_rays)
    known = _remembered.pop(key, nothing)
    place = np.searchsorted(known.ends, wanted)
    unknown = np.append(known.ends, -1)[place] != wanted
    if unknown.any():
        new, first = np.unique(wanted[unknown], return_index=True)
        new_m = ends_m[unknown][first]
        found = path_powers(city, np.array([place_m]), new_m, np.zeros(len(new_m), int), frequency_hz, "vertical")
        ends = np.concatenate([known.ends, new])
        order = np.argsort(ends)
        powers = np.column_stack([getattr(found, name) for name in COMPONENTS])
        known = _Followed(city, *(np.concatenate([old, more.astype(old.dtype)])[order] for old, more in zip(
            known[1:], (new, powers, found.departures, found.arrivals))))
        place = np.searchsorted(known.ends, wanted)
    _remembered[key] = known
    while len(_remembered) > FEWEST_KEPT and sum(len(each.ends) for each in _remembered.values()) > KEPT:
        _remembered.popitem(last=False)
    return known, place


def _keys(ends_m: np.ndarray) -> np.ndarray:
    """(n,) places (n, 3) to the centimetre, as one number each; two alike are 20 km apart at least."""
    x, y, z = (np.round(ends_m * 100).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z
