"""Which surfaces can start or go on a path: found by shooting rays, as many as it takes to see what matters.

A path of several turns visits a sequence of facets. All sequences of a city are too many to try, so rays are shot
from the device in all directions and mirrored where they hit; the sequences that they go through are the candidates
(Glassner, "An Introduction to Ray Tracing", 1989; shooting and bouncing rays: Ling et al., IEEE TAP 37(2), 1989).
The paths themselves are then found by the image method, exactly. What the device sees directly is not left to
chance: each facet that it stands before, and each edge of those, is a candidate.
"""

from dataclasses import dataclass

import numpy as np

from radiotwin.paths.edges import Edges
from radiotwin.paths.facets import Facets
from radiotwin.scene.citymap import SKIN_M, CityMap

FAR_M = 1e5
BLOCK = 200_000  # rays at once: about 60 MB


@dataclass(frozen=True, eq=False)
class Chains:
    """Sequences of facets, each the one of a parent and one facet more; row 0 is the empty sequence.

    Attributes:
        facets: (c, depth) rows of `Surfaces`, -1 behind the last one.
        order: (c,) number of facets.
        next_facets: chain and facet that rays hit behind it: (m, 2).
    """

    facets: np.ndarray
    order: np.ndarray
    next_facets: np.ndarray


def sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly: a Fibonacci lattice (Gonzalez, Math. Geosci. 42, 2010)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def first_facets(city: CityMap, facets: Facets, origin_m: np.ndarray, direction: np.ndarray):
    """What rays meet first: distance [m] and facet (row of `Surfaces`; -1: nothing, or a face from behind)."""
    ground = len(facets)
    distance_m, face, cosine = city.first_hits(origin_m, origin_m + FAR_M * direction)
    facet = np.where(face >= 0, facets.of_face[face], -1)
    facet[(face >= 0) & (cosine >= 0)] = -1
    # The ground has no end, though the city's mesh of it may have, or there may be none.
    with np.errstate(divide="ignore", invalid="ignore"):
        fall_m = np.where(direction[:, 2] < 0, -origin_m[:, 2] / direction[:, 2], np.inf)
    meets = (fall_m > 0) & (fall_m < np.inf) & (distance_m > fall_m - 0.1)
    return np.where(meets, np.maximum(fall_m, 0), distance_m), np.where(meets, ground, facet)


def shoot(city: CityMap, facets: Facets, normal: np.ndarray, origin_m: np.ndarray, direction: np.ndarray,
          depth: int) -> Chains:
    """Follow rays from points through `depth` mirrors, and to the facet behind the last.

    Args:
        city: the map.
        facets: of the city.
        normal: (f + 1, 3) of `Surfaces`.
        origin_m, direction: (n, 3) starts [m] and unit vectors; the starts belong to one source.
        depth: of the sequences.
    """
    row = np.zeros(len(origin_m), dtype=int)  # of each ray: the chain it has gone through
    chain = [np.empty((1, 0), dtype=int)]
    first = [0]
    seen = []
    count = 1
    for level in range(depth + 1):
        distance_m, facet = np.concatenate(
            [np.stack(first_facets(city, facets, origin_m[a:a + BLOCK], direction[a:a + BLOCK]))
             for a in range(0, len(origin_m), BLOCK)] or [np.empty((2, 0))], axis=1)
        hit = np.flatnonzero(facet >= 0)
        row, facet = row[hit], facet[hit].astype(int)
        pairs, inverse = np.unique(row * len(normal) + facet, return_inverse=True)
        parent, last = np.divmod(pairs, len(normal))
        seen.append(np.column_stack([parent, last]))
        if level == depth:
            break
        chain.append(np.column_stack([chain[-1][parent - first[-1]], last]))
        first.append(count)
        row = count + inverse.reshape(-1)
        count += len(pairs)
        at_m = origin_m[hit] + distance_m[hit, None] * direction[hit] + SKIN_M * normal[facet]
        turn = np.einsum("ij,ij->i", direction[hit], normal[facet])
        origin_m, direction = at_m, direction[hit] - 2 * turn[:, None] * normal[facet]
    padded = [np.pad(part, ((0, 0), (0, depth - part.shape[1])), constant_values=-1) for part in chain]
    order = np.repeat(np.arange(len(chain)), [len(part) for part in chain])
    return Chains(np.concatenate(padded), order, np.concatenate(seen))


def device_chains(city: CityMap, facets: Facets, normal: np.ndarray, device_m: np.ndarray, depth: int,
                  rays: int) -> Chains:
    """Sequences of facets that rays from a device go through.

    Args:
        city, facets, normal: as in `shoot`.
        device_m: (3,) [m]
        depth: most facets of a sequence.
        rays: how many.
    """
    direction = sphere(rays)
    return shoot(city, facets, normal, np.broadcast_to(device_m, direction.shape), direction, depth)


def edge_views(city: CityMap, facets: Facets, edges: Edges, edge: int, rays: int, step_m: float,
               normal: np.ndarray, depth: int) -> Chains:
    """Sequences of facets that rays from an edge go through.

    Rays start every `step_m` along the edge, pulled off it into the open space.
    """
    length_m = np.linalg.norm(edges.end_m[edge] - edges.start_m[edge])
    count = max(int(np.ceil(length_m / step_m)), 1)
    outward = edges.normal_0[edge] + edges.normal_n[edge]
    at_m = edges.start_m[edge] + ((np.arange(count) + 0.5) / count * length_m)[:, None] * edges.direction[edge] \
        + SKIN_M * outward / np.linalg.norm(outward)
    direction = sphere(rays)
    open_to = np.maximum(direction @ edges.normal_0[edge], direction @ edges.normal_n[edge]) > 0
    direction = direction[open_to]
    return shoot(city, facets, normal, np.repeat(at_m, len(direction), axis=0), np.tile(direction, (count, 1)), depth)
