"""Power and directions of the propagation paths of links over the 3D map, computed once and cached.

`KnownPaths` stores the paths of links and finds which of them a box, such as an unknown building,
blocks. It has no reflections at the box. The caller adds knife-edge diffraction at the box, for the
straight line only.
"""

import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry, Links
from radiotwin.propagation.paths.powers import (
    COMPONENTS,
    NO_DIRECTIONS,
    PathDirections,
    path_powers,
    paths_with_points,
)
from radiotwin.runtime.compiled import njit
from radiotwin.runtime.console import progress
from radiotwin.runtime.pieces import Piece, ResultCache
from radiotwin.runtime.processes import in_threads
from radiotwin.scene.citymap import CityMap

GRID_M = 0.5  # estimated positions are rounded to this grid, so that neighbours share their paths
MAX_REMEMBERED_BYTES = 3 * 10**8  # cache of paths: 250,000 links in a city
MIN_REMEMBERED = 2  # positions that stay in the cache, however many links they have
BATCH_LINKS = 50_000  # links whose devices are traced in parallel: 60 MB
ENDS_CHUNK = 10_000  # receivers of one device that are traced at a time: 70 MB
LINK_CHUNK = 1000  # links whose paths are held before the weakest are dropped: tens of megabytes
UNIT_STEPS = 2**15 - 1  # steps of a cached direction's component: 0.002 degrees
WEAKEST = 1e-3  # power of a dropped path, over the strongest: most are weaker, and carry little
MIN_STEP_M = 1e-9  # a leg shorter than this along an axis counts as parallel to the plane


def path_gains(geometry: LinkGeometry, kinds: tuple[str, ...] | None = None) -> np.ndarray:
    """Return the summed power gain (n,) of the paths of links between isotropic antennas, linear.

    `kinds` are fields of `PathPowers`; None: all. BadInput without a map.
    """
    columns = [COMPONENTS.index(kind) for kind in (COMPONENTS if kinds is None else kinds)]
    power = np.zeros(len(geometry))
    for rows, followed, index in _by_device(geometry):
        power[rows] = followed.powers[index][:, columns].sum(axis=1)
    return power


def interaction_gains(geometry: LinkGeometry) -> np.ndarray:
    """Return the power gain (n, 3) of direct, reflected and diffracted paths, linear.

    A path that is reflected and diffracted counts as diffracted.
    """
    diffracted = np.array(["diffracted" in kind for kind in COMPONENTS])
    direct = np.array([kind == "direct" for kind in COMPONENTS])
    power = np.zeros((len(geometry), 3))
    for rows, followed, index in _by_device(geometry):
        by_kind = followed.powers[index]
        power[rows] = np.column_stack([by_kind[:, columns].sum(axis=1) for columns in
                                       (direct, ~direct & ~diffracted, diffracted)])
    return power


def paths_of(geometry: LinkGeometry) -> PathDirections:
    """Return power and directions of every single path of n links."""
    parts = [NO_DIRECTIONS]
    for rows, followed, index in _by_device(geometry):
        paths = followed.paths.of_links(index)
        parts.append(paths._replace(link=rows[paths.link].astype(np.int32)))
    joined = PathDirections.joined(parts)
    scale = np.float32(1 / UNIT_STEPS)
    return joined._replace(departure=joined.departure * scale, arrival=joined.arrival * scale)


def declared_antenna_db(links: Links) -> np.ndarray | float:
    """Return what declared antennas add to the levels of links (n,) [dB]; the scalar 0 if none are.

    Each path's power gain is weighted by the antenna gains in its directions at both ends. A link
    without a path, or without a map, has the antenna gains along the straight line.
    """
    declared = links.declared
    if not declared.has_antennas:
        return 0.0
    straight_db = links.declared_db - declared.fed_db[links.device]
    if links.city is None:
        return straight_db
    along_db = np.full(len(links), np.nan)
    for device in np.unique(links.device).tolist():
        rows = np.flatnonzero(links.device == device)
        along_db[rows] = paths_of(links.geometry.select(rows)).antenna_gain_db(
            len(rows), declared.radios[device].antenna, declared.receiver_antenna)
    return np.where(np.isnan(along_db), straight_db, along_db)


