"""Powers and directions of the paths of links over the 3D map, each followed once."""

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.links import LinkData, LinkGeometry
from radiotwin.pieces import kept
from radiotwin.scene.citymap import CityMap

GRID_M = 0.5  # estimated positions of devices are rounded to it, and share their paths
MAX_REMEMBERED = 300_000  # links: 200 MB
MIN_REMEMBERED = 2  # devices, however many links they have


def path_gains(geometry: LinkGeometry, kinds: tuple[str, ...] | None = None) -> np.ndarray:
    """Return the power gain (n,) of some kinds of paths between isotropic antennas.

    Args:
        geometry: n links over a map.
        kinds: names of `radiotwin.paths.PathPowers`' components; None: all.
    """
    from radiotwin.paths.powers import COMPONENTS  # late, as everywhere here: numba is large

    columns = [COMPONENTS.index(kind) for kind in (COMPONENTS if kinds is None else kinds)]
    power = np.zeros(len(geometry))
    for rows, followed, index in _by_device(geometry):
        power[rows] = followed.powers[index][:, columns].sum(axis=1)
    return power


def interaction_gains(geometry: LinkGeometry) -> np.ndarray:
    """Return the power gain (n, 3) of the direct, the reflected and the diffracted paths.

    A path with an edge is diffracted, whatever else it has.

    Args:
        geometry: n links over a map.
    """
    from radiotwin.paths.powers import COMPONENTS

    diffracted = np.array(["diffracted" in kind for kind in COMPONENTS])
    direct = np.array([kind == "direct" for kind in COMPONENTS])
    power = np.zeros((len(geometry), 3))
    for rows, followed, index in _by_device(geometry):
        by_kind = followed.powers[index]
        power[rows] = np.column_stack([by_kind[:, which].sum(axis=1) for which in
                                       (direct, ~direct & ~diffracted, diffracted)])
    return power


def paths_of(links: LinkData, kinds: tuple[str, ...]) -> np.ndarray:
    """Return `path_gains` (n,) of measured links."""
    return path_gains(links.geometry, kinds)


def rays_of(links: LinkData, end: str) -> np.ndarray:
    """Return power times direction of the paths at one end of links.

    Args:
        links: n links over a map.
        end: `departures` or `arrivals`, see `radiotwin.paths.PathPowers`.

    Returns:
        (n, sectors, 3)
    """
    from radiotwin.paths.powers import SECTORS

    rays = np.zeros((len(links), SECTORS, 3), dtype=np.float32)
    for rows, followed, index in _by_device(links.geometry):
        rays[rows] = getattr(followed, end)[index]
    return rays


def free_space(geometry: LinkGeometry) -> np.ndarray:
    """Return the power gain (n,) along the straight line if nothing were in the way (ITU-R P.525).

    0 without a map, where the straight line is all that is known.
    """
    if geometry.city is None:
        return np.zeros(len(geometry))
    return (speed_of_light / geometry.frequency_hz / (4 * np.pi * geometry.distance_m)) ** 2


def through_antenna_db(power: np.ndarray, gain: np.ndarray, scattered: np.ndarray,
                       mean_gain: float) -> np.ndarray:
    """Return what an antenna adds to links (n,) [dB].

    Args:
        power: (n, sectors) of the rays.
        gain: (n, sectors) of the antenna in their directions, linear.
        scattered: (n,) power from everywhere.
        mean_gain: of the antenna over all directions, linear.
    """
    received = (power * gain).sum(axis=1) + scattered * mean_gain
    return 10 * np.log10(received / (power.sum(axis=1) + scattered))


class _Followed(NamedTuple):
    """Paths from one position to ends.

    Attributes:
        ends: (n,) keys of the ends, sorted.
        powers: (n, kinds)
        departures, arrivals: (n, sectors, 3)
    """

    ends: np.ndarray
    powers: np.ndarray
    departures: np.ndarray
    arrivals: np.ndarray


_remembered: OrderedDict[
    tuple[CityMap, tuple[float, float, float], float], _Followed] = OrderedDict()


