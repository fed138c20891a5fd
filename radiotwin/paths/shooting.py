"""Sequences of facets that rays visit, found by shooting and bouncing rays.

A path of several reflections visits a sequence of facets. A city has too many sequences to try
them all, so rays are shot from the device in all directions and reflected where they hit; the
sequences that they visit are the candidates (Ling, Chou, Lee, "Shooting and bouncing rays", IEEE
Trans. Antennas Propag. 37(2), 1989). The paths themselves are then found by the image method,
exactly. Facets that face the device, and their edges, are candidates whether a ray hits or not.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd

from radiotwin.paths.edges import Edges
from radiotwin.paths.facets import Facets
from radiotwin.paths.topology import expand
from radiotwin.scene.citymap import SKIN_M, CityMap

RAY_CHUNK = 200_000  # rays at once: about 60 MB
DEVICE_RAYS = 100_000  # about half a degree apart
EDGE_RAYS = 300  # about 12 degrees apart


@dataclass(frozen=True, eq=False)
class FacetSequences:
    """Sequences of facets that rays from sources visit; the first row of each source is empty.

    Attributes:
        source: (c,) row of the source.
        facets: (c, depth) rows of `Surfaces`, then -1.
        order: (c,) number of facets.
        next_facets: (m, 2) a sequence, and a facet that rays hit after it.
    """

    source: np.ndarray
    facets: np.ndarray
    order: np.ndarray
    next_facets: np.ndarray


@lru_cache(maxsize=4)
def sphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors of a Fibonacci lattice (Gonzalez, Math. Geosci. 42, 2010)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    vectors = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    vectors.flags.writeable = False  # it is remembered
    return vectors


def device_sequences(
    city: CityMap, facets: Facets, normal: np.ndarray, device_m: np.ndarray, depth: int,
    rays: int = DEVICE_RAYS,
) -> FacetSequences:
    """Find the sequences of facets that rays from a device visit.

    Args:
        city: 3D map.
        facets: of the city.
        normal: (f + 1, 3) of `Surfaces`.
        device_m: (3,) position [m].
        depth: maximum number of facets of a sequence.
        rays: that are shot.

    Returns:
        The sequences of up to `depth` facets.
    """
    direction = sphere(rays)
    start_m = np.broadcast_to(device_m, direction.shape)
    return _shoot(city, facets, normal, start_m, direction, np.zeros(len(direction), dtype=int), 1,
                  depth)


def edge_sequences(
    city: CityMap, facets: Facets, normal: np.ndarray, edges: Edges, rows: np.ndarray, depth: int
) -> FacetSequences:
    """Find the sequences of facets that rays from edges visit.

    Rays start at most 20 m apart along an edge. The surroundings of an edge are seen from many
    starts, so fewer rays do than from a device.

    Args:
        city: 3D map.
        facets: of the city.
        normal: (f + 1, 3) of `Surfaces`.
        edges: of the city.
        rows: (n,) rows of `edges`: the sources.
        depth: maximum number of facets of a sequence.

    Returns:
        The sequences of up to `depth` facets.
    """
    offset_m = (edges.end_m - edges.start_m)[rows]
    starts = np.maximum(np.ceil(np.linalg.norm(offset_m, axis=1) / 20.0).astype(int), 1)
    source, within = expand(starts)
    outward = (edges.normal_0 + edges.normal_n)[rows]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    share = (within + 0.5) / starts[source]
    start_m = edges.start_m[rows[source]] + share[:, None] * offset_m[source] \
        + SKIN_M * outward[source]
    direction = sphere(EDGE_RAYS)
    is_open = np.maximum(edges.normal_0[rows] @ direction.T, edges.normal_n[rows] @ direction.T) > 0
    at, ray = np.nonzero(is_open[source])
    return _shoot(city, facets, normal, start_m[at], direction[ray], source[at], len(rows), depth)


def _shoot(
    city: CityMap, facets: Facets, normal: np.ndarray, start_m: np.ndarray, direction: np.ndarray,
    source: np.ndarray, sources: int, depth: int,
) -> FacetSequences:
    """Follow rays (n, 3) of sources (n,) through `depth` reflections, and to the facet after."""
    row = source  # of each ray: the sequence that it has visited
    sequences, of_source = [np.empty((sources, 0), dtype=int)], [np.arange(sources)]
    first = [0]
    seen = []
    count = sources
    for level in range(depth + 1):
        distance_m, facet = np.concatenate(
            [_first_facets(city, facets, start_m[a:a + RAY_CHUNK], direction[a:a + RAY_CHUNK])
             for a in range(0, len(start_m), RAY_CHUNK)] or [np.empty((2, 0))], axis=1)
        hit = np.flatnonzero(facet >= 0)
        row, facet = row[hit], facet[hit].astype(int)
        # Few are distinct: faster than `np.unique`, which sorts all.
        inverse, pairs = pd.factorize(row * len(normal) + facet, sort=True)
        parent, last = np.divmod(pairs, len(normal))
        seen.append(np.column_stack([parent, last]))
        if level == depth:
            break
        sequences.append(np.column_stack([sequences[-1][parent - first[-1]], last]))
        of_source.append(of_source[-1][parent - first[-1]])
        first.append(count)
        row = count + inverse
        count += len(pairs)
        direction, outward = direction[hit], normal[facet]
        start_m = start_m[hit] + distance_m[hit, None] * direction + SKIN_M * outward
        direction = direction - 2 * np.einsum("ij,ij->i", direction, outward)[:, None] * outward
    padded = [np.pad(part, ((0, 0), (0, depth - part.shape[1])), constant_values=-1)
              for part in sequences]
    order = np.repeat(np.arange(len(sequences)), [len(part) for part in sequences])
    return FacetSequences(np.concatenate(of_source), np.concatenate(padded), order,
                          np.concatenate(seen))


def _first_facets(
    city: CityMap, facets: Facets, start_m: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Return (2, n) distance [m] and facet that rays hit first; -1: none, or a face's back."""
    distance_m, face, cosine = city.first_hits_towards(start_m, direction)
    facet = np.where(face >= 0, facets.of_face[face], -1)
    facet[(face >= 0) & (cosine >= 0)] = -1
    if city.terrain is not None:
        return np.stack([distance_m, facet])
    # Flat ground is infinite here; the city's mesh of it may end, or there may be none
    with np.errstate(divide="ignore", invalid="ignore"):
        fall_m = np.where(direction[:, 2] < 0, -start_m[:, 2] / direction[:, 2], np.inf)
    on_ground = (fall_m > 0) & (fall_m < np.inf) & (distance_m > fall_m - 0.1)
    return np.stack([np.where(on_ground, np.maximum(fall_m, 0), distance_m),
                     np.where(on_ground, len(facets), facet)])