def free_space_gains(geometry: LinkGeometry) -> np.ndarray:
    """Return the free-space power gain (n,) of links, linear (ITU-R P.525); 0 if there is no map.

    It is the reference of the power of scattered paths, which exist only over a map.
    """
    if geometry.city is None:
        return np.zeros(len(geometry))
    return (speed_of_light / geometry.frequency_hz / (4 * np.pi * geometry.distance_m)) ** 2


@dataclass(frozen=True, eq=False)
class Rays:
    """Power and directions of the paths of n links at one end, device or receiver.

    Attributes:
        link: (p,) row of the link, ascending.
        power: (p,) power gain, linear.
        direction: (p, 3) unit vectors from that end along the path.
        free_space: (n,) free-space power gain, linear; 0 if only the straight line is known.
    """

    link: np.ndarray
    power: np.ndarray
    direction: np.ndarray
    free_space: np.ndarray

    @classmethod
    def of(cls, links: Links, of_device: bool, straight: bool = False) -> "Rays":
        """Return the rays of links at their devices, or at their receivers.

        `straight`: one ray a link, along the straight line, of power 1, as without a map.
        """
        if straight or links.city is None:
            way_m = links.offset_m if of_device else -links.offset_m
            length_m = np.maximum(np.linalg.norm(way_m, axis=1, keepdims=True), 1e-9)
            return cls(np.arange(len(links)), np.ones(len(links)), way_m / length_m,
                       np.zeros(len(links)))
        paths = paths_of(links.geometry)
        return cls(paths.link, paths.power, paths.departure if of_device else paths.arrival,
                   free_space_gains(links.geometry))

    @cached_property
    def _first_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the links that have rays, and the index of the first ray of each link."""
        return np.unique(self.link, return_index=True)

    @cached_property
    def _isotropic(self) -> np.ndarray:
        """Return the power gain (n,) of links with an isotropic antenna, linear."""
        return self._sums(self.power)

    def _sums(self, power: np.ndarray) -> np.ndarray:
        """Sum the power (p,) of rays over each link; return (n,)."""
        sums, (links, first) = np.zeros(len(self.free_space)), self._first_rays
        sums[links] = np.add.reduceat(power, first, dtype=float)  # a third of bincount's time
        return sums

    def through_antenna_db(self, gain: np.ndarray, scattered_db: float = -np.inf,
                           mean_gain: float = 1.0) -> np.ndarray:
        """Return what an antenna adds to the levels (n,) [dB]; NaN for links without power.

        `gain` (p,) is that in the directions of the rays, linear; `scattered_db` the power that
        arrives scattered from all directions, relative to free space, and is received with
        `mean_gain`, linear.
        """
        scattered = self.free_space * 10 ** (scattered_db / 10)
        received = self._sums(self.power * gain) + scattered * mean_gain
        with np.errstate(invalid="ignore"):
            return 10 * np.log10(received / (self._isotropic + scattered))


class _Followed(NamedTuple):
    """Cached paths from one position to n receivers.

    Attributes:
        ends: (n,) `_keys` of the receivers' positions, sorted.
        powers: (n, kinds) power gain by `COMPONENTS`, linear.
        paths: single paths, by row of `ends`; directions times `UNIT_STEPS`, int16.
    """

    ends: np.ndarray
    powers: np.ndarray
    paths: PathDirections

    @property
    def nbytes(self) -> int:
        """Return the size in memory [bytes]."""
        return sum(array.nbytes for array in (self.ends, self.powers, *self.paths))

    def merged(self, other: "_Followed") -> "_Followed":
        """Merge with the paths from the same position to other receivers."""
        ends = np.concatenate([self.ends, other.ends])
        order = np.argsort(ends)
        others = other.paths._replace(link=other.paths.link + np.int32(len(self.ends)))
        return _Followed(ends[order], np.concatenate([self.powers, other.powers])[order],
                         PathDirections.joined([self.paths, others]).of_links(order))


_Position = tuple[float, float, float]  # [m]
_NewPaths = tuple[np.ndarray, PathDirections]  # powers and paths of `_Followed`

_remembered: OrderedDict[tuple[CityMap, _Position, float], _Followed] = OrderedDict()


def _by_device(geometry: LinkGeometry) -> Iterator[tuple[np.ndarray, _Followed, np.ndarray]]:
    """Yield a device's links, its cached paths, and the links' rows in them; BadInput: no map."""
    city = geometry.city
    if city is None:
        raise BadInput("the model paths follows paths over a 3D map, and none is given; "
                       "give it with --scene")
    devices, first, count = np.unique(geometry.device, return_index=True, return_counts=True)
    batch = np.cumsum(count) // BATCH_LINKS
    for number in np.unique(batch):
        rows = [np.flatnonzero(geometry.device == device) for device in devices[batch == number]]
        wanted = [(followed_from_m(geometry, row), geometry.receiver_m[device_links])
                  for row, device_links in zip(first[batch == number], rows, strict=True)]
        yield from ((device_links, *found) for device_links, found in zip(
            rows, _follow(city, wanted, geometry.frequency_hz), strict=True))


def followed_from_m(geometry: LinkGeometry, row: int) -> _Position:
    """Return the position from which the paths of the device of link `row` are traced [m].

    An estimated position is rounded to GRID_M, unless that lies in a building, so that estimates
    close together share cached paths. A declared position is taken as it is.
    """
    assert geometry.city is not None
    position_m = geometry.device_m[row]
    if geometry.estimated is not None and geometry.estimated[row]:
        rounded_m = np.append(np.round(position_m[:2] / GRID_M) * GRID_M, position_m[2])
        position_m = position_m if geometry.city.inside(rounded_m[None])[0] else rounded_m
    x_m, y_m, z_m = map(float, position_m)
    return x_m, y_m, z_m


def _follow(city: CityMap, wanted: list[tuple[_Position, np.ndarray]],
            frequency_hz: float) -> list[tuple[_Followed, np.ndarray]]:
    """Return the paths from each position, traced unless cached, and its receivers' rows (n,)."""
    nothing = _Followed(np.zeros(0, dtype=np.int64), np.zeros((0, len(COMPONENTS))),
                        _packed(NO_DIRECTIONS))
    keys = [_keys(ends_m) for _, ends_m in wanted]
    # Sectors of one mast have the same position and share their paths.
    at_position: dict[_Position, list[int]] = {}
    for number, (position_m, _) in enumerate(wanted):
        at_position.setdefault(position_m, []).append(number)
    known = {position_m: _remembered.pop((city, position_m, frequency_hz), nothing)
             for position_m in at_position}
    missing = {}
    for position_m, numbers in at_position.items():
        ends, old = np.concatenate([keys[number] for number in numbers]), known[position_m]
        unknown = np.append(old.ends, -1)[np.searchsorted(old.ends, ends)] != ends
        if unknown.any():
            new, first = np.unique(ends[unknown], return_index=True)
            ends_m = np.concatenate([wanted[number][1] for number in numbers])
            missing[position_m] = new, (position_m, ends_m[unknown][first])
    followed = _new_paths(city, [asked for _, asked in missing.values()], frequency_hz)
    for (position_m, (new, _)), found in zip(missing.items(), followed, strict=True):
        known[position_m] = known[position_m].merged(_Followed(new, *found))
    for position_m, paths in known.items():
        _remembered[city, position_m, frequency_hz] = paths
    while len(_remembered) > MIN_REMEMBERED \
            and sum(paths.nbytes for paths in _remembered.values()) > MAX_REMEMBERED_BYTES:
        _remembered.popitem(last=False)
    return [(known[position_m], np.searchsorted(known[position_m].ends, ends))
            for (position_m, _), ends in zip(wanted, keys, strict=True)]


