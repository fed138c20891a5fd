"""Compute the power of all paths between a device and receivers: `path_powers`."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.candidates import DEVICE_RAYS, candidate_search
from radiotwin.propagation.paths.facets import expand
from radiotwin.propagation.paths.fields import buffer_gains
from radiotwin.propagation.paths.images import (
    MAX_INTERACTIONS,
    Candidates,
    PathBuffer,
    found_clear,
    unit_vectors,
)
from radiotwin.propagation.paths.interactions import city_slabs
from radiotwin.propagation.paths.two_edges import paths_over_two_edges, two_edge_gains
from radiotwin.propagation.terrain import is_far, terrain_paths
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.citymap import CityMap

PATH_CHUNK = 50_000  # paths at a time: about 30 MB
DARK_CHUNK = 100  # receivers at a time to which paths over two edges are searched
DEPTH = 4  # largest number of interactions of a path
WEAK_SHARE = 1e-3  # of a link's power: weaker paths are not tried from nearby positions
NEGLECTED = 1e-5  # of a link's power: the weakest paths, whose directions are dropped


class PathsWithPoints(NamedTuple):
    """Paths from one device with their points of interaction.

    Attributes:
        receiver: (p,) row of the receiver.
        power: (p,) power gain between isotropic antennas, linear.
        points_m: (p, m, 3) device, points of interaction, receiver [m]; then unused rows.
        points: (p,) number of used rows in `points_m`.
    """

    receiver: np.ndarray
    power: np.ndarray
    points_m: np.ndarray
    points: np.ndarray


class PathDirections(NamedTuple):
    """Power and directions of single paths, from which antenna gains are computed.

    The weakest paths of a link, which together carry less than `NEGLECTED` of its power, are left
    out: at most 0.04 dB, with an antenna whose gain varies by 30 dB over the paths of the link.

    Attributes:
        link: (p,) int32 row of the link, ascending.
        power: (p,) float32 power gain between isotropic antennas, linear.
        departure: (p, 3) float32 unit vectors from the device along the path.
        arrival: (p, 3) float32 unit vectors from the receiver along the path.
    """

    link: np.ndarray
    power: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence["PathDirections"]) -> "PathDirections":
        """Concatenate paths and sort them by link."""
        link = np.concatenate([part.link for part in parts])
        order = np.argsort(link, kind="stable")
        return cls(*(np.concatenate(arrays)[order] for arrays in zip(*parts, strict=True)))

    def of_links(self, rows: np.ndarray) -> "PathDirections":
        """Select the paths of links `rows` (r,) and number the links anew, 0 to r - 1."""
        first, end = (np.searchsorted(self.link, rows, side) for side in ("left", "right"))
        link, within = expand(end - first)
        path = first[link] + within
        return PathDirections(link.astype(np.int32), *(array[path] for array in self[1:]))

    def antenna_gain_db(self, links: int, device_antenna: Antenna | None,
                        receiver_antenna: Antenna | None = None) -> np.ndarray:
        """Return what antennas add to the level of each link (links,) [dB]; NaN without a path.

        Each path is weighted by the gains in its directions, and stays vertically polarised.
        """
        gain_dbi = np.zeros(len(self.link))
        for antenna, ray in ((device_antenna, self.departure), (receiver_antenna, self.arrival)):
            if antenna is not None:
                gain_dbi += antenna.gain_dbi(ray)
        with np.errstate(invalid="ignore"):
            return 10 * np.log10(np.bincount(self.link, self.power * 10 ** (gain_dbi / 10), links)
                                 / np.bincount(self.link, self.power, links))


NO_DIRECTIONS = PathDirections(np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32),
                               *np.zeros((2, 0, 3), dtype=np.float32))


@dataclass(frozen=True, eq=False)
class PathPowers:
    """Power gains (n,) between vertically polarised isotropic antennas, linear, by kind of path.

    A single reflection by the ground is `ground`; with other interactions it counts as a
    reflection. Powers are added, not fields: the interference of nearly coincident rays is missing.

    Attributes:
        direct: free space; 0 if blocked.
        reflected_1: one reflection, not by the ground.
        reflected_2: two reflections, at most one of them by the ground.
        reflected_more: three or more reflections.
        diffracted: one diffraction, on either side of the shadow boundary.
        reflected_diffracted: one diffraction, and reflections before or after it.
        diffracted_2: diffractions at two edges; searched only for links without another path.
        ground: one reflection, by the ground: z = 0, or a triangle of the terrain.
        diffracted_terrain: diffraction along the terrain profile, see
            `radiotwin.propagation.terrain`, if terrain blocks the link and there is no other path,
            and beyond the horizon. Links over more than 5 km have only this or, with line of sight,
            `direct` with the loss of the profile.
        directions: power and directions of single paths.
        strongest: candidates of the paths that carry nearly all power, and all edges that the
            device sees: those to try from positions a few metres away.
    """

    direct: np.ndarray
    reflected_1: np.ndarray
    reflected_2: np.ndarray
    reflected_more: np.ndarray
    diffracted: np.ndarray
    reflected_diffracted: np.ndarray
    diffracted_2: np.ndarray
    ground: np.ndarray
    diffracted_terrain: np.ndarray
    directions: PathDirections
    strongest: Candidates

    @property
    def total(self) -> np.ndarray:
        """Return the power gain (n,) summed over all kinds, linear."""
        return np.sum([getattr(self, name) for name in COMPONENTS], axis=0)


COMPONENTS = tuple(field.name for field in fields(PathPowers))[:-2]


def path_powers(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray, frequency_hz: float, *,
                depth: int = DEPTH, rays: int = DEVICE_RAYS, candidates: Candidates | None = None
                ) -> PathPowers:
    """Find the paths from a device (3,) to receivers (n, 3) [m], and add up their powers by kind.

    Surfaces are slabs of the map's materials, the ground is a half space of `city.ground_material`.
    Ends inside buildings are accepted, but their results mean little. Paths have up to `depth`
    interactions, 1 to 6; `rays` are shot from the device to find sequences of facets, or else
    `candidates` are tried, such as the `strongest` of a nearby position. BadInput if a position or
    the frequency is no number, or the depth is out of its range.
    """
    device_m = np.asarray(device_m, dtype=float)
    receiver_m = np.ascontiguousarray(receiver_m, dtype=float)
    if not (np.isfinite(device_m).all() and np.isfinite(receiver_m).all()):
        raise BadInput("device_m and receiver_m must hold finite positions [m]")
    if not 0 < frequency_hz < np.inf:
        raise BadInput(f"frequency_hz is {frequency_hz}; it must be positive")
    if not 1 <= depth <= MAX_INTERACTIONS:
        raise BadInput(f"depth is {depth}; allowed are 1 to {MAX_INTERACTIONS}")
    wave_number = 2 * np.pi * frequency_hz / speed_of_light
    powers = np.zeros((len(COMPONENTS), len(receiver_m)))
    powers[0] = _direct(city, device_m, receiver_m, wave_number)
    far = is_far(device_m, receiver_m)
    near = np.flatnonzero(~far)
    in_los = near[powers[0, near] > 0]
    straight_m = receiver_m[in_los] - device_m
    directions = [_directions(in_los, powers[0, in_los], straight_m, -straight_m)]
    search = candidate_search(city, depth)
    buffer = PathBuffer.allocate(PATH_CHUNK)
    slabs = city_slabs(city, frequency_hz)
    if candidates is None:
        candidates = search.candidates(device_m, rays)
    kind = _kinds(candidates, search.is_ground)
    found = [(np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0))]
    for clear in found_clear(city, search.surfaces, candidates, device_m, receiver_m[near], buffer):
        gain = buffer_gains(search.surfaces, candidates, wave_number, slabs, buffer, clear)
        link, candidate = near[buffer.receiver[clear]], buffer.candidate[clear]
        np.add.at(powers, (kind[candidate], link), gain)
        found.append((candidate, link, gain))
        directions.append(_directions(link, gain, *buffer.end_legs_m(clear)))
    over_seen_edge = (candidates.before[:, 0] < 0) & (candidates.edge >= 0)
    strongest = _strongest_candidates(candidates, found, powers.sum(axis=0), over_seen_edge)
    dark = near[powers[:, near].sum(axis=0) == 0]
    if len(dark) and depth > 1:
        to_try = search.pairs_of_edges(np.unique(candidates.edge[over_seen_edge]))
        for first in range(0, len(dark), DARK_CHUNK):
            part = dark[first:first + DARK_CHUNK]
            pairs = paths_over_two_edges(city, search.surfaces, to_try, device_m, receiver_m[part])
            gain = two_edge_gains(search.surfaces, wave_number, slabs, pairs.edge, pairs.points_m)
            link, legs_m = part[pairs.receiver], np.diff(pairs.points_m, axis=1)
            np.add.at(powers, (COMPONENTS.index("diffracted_2"), link), gain)
            directions.append(_directions(link, gain, legs_m[:, 0], -legs_m[:, 2]))
    dark = near[powers[:, near].sum(axis=0) == 0]
    rows = np.concatenate([
        np.flatnonzero(far), dark[city.hidden_by_ground(device_m[None], receiver_m[dark])]])
    along = terrain_paths(city, device_m, receiver_m[rows], frequency_hz)
    kinds = np.where(powers[0, rows] > 0, 0, COMPONENTS.index("diffracted_terrain"))
    powers[kinds, rows] = along.gain
    directions.append(_directions(rows, along.gain, along.edge_m - device_m,
                                  along.edge_m - receiver_m[rows]))
    return PathPowers(*powers, _strongest(  # type: ignore[call-arg]  # a row a kind
        PathDirections.joined(directions), len(receiver_m)), strongest)


def _strongest_candidates(candidates: Candidates, found: Sequence[tuple[np.ndarray, ...]],
                          total: np.ndarray, over_seen_edge: np.ndarray) -> Candidates:
    """Select the candidates of strong paths, to try again from positions close by.

    Also one for each edge that the device sees. `found` holds candidate, link and power (p,) of
    paths, `total` (n,) is a link's power.
    """
    candidate, link, power = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    is_chosen = over_seen_edge & (candidates.after[:, :1] < 0).all(axis=1)
    is_chosen[candidate[power > WEAK_SHARE * total[link]]] = True
    return Candidates(*(array[is_chosen] for array in candidates))


def paths_with_points(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray,
                      frequency_hz: float) -> PathsWithPoints:
    """Find single paths from a device (3,) to receivers (n, 3) [m], with points of interaction.

    Unlike `path_powers`, without direct paths, paths over two edges, and along terrain.
    """
    search = candidate_search(city, DEPTH)
    candidates, buffer = search.candidates(device_m), PathBuffer.allocate(PATH_CHUNK)
    wave_number, slabs = 2 * np.pi * frequency_hz / speed_of_light, city_slabs(city, frequency_hz)
    no_points = np.zeros((0, *buffer.points_m.shape[1:]), dtype=np.float32)
    no_rows = np.zeros(0, dtype=int)
    parts = [PathsWithPoints(no_rows, np.zeros(0), no_points, no_rows)]
    for clear in found_clear(city, search.surfaces, candidates, device_m,
                             np.ascontiguousarray(receiver_m, dtype=float), buffer):
        gain = buffer_gains(search.surfaces, candidates, wave_number, slabs, buffer, clear)
        parts.append(PathsWithPoints(buffer.receiver[clear], gain,
                                     buffer.points_m[clear].astype(np.float32),
                                     buffer.count[clear]))
    return PathsWithPoints(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _directions(link: np.ndarray, power: np.ndarray, departure_m: np.ndarray,
                arrival_m: np.ndarray) -> PathDirections:
    """Return paths (p,) with unit vectors of their legs (p, 3) [m] from device and receiver."""
    departure, arrival = (unit_vectors(leg_m).astype(np.float32)
                          for leg_m in (departure_m, arrival_m))
    return PathDirections(link.astype(np.int32), power.astype(np.float32), departure, arrival)


def _strongest(paths: PathDirections, links: int) -> PathDirections:
    """Keep the strongest paths; drop the weakest up to `NEGLECTED` of a link's power in sum."""
    total = np.bincount(paths.link, paths.power, links)
    share = paths.power / np.maximum(total, 1e-300)[paths.link]
    order = np.lexsort((share, paths.link))
    cumulated = np.cumsum(share[order])
    before = np.concatenate([[0.0], cumulated])[np.searchsorted(paths.link, paths.link)]
    is_strong = np.zeros(len(share), dtype=bool)
    is_strong[order] = cumulated - before > NEGLECTED
    return PathDirections(*(array[is_strong] for array in paths))


def _direct(city: CityMap, from_m: np.ndarray, to_m: np.ndarray, wave_number: float) -> np.ndarray:
    """Return the free-space power gains (n,), linear (ITU-R P.525-4, eq. 4); 0 if blocked."""
    distance_m = np.linalg.norm(to_m - from_m, axis=1)
    gain = 1 / np.maximum(2 * wave_number * distance_m, 1e-9) ** 2
    return np.where(city.line_of_sight(from_m, to_m), gain, 0.0)


def _kinds(candidates: Candidates, is_ground: np.ndarray) -> np.ndarray:
    """Return the kind of path, an index of COMPONENTS (c,), of each candidate."""
    reflections = (candidates.before >= 0).sum(axis=1) + (candidates.after >= 0).sum(axis=1)
    only_ground = ((candidates.before >= 0) <= is_ground[candidates.before]).all(axis=1)
    over_edge = np.where(reflections > 0, COMPONENTS.index("reflected_diffracted"),
                         COMPONENTS.index("diffracted"))
    reflected = np.where(only_ground, COMPONENTS.index("ground"), np.minimum(reflections, 3))
    return np.where(candidates.edge >= 0, over_edge, reflected)
