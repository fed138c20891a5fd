"""Power gains and complex gains of single paths, from the ray's field at each interaction."""

import numpy as np

from radiotwin.propagation.paths.images import (
    MAX_INTERACTIONS,
    Candidates,
    PathBuffer,
    sequence_length,
)
from radiotwin.propagation.paths.interactions import Slabs, diffract, reflect
from radiotwin.propagation.paths.surfaces import MATERIAL, Surfaces, Triple, dot
from radiotwin.runtime.compiled import njit


@njit(cache=True, nogil=True, error_model="numpy")
def buffer_gains(surfaces: Surfaces, candidates: Candidates, wave_number: float, slabs: Slabs,
                 buffer: PathBuffer, rows: np.ndarray) -> np.ndarray:
    """Compute the power gains (m,), linear, of paths in rows (m,) of a buffer.

    Between vertically polarised isotropic antennas; the wave number is 2 π / wavelength [1/m].
    """
    gain = np.empty(len(rows))
    legs, field = np.empty((MAX_INTERACTIONS + 1, 4)), np.empty(3, dtype=np.complex128)
    for i in range(len(rows)):
        received, spread, _ = _received_field(surfaces, candidates, wave_number, slabs, buffer,
                                              rows[i], legs, field)
        gain[i] = spread * abs(received) ** 2 / (2.0 * wave_number) ** 2
    return gain


@njit(cache=True, nogil=True, error_model="numpy")
def buffer_amplitudes(surfaces: Surfaces, candidates: Candidates, wave_number: float, slabs: Slabs,
                      buffer: PathBuffer, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the complex gains (m,) and lengths (m,) [m] of paths; arguments as in `buffer_gains`.

    Received over transmitted field, with the phase of the delay, for fields that vary as exp(+j ω
    t); its squared magnitude is the power gain.
    """
    amplitude, total_m = np.empty(len(rows), dtype=np.complex128), np.empty(len(rows))
    legs, field = np.empty((MAX_INTERACTIONS + 1, 4)), np.empty(3, dtype=np.complex128)
    for i in range(len(rows)):
        received, spread, total_m[i] = _received_field(surfaces, candidates, wave_number, slabs,
                                                       buffer, rows[i], legs, field)
        amplitude[i] = received * np.sqrt(spread) / (2.0 * wave_number) \
            * np.exp(-1j * wave_number * total_m[i])
    return amplitude, total_m


@njit(cache=True, error_model="numpy")
def _received_field(surfaces: Surfaces, candidates: Candidates, wave_number: float, slabs: Slabs,
                    buffer: PathBuffer, path: int, legs: np.ndarray, field: np.ndarray
                    ) -> tuple[complex, float, float]:
    """Compute the field of one path at the receiver by reflecting and diffracting it on the way.

    Overwrites `legs` and `field`. Returns the received field, the spreading factor of its power
    [1/m²], and the length [m].
    """
    planes, row, count = surfaces.planes, buffer.candidate[path], buffer.count[path] - 1
    direction, length_m = legs[:count, :3], legs[:count, 3]
    for k in range(count):
        for axis in range(3):
            direction[k, axis] = buffer.points_m[path, k + 1, axis] - buffer.points_m[path, k, axis]
        length_m[k] = max(np.sqrt(dot(direction[k], direction[k])), 1e-9)
        for axis in range(3):
            direction[k, axis] /= length_m[k]
    before, edge = sequence_length(candidates.before, row), candidates.edge[row]
    before_m, after_m = length_m[:before + 1].sum(), length_m[before + 1:].sum()
    field[0], field[1], field[2] = vertical(direction[0])
    for k in range(count - 1):
        if k == before:
            diffract(surfaces.edges, edge, direction[k], direction[k + 1], before_m, after_m,
                     wave_number, slabs, field)
        else:
            facet = candidates.before[row, k] if k < before \
                else candidates.after[row, k - before - 1]
            reflect(planes[facet, :3], int(planes[facet, MATERIAL]), direction[k], slabs, field)
    received, total_m = dot(field, vertical(direction[count - 1])), length_m.sum()
    if edge < 0:
        return received, 1.0 / total_m ** 2, total_m
    return received, 1.0 / (before_m * after_m * (before_m + after_m)), total_m


@njit(cache=True, error_model="numpy")
def vertical(direction: np.ndarray) -> Triple:
    """Return the unit vector of vertical polarisation for a ray; north if the ray is vertical."""
    flat2 = direction[0] ** 2 + direction[1] ** 2
    if flat2 < 1e-12:
        return 0.0, 1.0, 0.0
    size, z = np.sqrt(flat2), direction[2]
    return -(z * direction[0]) / size, -(z * direction[1]) / size, (1.0 - z * z) / size
