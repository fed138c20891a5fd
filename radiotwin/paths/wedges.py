"""Where a ray turns on an edge, and what becomes of its field there.

It turns where its angle to the edge stays the same (Keller's law), which is where it is straight once both sides are
folded into one plane around the edge.
"""

import numpy as np
from numba import njit

from radiotwin.paths.coefficients import wedge_coefficients
from radiotwin.paths.surfaces import ALONG, EXTERIOR, NORMAL_0, NORMAL_N
from radiotwin.paths.vectors import cross, dot

OPEN_SINE = 1e-4  # a ray this close along a face of a wedge is not followed


@njit(cache=True, error_model="numpy")
def around_edge(edges, edge, x, y, z):
    """A point as its edge sees it: (in the open space, metres along, metres across the edge)."""
    x, y, z = x - edges[edge, 0], y - edges[edge, 1], z - edges[edge, 2]
    along_m = x * edges[edge, ALONG] + y * edges[edge, ALONG + 1] + z * edges[edge, ALONG + 2]
    across_m = np.sqrt(max(x * x + y * y + z * z - along_m * along_m, 1e-12))
    least_m = OPEN_SINE * across_m
    is_open = x * edges[edge, NORMAL_0] + y * edges[edge, NORMAL_0 + 1] + z * edges[edge, NORMAL_0 + 2] > least_m \
        or x * edges[edge, NORMAL_N] + y * edges[edge, NORMAL_N + 1] + z * edges[edge, NORMAL_N + 2] > least_m
    return is_open, along_m, across_m


@njit(cache=True, error_model="numpy")
def diffract(edges, edge, direction_in, direction, before_m, behind_m, wave_number, permittivity, field):
    """Turn the field of a ray on an edge (Kouyoumjian and Pathak, eq. 9-13), all but its spreading.

    Args:
        direction_in, direction: (3,) unit vectors of the ray before and behind the edge.
        before_m, behind_m: lengths of the ray [m].
        field: (3,) complex, changed in place.
    """
    along, tangent, normal = edges[edge, 3:6], edges[edge, 7:10], edges[edge, 10:13]
    phi_in = np.arctan2(-dot(direction_in, normal), -dot(direction_in, tangent)) % (2.0 * np.pi)
    phi = np.arctan2(dot(direction, normal), dot(direction, tangent)) % (2.0 * np.pi)
    across_in, across = cross(along, direction_in), cross(along, direction)
    sine = np.sqrt(dot(across, across))
    distance_m = before_m * behind_m / (before_m + behind_m) * sine * sine
    soft, hard = wedge_coefficients(phi, phi_in, sine, distance_m, wave_number,
                                    edges[edge, EXTERIOR] / np.pi, permittivity)
    across_in = -across_in / np.sqrt(dot(across_in, across_in))
    across = across / sine
    upright_in, upright = cross(across_in, direction_in), cross(across, direction)
    field_soft, field_hard = -soft * dot(field, upright_in), -hard * dot(field, across_in)
    for i in range(3):
        field[i] = field_soft * upright[i] + field_hard * across[i]
