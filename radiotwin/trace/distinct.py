"""Paths of a link that Sionna RT returns more than once.

Sionna RT 2.2.0 does so in two ways. Its repeatable search sends the rays twice, to count candidate
paths and to store them. Some rays take another way the second time (in RBM, in one call of two in
fifteen, single ones of 100,000, from their third interaction on), so that their candidates are
counted but never written. Such a blank candidate is a direct path to the first receiver of the
call. It appeared up to 400 times, 26 dB too much, and has no direction of departure. And where the
meshes of two buildings share an edge, each of them diffracts the same ray at the same point.
"""

import numpy as np

# Delays are single precision, with a unit roundoff of 6e-8, and sums of up to five segments.
_LENGTH_TOLERANCE = 1e-6  # relative
_SAME_POINT_M = 0.01  # as close as two surfaces must be to count as one


def distinct_paths(interactions: np.ndarray, vertices_m: np.ndarray, length_m: np.ndarray,
                   strength: np.ndarray, cos_turn: np.ndarray) -> np.ndarray:
    """Mark each path of each link once.

    Two paths are one if they have the same interactions in the same order at the same points, and
    the same length; of these the strongest is kept. Paths of one length over different points stay,
    as from two walls at equal distances. A link has one direct path.

    Args:
        interactions: (depth, n, k) types of interactions of k paths of n links, 0: none.
        vertices_m: (depth, n, k, 3) points of interaction [m].
        length_m: (n, k) length [m]; not positive where there is no path.
        strength: (n, k) magnitude of the field.
        cos_turn: (n, k) cosine of the angle between the directions of departure and of arrival,
            -1 for a straight line. A blank candidate has no direction of departure.

    Returns:
        (n, k) bool.
    """
    exists = length_m > 0
    used = interactions > 0
    direct = exists & ~used.any(axis=0)
    keep = exists & ~direct
    straightest = np.where(direct, cos_turn, np.inf).argmin(axis=1) if direct.any() else 0
    links = np.flatnonzero(direct.any(axis=1))
    keep[links, np.broadcast_to(straightest, len(direct))[links]] = True

    link, path = np.nonzero(exists & ~direct)
    types = np.ascontiguousarray(interactions[:, link, path].T)
    kind = np.unique(types, axis=0, return_inverse=True)[1].reshape(-1)
    length = length_m[link, path]
    order = np.lexsort((-strength[link, path], length, kind, link))
    link, path, kind, length = link[order], path[order], kind[order], length[order]
    point_m = np.where(used[..., None], vertices_m, 0.0)
    for shift in range(1, len(link)):
        near = ((link[shift:] == link[:-shift]) & (kind[shift:] == kind[:-shift])
                & (length[shift:] - length[:-shift] <= _LENGTH_TOLERANCE * length[shift:]))
        if not near.any():  # nor at a larger shift, as lengths rise within a link and kind
            break
        first = np.flatnonzero(near)
        second = first + shift
        apart_m = np.abs(point_m[:, link[first], path[first]]
                         - point_m[:, link[second], path[second]])
        same = apart_m.max(axis=(0, 2)) <= _SAME_POINT_M
        first, second = first[same], second[same]
        stronger = strength[link[first], path[first]] >= strength[link[second], path[second]]
        weaker = np.where(stronger, second, first)
        keep[link[weaker], path[weaker]] = False
    return keep
