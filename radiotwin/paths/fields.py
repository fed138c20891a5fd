"""What a path carries: the field of its ray, followed from turn to turn.

Polarisation is followed even where the result is averaged over it: a wave that is polarised along the walls is
reflected the stronger way by every one of them.
"""

import numpy as np
from numba import njit

from radiotwin.paths.coefficients import fresnel
from radiotwin.paths.vectors import cross, dot
from radiotwin.paths.wedges import diffract

VERTICAL, AVERAGE = 0, 1


@njit(cache=True, nogil=True, error_model="numpy")
def path_gains(surfaces, candidates, wave_number, permittivity, polarisation, buffer, rows, gain):
    """Power gains of paths between isotropic antennas.

    Args:
        surfaces, candidates: as the paths were found with.
        wave_number: 2 pi / wavelength [1/m].
        permittivity: complex relative permittivity of all surfaces.
        polarisation: VERTICAL for both antennas, or AVERAGE over those of the one, the other taking in all.
        buffer: the paths.
        rows: (m,) which of them.
        gain: (m,) output, linear.
    """
    field = np.empty(3, dtype=np.complex128)
    direction, length_m = np.empty((buffer.points_m.shape[1] - 1, 3)), np.empty(buffer.points_m.shape[1] - 1)
    for i in range(len(rows)):
        path = rows[i]
        legs = buffer.count[path] - 1
        for k in range(legs):
            direction[k] = buffer.points_m[path, k + 1] - buffer.points_m[path, k]
            length_m[k] = max(np.sqrt((direction[k] ** 2).sum()), 1e-9)
            direction[k] /= length_m[k]
        power = 0.0
        for sent in range(1 + polarisation):
            upright = _upright(direction[0])
            if sent == 1:
                upright = cross(direction[0], upright)
            for axis in range(3):
                field[axis] = upright[axis]
            spread = _follow(surfaces.planes, surfaces.edges, candidates, buffer.candidate[path], wave_number,
                             permittivity, direction, length_m, legs, field)
            if polarisation == VERTICAL:
                upright = _upright(direction[legs - 1])
                power += spread * abs(dot(field, upright)) ** 2
            else:
                power += 0.5 * spread * (abs(field[0]) ** 2 + abs(field[1]) ** 2 + abs(field[2]) ** 2)
        gain[i] = power / (2.0 * wave_number) ** 2


@njit(cache=True, error_model="numpy")
def _follow(planes, edges, candidates, row, wave_number, permittivity, direction, length_m, legs, field):
    """Change the field along one path; what its spreading leaves of the power [1/m²]."""
    before = 0
    while before < candidates.before.shape[1] and candidates.before[row, before] >= 0:
        before += 1
    edge = candidates.edge[row]
    for k in range(legs - 1):
        if k < before:
            _reflect(planes[candidates.before[row, k], :3], direction[k], direction[k + 1], permittivity, field)
        elif k > before:
            facet = candidates.behind[row, k - before - 1]
            _reflect(planes[facet, :3], direction[k], direction[k + 1], permittivity, field)
        else:
            diffract(edges, edge, direction[k], direction[k + 1], length_m[:before + 1].sum(),
                     length_m[before + 1:legs].sum(), wave_number, permittivity, field)
    if edge < 0:
        return 1.0 / length_m[:legs].sum() ** 2
    before_m, behind_m = length_m[:before + 1].sum(), length_m[before + 1:legs].sum()
    return 1.0 / (before_m * behind_m * (before_m + behind_m))


@njit(cache=True, error_model="numpy")
def _upright(direction):
    """The unit vector of vertical polarisation of a ray; north for a vertical ray."""
    flat2 = direction[0] ** 2 + direction[1] ** 2
    if flat2 < 1e-12:
        return np.array([0.0, 1.0, 0.0])
    return (np.array([0.0, 0.0, 1.0]) - direction[2] * direction) / np.sqrt(flat2)


@njit(cache=True, error_model="numpy")
def _reflect(normal, direction_in, direction, permittivity, field):
    """Turn the field of a ray on a facet."""
    sine = abs(dot(direction_in, normal))
    across = cross(direction_in, normal)
    size2 = dot(across, across)
    if size2 < 1e-12:  # straight on: any direction in the plane
        other = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
        across = cross(direction_in, other)
        size2 = dot(across, across)
    across /= np.sqrt(size2)
    within_in, within = cross(across, direction_in), cross(across, direction)
    te, tm = fresnel(sine, permittivity)
    field_te = te * dot(field, across)
    field_tm = tm * dot(field, within_in)
    for i in range(3):
        field[i] = field_te * across[i] + field_tm * within[i]
