"""Complex gain of a path between vertically polarised antennas."""

import numpy as np
from numba import njit

from radiotwin.paths.coefficients import Slabs
from radiotwin.paths.fields import follow_field, send, take_legs, vertical
from radiotwin.paths.images import Candidates, PathBuffer
from radiotwin.paths.surfaces import Surfaces
from radiotwin.paths.vectors import dot


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
