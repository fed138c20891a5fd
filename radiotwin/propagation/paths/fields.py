"""Power gain of a path, and its complex gain between vertically polarised antennas.

The field of the ray is followed from one interaction to the next. Polarisation is followed even
where the result is averaged over it: every vertical wall reflects the vertical polarisation more
strongly than the horizontal one.
"""

import numpy as np

from radiotwin.propagation.paths.images import Candidates, PathBuffer, sequence_length
from radiotwin.propagation.paths.interactions import Slabs, diffract, reflect
from radiotwin.propagation.paths.surfaces import MATERIAL, Surfaces
from radiotwin.propagation.paths.vectors import cross, dot
from radiotwin.runtime.compiled import njit

VERTICAL, AVERAGE = 0, 1


@njit(cache=True, nogil=True, error_model="numpy")
def path_gains(
    surfaces: Surfaces, candidates: Candidates, wave_number: float, slabs: Slabs,
    polarisation: int, wedge: int, buffer: PathBuffer, rows: np.ndarray, gain: np.ndarray,
) -> None:
    """Compute the power gains of paths between isotropic antennas.

    Args:
        surfaces: of the map.
        candidates: that the paths were found with.
        wave_number: 2 π / wavelength [1/m].
        slabs: materials of the map.
        polarisation: VERTICAL of both antennas; or AVERAGE over those of the transmitting one,
            where the receiving one takes in all.
        wedge: LUEBBERS or SIONNA, see `radiotwin.propagation.paths.interactions`.
        buffer: the paths.
        rows: (m,) paths of the buffer to compute.
        gain: (m,) output, linear.
    """
    field = np.empty(3, dtype=np.complex128)
    max_legs = buffer.points_m.shape[1] - 1
    direction, length_m = np.empty((max_legs, 3)), np.empty(max_legs)
    for i in range(len(rows)):
        path = rows[i]
        legs = take_legs(buffer, path, direction, length_m)
        power = 0.0
        for sent in range(1 + polarisation):
            send(direction[0], sent, field)
            spread = follow_field(surfaces.planes, surfaces.edges, candidates,
                                  buffer.candidate[path], wave_number, slabs, wedge, direction,
                                  length_m, legs, field)
            if polarisation == VERTICAL:
                power += spread * abs(dot(field, vertical(direction[legs - 1]))) ** 2
            else:
                power += 0.5 * spread \
                    * (abs(field[0]) ** 2 + abs(field[1]) ** 2 + abs(field[2]) ** 2)
        gain[i] = power / (2.0 * wave_number) ** 2


@njit(cache=True, error_model="numpy")
def send(direction: np.ndarray, polarisation: int, field: np.ndarray) -> None:
    """Write the field of a ray as it leaves: 0 as vertical as it can be, 1 across that."""
    polarised = vertical(direction)
    if polarisation == 1:
        polarised = cross(direction, polarised)
    for axis in range(3):
        field[axis] = polarised[axis]


@njit(cache=True, error_model="numpy")
def take_legs(buffer: PathBuffer, path: int, direction: np.ndarray, length_m: np.ndarray) -> int:
    """Write the unit vector and the length of each leg of a path [m]; return how many there are."""
    legs = buffer.count[path] - 1
    for k in range(legs):
        direction[k] = buffer.points_m[path, k + 1] - buffer.points_m[path, k]
        length_m[k] = max(np.sqrt((direction[k] ** 2).sum()), 1e-9)
        direction[k] /= length_m[k]
    return legs


@njit(cache=True, error_model="numpy")
def follow_field(
    planes: np.ndarray, edges: np.ndarray, candidates: Candidates, row: int, wave_number: float,
    slabs: Slabs, wedge: int, direction: np.ndarray, length_m: np.ndarray, legs: int,
    field: np.ndarray,
) -> float:
    """Change the field along one path; return the spreading factor of its power [1/m²]."""
    before = sequence_length(candidates.before, row)
    edge = candidates.edge[row]
    for k in range(legs - 1):
        if k < before:
            facet = candidates.before[row, k]
            reflect(planes[facet, :3], int(planes[facet, MATERIAL]), direction[k], slabs, field)
        elif k > before:
            facet = candidates.after[row, k - before - 1]
            reflect(planes[facet, :3], int(planes[facet, MATERIAL]), direction[k], slabs, field)
        else:
            diffract(edges, edge, direction[k], direction[k + 1], length_m[:before + 1].sum(),
                     length_m[before + 1:legs].sum(), wave_number, slabs, wedge, field)
    if edge < 0:
        return 1.0 / length_m[:legs].sum() ** 2
    before_m, after_m = length_m[:before + 1].sum(), length_m[before + 1:legs].sum()
    return 1.0 / (before_m * after_m * (before_m + after_m))


@njit(cache=True, error_model="numpy")
def vertical(direction: np.ndarray) -> np.ndarray:
    """Return the unit vector of a ray's vertical polarisation; north for a vertical ray."""
    flat2 = direction[0] ** 2 + direction[1] ** 2
    if flat2 < 1e-12:
        return np.array([0.0, 1.0, 0.0])
    return (np.array([0.0, 0.0, 1.0]) - direction[2] * direction) / np.sqrt(flat2)


@njit(cache=True, nogil=True, error_model="numpy")
def path_amplitudes(
    surfaces: Surfaces, candidates: Candidates, wave_number: float, slabs: Slabs,
    wedge: int, buffer: PathBuffer, rows: np.ndarray, amplitude: np.ndarray, total_m: np.ndarray,
) -> None:
    """Compute the complex gains of paths between vertically polarised isotropic antennas.

    Args:
        surfaces: of the map.
        candidates: that the paths were found with.
        wave_number: 2 π / wavelength [1/m].
        slabs: materials of the map.
        wedge: as of `path_gains`.
        buffer: the paths.
        rows: (m,) paths of the buffer to compute.
        amplitude: (m,) complex output: received over sent field, with the phase of the delay, for
            fields that vary as exp(+j ω t); its squared magnitude is the gain of `path_gains`.
        total_m: (m,) output: lengths of the paths [m].
    """
    field = np.empty(3, dtype=np.complex128)
    max_legs = buffer.points_m.shape[1] - 1
    direction, length_m = np.empty((max_legs, 3)), np.empty(max_legs)
    for i in range(len(rows)):
        path = rows[i]
        legs = take_legs(buffer, path, direction, length_m)
        send(direction[0], 0, field)
        spread = follow_field(surfaces.planes, surfaces.edges, candidates,
                              buffer.candidate[path], wave_number, slabs, wedge, direction,
                              length_m, legs, field)
        total_m[i] = length_m[:legs].sum()
        amplitude[i] = dot(field, vertical(direction[legs - 1])) * np.sqrt(spread) \
            / (2.0 * wave_number) * np.exp(-1j * wave_number * total_m[i])
