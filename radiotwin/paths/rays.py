"""Each path between devices and receivers by itself: field, way, angles and interactions."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.paths.amplitudes import path_amplitudes
from radiotwin.paths.candidates import candidate_search
from radiotwin.paths.clearance import found_clear
from radiotwin.paths.coefficients import slabs_of
from radiotwin.paths.images import MAX_INTERACTIONS, Candidates, PathBuffer
from radiotwin.paths.wedges import LUEBBERS
from radiotwin.scene.citymap import CityMap

RECEIVER_CHUNK = 500  # receivers at once
PATH_CHUNK = 20_000  # paths at once: about 10 MB
NO_INTERACTION, REFLECTION, DIFFRACTION = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths from one device, sorted by receiver and delay.

    Attributes:
        receiver: (p,) row of the receiver.
        amplitude: (p,) complex gain between vertically polarised isotropic antennas, with the phase
            of the delay, for fields that vary as exp(+j ω t).
        length_m: (p,) [m].
        kinds: (p, MAX_INTERACTIONS) of each interaction, then NO_INTERACTION.
        points_m: (p, MAX_INTERACTIONS, 3) points of interaction [m], then NaN.
        departure: (p, 3) unit vectors from the device along the path.
        arrival: (p, 3) unit vectors from the receiver along the path.
    """

    receiver: np.ndarray
    amplitude: np.ndarray
    length_m: np.ndarray
    kinds: np.ndarray
    points_m: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    @property
    def delay_s(self) -> np.ndarray:
        """(p,) delays [s]."""
        return self.length_m / speed_of_light


def follow_rays(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray, frequency_hz: float,
                depth: int = 4) -> Iterator[tuple[Rays, int]]:
    """Follow the paths from a device to receivers, some receivers at a time.

    Args:
        city: 3D map.
        device_m: (3,) position [m].
        receiver_m: (n, 3) positions [m].
        frequency_hz: carrier frequency [Hz].
        depth: maximum number of interactions of a path, 1 to 6.

    Yields:
        The paths to the next receivers, whose rows are among all, and the number of these.
    """
    search = candidate_search(city, depth)
    candidates = search.candidates(device_m)
    kinds = _kinds(candidates)
    # Fields are added here: with Sionna RT's wedge they would step at the shadow boundary
    wave_number = 2 * np.pi * frequency_hz / speed_of_light
    slabs = slabs_of((*city.materials, city.ground_material), frequency_hz)
    buffer = PathBuffer.allocate(PATH_CHUNK)
    for first in range(0, len(receiver_m), RECEIVER_CHUNK):
        ends_m = np.ascontiguousarray(receiver_m[first:first + RECEIVER_CHUNK], dtype=float)
        parts = [_direct(city, device_m, ends_m, wave_number)]
        for rows in found_clear(city, search.surfaces, candidates, device_m, ends_m, buffer):
            amplitude, length_m = np.empty(len(rows), dtype=complex), np.empty(len(rows))
            path_amplitudes(search.surfaces, candidates, wave_number, slabs, LUEBBERS, buffer,
                            rows, amplitude, length_m)
            parts.append(_rays(buffer, rows, kinds[buffer.candidate[rows]], amplitude, length_m))
        yield _joined(parts, first), len(ends_m)


def _direct(city: CityMap, device_m: np.ndarray, ends_m: np.ndarray, wave_number: float) -> Rays:
    """Return the straight paths (ITU-R P.525-4, eq. 4) to the ends that see the device."""
    seen = np.flatnonzero(city.line_of_sight(device_m, ends_m))
    length_m = np.linalg.norm(ends_m[seen] - device_m, axis=1)
    forth = (ends_m[seen] - device_m) / np.maximum(length_m, 1e-9)[:, None]
    amplitude = np.exp(-1j * wave_number * length_m) / np.maximum(2 * wave_number * length_m, 1e-9)
    return Rays(seen, amplitude, length_m, np.zeros((len(seen), MAX_INTERACTIONS), dtype=np.int8),
                np.full((len(seen), MAX_INTERACTIONS, 3), np.nan), forth, -forth)


def _rays(buffer: PathBuffer, rows: np.ndarray, kinds: np.ndarray, amplitude: np.ndarray,
          length_m: np.ndarray) -> Rays:
    points_m, last = buffer.points_m[rows], buffer.count[rows] - 1
    path = np.arange(len(rows))
    ends = [points_m[:, 1] - points_m[:, 0], points_m[path, last - 1] - points_m[path, last]]
    departure, arrival = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9)
                          for each in ends)
    between_m = np.where(kinds[:, :, None] == NO_INTERACTION, np.nan, points_m[:, 1:-1])
    return Rays(buffer.receiver[rows], amplitude, length_m, kinds, between_m, departure, arrival)


def _kinds(candidates: Candidates) -> np.ndarray:
    """Return the (c, MAX_INTERACTIONS) kinds of interactions of each candidate."""
    before, after = (candidates.before >= 0).sum(axis=1), (candidates.after >= 0).sum(axis=1)
    over_edge = candidates.edge >= 0
    place = np.arange(MAX_INTERACTIONS)
    used = place < (before + over_edge + after)[:, None]
    at_edge = over_edge[:, None] & (place == before[:, None])
    return np.where(used, np.where(at_edge, DIFFRACTION, REFLECTION),
                    NO_INTERACTION).astype(np.int8)


def _joined(parts: list[Rays], first: int) -> Rays:
    """Return the paths of several parts, sorted, with receivers counted from `first`."""
    joined = [np.concatenate([getattr(part, name) for part in parts])
              for name in Rays.__dataclass_fields__]
    order = np.lexsort((joined[2], joined[0]))
    receiver, *others = (each[order] for each in joined)
    return Rays(receiver + first, *others)