def _new_paths(city: CityMap, asked: list[tuple[_Position, np.ndarray]],
               frequency_hz: float) -> list[_NewPaths]:
    """Trace the paths from positions to receivers (n, 3), or read them from an earlier run."""
    if not asked:  # usually all paths are cached, and no progress bar is needed
        return []

    def follow(number: int) -> _NewPaths:
        position_m, ends_m = asked[number]
        powers, paths = [], []
        for first in range(0, len(ends_m), ENDS_CHUNK):
            found = path_powers(city, np.array(position_m), ends_m[first:first + ENDS_CHUNK],
                                frequency_hz)
            powers.append(np.column_stack([getattr(found, name) for name in COMPONENTS]))
            link = found.directions.link + np.int32(first)
            paths.append(_packed(found.directions._replace(link=link)))
        return np.concatenate(powers), PathDirections.joined(paths)

    def write(found: _NewPaths) -> Piece:
        return {"powers": found[0], **found[1]._asdict()}, None

    def read(arrays: dict[str, np.ndarray], _: Any) -> _NewPaths:
        powers, paths = arrays.pop("powers"), PathDirections(**arrays)
        link, count = paths.link, len(paths.link)
        if powers.shape[1:] != (len(COMPONENTS),) \
                or [array.shape for array in paths] != [(count,), (count,), *[(count, 3)] * 2] \
                or (count and not 0 <= link[0] <= link[-1] < len(powers)) \
                or (np.diff(link) < 0).any():
            raise ValueError("wrong shapes, or links that do not ascend")
        return powers, paths

    cache: ResultCache[int, _NewPaths] = ResultCache(
        "paths", lambda number: (city, *asked[number], frequency_hz), write, read)
    found = {}
    for number, (_, ends_m) in enumerate(asked):
        stored = cache.get(number)
        if stored is not None and len(stored[0][0]) == len(ends_m):
            found[number] = stored[0]
    new = [number for number in range(len(asked)) if number not in found]
    with progress("following paths", total=len(new)) as advance:
        def timed(number: int) -> tuple[_NewPaths, float]:
            started = time.perf_counter()
            value = follow(number)
            advance()
            return value, time.perf_counter() - started

        # Threads trace; this one stores, since the record of warnings is shared by all threads.
        for number, (value, seconds) in zip(new, in_threads(timed, new), strict=True):
            cache.put(number, value, [], seconds)
            found[number] = value
    return [found[number] for number in range(len(asked))]