def _by_device(geometry: LinkGeometry) -> Iterator[tuple[np.ndarray, _Followed, np.ndarray]]:
    """Yield of each device: its links, what was followed, and each link's row of that."""
    city = geometry.city
    if city is None:
        raise BadInput("the channel image_paths follows paths over a 3D map, and none is given; "
                       "give it with --scene")
    for device in np.unique(geometry.device):
        rows = np.flatnonzero(geometry.device == device)
        position_m = geometry.device_m[rows[0]]
        if geometry.estimated is not None and geometry.estimated[rows[0]]:
            rounded_m = np.append(np.round(position_m[:2] / GRID_M) * GRID_M, position_m[2])
            position_m = position_m if city.inside(rounded_m[None])[0] else rounded_m
        x_m, y_m, z_m = map(float, position_m)
        followed, index = _follow(city, (x_m, y_m, z_m), geometry.receiver_m[rows],
                                  geometry.frequency_hz)
        yield rows, followed, index


def _follow(city: CityMap, position_m: tuple[float, float, float], ends_m: np.ndarray,
            frequency_hz: float) -> tuple[_Followed, np.ndarray]:
    """Return the paths from one position to ends (n, 3), and the row of each end."""
    from radiotwin.paths.powers import COMPONENTS, SECTORS

    key = (city, position_m, frequency_hz)
    wanted = _keys(ends_m)
    no_rays = np.zeros((0, SECTORS, 3), dtype=np.float32)
    nothing = _Followed(wanted[:0], np.zeros((0, len(COMPONENTS))), no_rays, no_rays)
    known = _remembered.pop(key, nothing)
    index = np.searchsorted(known.ends, wanted)
    unknown = np.append(known.ends, -1)[index] != wanted
    if unknown.any():
        new, first = np.unique(wanted[unknown], return_index=True)
        new_m = ends_m[unknown][first]
        order = np.argsort(np.concatenate([known.ends, new]))
        more = (new, *_new_paths(city, position_m, new_m, frequency_hz))
        known = _Followed(*(np.concatenate([old, each])[order]
                            for old, each in zip(known, more, strict=True)))
        index = np.searchsorted(known.ends, wanted)
    _remembered[key] = known
    while len(_remembered) > MIN_REMEMBERED \
            and sum(len(each.ends) for each in _remembered.values()) > MAX_REMEMBERED:
        _remembered.popitem(last=False)
    return known, index


_NewPaths = tuple[np.ndarray, np.ndarray, np.ndarray]


def _new_paths(city: CityMap, position_m: tuple[float, float, float], ends_m: np.ndarray,
               frequency_hz: float) -> _NewPaths:
    """Return powers, departures and arrivals as of `_Followed` to ends (n, 3)."""
    from radiotwin.paths.powers import COMPONENTS, SECTORS, path_powers

    shapes = [(len(ends_m), len(COMPONENTS)), *[(len(ends_m), SECTORS, 3)] * 2]

    def follow() -> _NewPaths:
        found = path_powers(city, np.array([position_m]), ends_m, np.zeros(len(ends_m), int),
                            frequency_hz, "vertical")
        powers = np.column_stack([getattr(found, name) for name in COMPONENTS])
        return powers, found.departures.astype(np.float32), found.arrivals.astype(np.float32)

    def read(arrays: dict[str, np.ndarray], _: Any) -> _NewPaths:
        values = arrays["powers"], arrays["departures"], arrays["arrivals"]
        if [each.shape for each in values] != shapes:
            raise ValueError("other shapes")
        return values

    return kept("paths", (city, position_m, ends_m, frequency_hz), follow,
                lambda found: (dict(zip(("powers", "departures", "arrivals"), found)), None), read)


def _keys(positions_m: np.ndarray) -> np.ndarray:
    """Return (n,) positions (n, 3) to the centimetre as one integer; equal ones are 20 km apart."""
    x, y, z = (np.round(positions_m * 100).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z