def _packed(paths: PathDirections) -> PathDirections:
    """Return paths with directions times `UNIT_STEPS` as int16, in half of the memory."""
    return paths._replace(**{end: np.round(getattr(paths, end) * UNIT_STEPS).astype(np.int16)
                             for end in ("departure", "arrival")})


def _keys(positions_m: np.ndarray) -> np.ndarray:
    """Encode positions (n, 3) [m] as integers (n,), to the centimetre; they repeat after 20 km."""
    x, y, z = (np.round(positions_m * 100).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z


class UprightBox(NamedTuple):
    """An upright box without a floor, such as an unknown building.

    Attributes:
        centre_m: x and y of its centre [m].
        half_m: half of its length and of its width [m].
        turn_rad: direction of its length, counter-clockwise from east [rad].
        top_m: z of its roof [m].
    """

    centre_m: tuple[float, float]
    half_m: tuple[float, float]
    turn_rad: float
    top_m: float


class Power(NamedTuple):
    """Power gains of n links, linear, with and without a box in the way.

    Attributes:
        direct: (n,) of the direct path.
        others: (n,) sum over the other paths that `KnownPaths` stores.
        others_past: (n,) sum over those that the box does not block.
    """

    direct: np.ndarray
    others: np.ndarray
    others_past: np.ndarray


class KnownPaths:
    """Paths of n links over a map, traced on first use, to test against boxes.

    Paths over two edges, along terrain, or with a power below WEAKEST of the strongest path's are
    left out.
    """

    def __init__(self, geometry: LinkGeometry, city: CityMap) -> None:
        self._geometry, self._city = geometry, city
        self._is_followed = np.zeros(len(geometry), dtype=bool)
        self._direct = np.zeros(len(geometry))
        self._paths: tuple[np.ndarray, ...] = ()  # link, power, points, number of points; (p, ...)

    def powers_with_box(self, box: UprightBox, rows: np.ndarray) -> Power:
        """Return the power gains of links `rows` (r,), traced if need be, past a box and in all."""
        self.follow(rows)
        if not self._paths:
            nothing = np.zeros(len(rows))
            return Power(self._direct[rows], nothing, nothing)
        link, power, points_m, count = self._paths
        power_past, n = power * ~_blocked(points_m, count, *box), len(self._geometry)
        return Power(self._direct[rows], np.bincount(link, power, n)[rows],
                     np.bincount(link, power_past, n)[rows])

    def follow(self, rows: np.ndarray) -> None:
        """Trace links `rows` (r,) not traced before, and store all but their weak paths."""
        geometry, parts = self._geometry, [self._paths] if self._paths else []
        rows = rows[~self._is_followed[rows]]
        if not len(rows):
            return
        for device in np.unique(geometry.device[rows]):
            of_device = rows[geometry.device[rows] == device]
            position_m = np.array(followed_from_m(geometry, int(of_device[0])))
            for first in range(0, len(of_device), LINK_CHUNK):
                chunk = of_device[first:first + LINK_CHUNK]
                found = paths_with_points(self._city, position_m, geometry.receiver_m[chunk],
                                          geometry.frequency_hz)
                strongest = np.zeros(len(chunk))
                np.maximum.at(strongest, found.receiver, found.power)
                strong = found.power > WEAKEST * strongest[found.receiver]
                parts.append((chunk[found.receiver[strong]], found.power[strong],
                              found.points_m[strong], found.points[strong]))
        self._paths = tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        followed = geometry.select(rows)
        self._direct[rows] = np.where(followed.los, free_space_gains(followed), 0.0)
        self._is_followed[rows] = True


@njit(cache=True, nogil=True, error_model="numpy")
def _blocked(points_m: np.ndarray, count: np.ndarray, centre_m: tuple[float, float],
             half_m: tuple[float, float], turn_rad: float, top_m: float) -> np.ndarray:
    """Return (p,) bool: a leg between the points of a path passes through an `UprightBox`."""
    out = np.zeros(len(count), dtype=np.bool_)
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    reach_m = np.hypot(half_m[0], half_m[1])
    for path in range(len(count)):
        for leg in range(count[path] - 1):
            x, y = points_m[path, leg, 0] - centre_m[0], points_m[path, leg, 1] - centre_m[1]
            to_x = points_m[path, leg + 1, 0] - centre_m[0]
            to_y = points_m[path, leg + 1, 1] - centre_m[1]
            if min(x, to_x) > reach_m or max(x, to_x) < -reach_m or min(y, to_y) > reach_m \
                    or max(y, to_y) < -reach_m:  # nearly every leg misses the circle around the box
                continue
            z, dx, dy = points_m[path, leg, 2], to_x - x, to_y - y
            enter, leave = _clip_leg(cosine * x + sine * y, cosine * dx + sine * dy, -half_m[0],
                                     half_m[0], 0.0, 1.0)
            enter, leave = _clip_leg(cosine * y - sine * x, cosine * dy - sine * dx, -half_m[1],
                                     half_m[1], enter, leave)
            enter, leave = _clip_leg(z, points_m[path, leg + 1, 2] - z, -np.inf, top_m, enter,
                                     leave)
            if enter < leave:
                out[path] = True
                break
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _clip_leg(start_m: float, step_m: float, low_m: float, high_m: float, enter: float,
              leave: float) -> tuple[float, float]:
    """Clip an interval (enter, leave) of a leg's parameter 0..1 to a slab; enter > leave: empty."""
    if abs(step_m) < MIN_STEP_M:
        return (enter, leave) if low_m <= start_m <= high_m else (1.0, 0.0)
    first, second = (low_m - start_m) / step_m, (high_m - start_m) / step_m
    return max(enter, min(first, second)), min(leave, max(first, second))
