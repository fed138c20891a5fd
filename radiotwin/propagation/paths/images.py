"""Image method: paths over given facets and at most one edge, and the test for obstacles.

The device is mirrored in the facets before the edge one after another, the receiver in the facets
after it; the ray is reflected where the straight line between the images crosses a facet [1].
`find_paths` does not test for obstacles, `found_clear` does.

[1] Balanis, "Advanced Engineering Electromagnetics", 2nd ed., 2012: ch. 5.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from radiotwin.propagation.paths.interactions import around_edge
from radiotwin.propagation.paths.pruning import (
    GROUP,
    lit_part,
    narrow,
    open_window,
    over_edge,
    spheres_around,
    through_facet,
)
from radiotwin.propagation.paths.surfaces import (
    ALONG,
    LENGTH,
    NORMAL,
    NORMAL_0,
    NORMAL_N,
    ON_PLANE_M,
    START,
    Surfaces,
    height,
    mirrored,
    within,
)
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import SKIN_M, CityMap

MAX_INTERACTIONS = 6  # reflections and diffractions of a path: size of the arrays


class Candidates(NamedTuple):
    """Sequences of interactions to try between one device and any receiver.

    Attributes:
        before: (c, a) facets before the edge, or all facets if there is no edge; then -1.
        edge: (c,) row of the edge; -1: none.
        after: (c, b) facets after the edge; then -1.
    """

    before: np.ndarray
    edge: np.ndarray
    after: np.ndarray


class PathBuffer(NamedTuple):
    """Arrays that hold paths found between one device and receivers.

    Attributes:
        receiver: (capacity,) row of the receiver.
        candidate: (capacity,) row of the candidate.
        points_m: (capacity, MAX_INTERACTIONS + 2, 3) device, points of interaction, receiver [m].
        count: (capacity,) number of points in use.
    """

    receiver: np.ndarray
    candidate: np.ndarray
    points_m: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides an unused method of tuples

    @classmethod
    def allocate(cls, capacity: int) -> "PathBuffer":
        """Return an empty buffer for `capacity` paths."""
        receiver, candidate, count = np.empty((3, capacity), dtype=np.int64)
        return cls(receiver, candidate, np.zeros((capacity, MAX_INTERACTIONS + 2, 3)), count)

    def end_legs_m(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first legs (m, 3) from the device, and the last ones from the receiver [m]."""
        points_m, last, path = self.points_m[rows], self.count[rows] - 1, np.arange(len(rows))
        return (points_m[:, 1] - points_m[:, 0],
                points_m[path, last - 1] - points_m[path, last])


def unit_vectors(leg_m: np.ndarray) -> np.ndarray:
    """Return the unit vectors (n, 3) of legs (n, 3) [m]; 0 for a leg without length."""
    return leg_m / np.maximum(np.linalg.norm(leg_m, axis=1, keepdims=True), 1e-9)


@njit(cache=True, error_model="numpy")
def sequence_length(facets: np.ndarray, row: int) -> int:
    """Return the number of facets in a row of `Candidates.before` or `after` (-1: none)."""
    length = 0
    while length < facets.shape[1] and facets[row, length] >= 0:
        length += 1
    return length


@njit(cache=True, nogil=True, error_model="numpy")
def find_paths(surfaces: Surfaces, candidates: Candidates, device_m: np.ndarray,
               receiver_m: np.ndarray, cursor: int, buffer: PathBuffer) -> tuple[int, int]:
    """Find paths for all candidates and receivers (n, 3) [m] in order, until the buffer is full.

    Begins at `cursor`, candidate · n + receiver, and fills the buffer from its first row on.
    Returns the number of paths, not yet tested for obstacles, and the cursor to continue at.
    """
    planes, uv_m, edges = surfaces.planes, surfaces.triangle_uv_m, surfaces.edges
    n = len(receiver_m)
    image, mirror = np.empty((MAX_INTERACTIONS + 1, 3)), np.empty((MAX_INTERACTIONS + 1, 3))
    possible, spheres = np.empty(n, dtype=np.int64), spheres_around(receiver_m)
    lit_m, source_m = np.empty(2), np.empty(2)
    # Row k: window after the first k facets behind the edge
    windows = np.empty((MAX_INTERACTIONS + 1, 4))
    frame = np.empty((3, 4))
    found = narrowed = 0
    is_lit, computed = False, -1  # candidate of `image` and `windows`; -1: none
    for row in range(cursor // n, len(candidates.edge)):
        before = sequence_length(candidates.before, row)
        after = sequence_length(candidates.after, row)
        facets_before, facets_after = candidates.before[row, :before], candidates.after[row, :after]
        edge = candidates.edge[row]
        count = 0
        if edge < 0:
            computed = -1
            if not source_images(planes, facets_before, device_m, image):
                continue
            count = through_facet(planes, facets_before[-1], image[before], receiver_m, spheres,
                                  possible)
        else:
            # Images and windows of the candidate before hold as far as both share facets
            if computed >= 0 and _same_start(candidates, computed, row):
                narrowed = min(narrowed, _same_facets(candidates.after, computed, row))
            else:
                narrowed = 0
                is_lit = source_images(planes, facets_before, device_m, image)
                if is_lit:
                    is_lit, source_m[0], source_m[1] = around_edge(
                        edges, edge, image[before, 0], image[before, 1], image[before, 2])
                if is_lit:
                    lit_m[0], lit_m[1] = lit_part(planes, edges, edge, facets_before, image)
                    open_window(edges, edge, lit_m, windows[0])
                    is_lit = lit_m[0] < lit_m[1]
            computed = row
            is_open = is_lit
            while is_open and narrowed < after:
                windows[narrowed + 1] = windows[narrowed]
                is_open = narrow(planes, edges, edge, facets_after, narrowed, source_m,
                                 windows[narrowed + 1])
                narrowed += is_open
            if is_open:
                count = over_edge(planes, edges, edge, facets_after, windows[after], source_m,
                                  receiver_m, spheres, frame, possible)
        along_m, across_m = source_m
        for i in range(count):  # of bounding shapes; check triangles and find the points
            receiver = possible[i]
            if row * n + receiver < cursor:
                continue
            if found == len(buffer.count):
                return found, row * n + receiver
            x, y, z = receiver_m[receiver, 0], receiver_m[receiver, 1], receiver_m[receiver, 2]
            points_m = buffer.points_m[found]
            interactions = before
            if edge >= 0:
                ok, x, y, z = _from_edge(planes, uv_m, edges, edge, facets_after, before + 1,
                                         along_m, across_m, x, y, z, mirror, points_m)
                if not ok:
                    continue
                interactions += after + 1
            if not reflections_back(planes, uv_m, facets_before, x, y, z, image, points_m):
                continue
            points_m[0] = device_m
            points_m[interactions + 1] = receiver_m[receiver]
            buffer.receiver[found], buffer.candidate[found] = receiver, row
            buffer.count[found] = interactions + 2
            found += 1
    return found, n * len(candidates.edge)


@njit(cache=True, error_model="numpy")
def _same_start(candidates: Candidates, row: int, other: int) -> bool:
    """Return True if two candidates have the same edge and the same facets before the edge."""
    same = candidates.edge[row] == candidates.edge[other]
    for k in range(candidates.before.shape[1]):
        same = same and candidates.before[row, k] == candidates.before[other, k]
    return same


@njit(cache=True, error_model="numpy")
def _same_facets(facets: np.ndarray, row: int, other: int) -> int:
    """Return the number of leading facets that two rows of `Candidates.after` share."""
    k = 0
    while k < facets.shape[1] and facets[row, k] >= 0 and facets[row, k] == facets[other, k]:
        k += 1
    return k


@njit(cache=True, error_model="numpy")
def source_images(planes: np.ndarray, facets: np.ndarray, device_m: np.ndarray, image: np.ndarray
                  ) -> bool:
    """Mirror the device in facets in turn; return False if an image is behind the next facet.

    Writes the device and its images into `image` (n + 1, 3) [m].
    """
    image[0] = device_m
    for k in range(len(facets)):
        x, y, z = image[k, 0], image[k, 1], image[k, 2]
        if height(planes, facets[k], x, y, z) < ON_PLANE_M:
            return False
        image[k + 1, 0], image[k + 1, 1], image[k + 1, 2] = mirrored(planes, facets[k], x, y, z)
    return True


@njit(cache=True, error_model="numpy")
def reflections_back(planes: np.ndarray, uv_m: np.ndarray, facets: np.ndarray, x: float, y: float,
                     z: float, image: np.ndarray, points_m: np.ndarray) -> bool:
    """Find the reflection points of a path from x, y, z (receiver or edge) back to the device [m].

    Writes them into `points_m[1:]`; returns False if there is no such path.
    """
    for k in range(len(facets) - 1, -1, -1):
        ok, x, y, z = _meet(planes, uv_m, facets[k], x, y, z,
                            image[k + 1, 0], image[k + 1, 1], image[k + 1, 2])
        if not ok:
            return False
        points_m[k + 1, 0], points_m[k + 1, 1], points_m[k + 1, 2] = x, y, z
    return True


@njit(cache=True, error_model="numpy")
def _from_edge(planes: np.ndarray, uv_m: np.ndarray, edges: np.ndarray, edge: int,
               facets: np.ndarray, first: int, along_m: float, across_m: float, x: float, y: float,
               z: float, mirror: np.ndarray, points_m: np.ndarray
               ) -> tuple[bool, float, float, float]:
    """Find the points of a path from its diffraction at an edge to the receiver x, y, z [m].

    Writes them into `points_m[first:]`, and overwrites `mirror`. `along_m` and `across_m` are those
    of the device's image. Returns False if there is no such path, and the point on the edge [m].
    """
    for k in range(len(facets) - 1, -1, -1):  # mirror[k]: receiver mirrored in facets[k:]
        if height(planes, facets[k], x, y, z) < ON_PLANE_M:
            return False, x, y, z
        x, y, z = mirrored(planes, facets[k], x, y, z)
        mirror[k, 0], mirror[k, 1], mirror[k, 2] = x, y, z
    is_open, to_along_m, to_across_m = around_edge(edges, edge, x, y, z)
    at_m = along_m + (to_along_m - along_m) * across_m / (across_m + to_across_m)
    if not is_open or at_m < 0.0 or at_m > edges[edge, LENGTH]:
        return False, x, y, z
    edge_x = edges[edge, START] + at_m * edges[edge, ALONG]
    edge_y = edges[edge, START + 1] + at_m * edges[edge, ALONG + 1]
    edge_z = edges[edge, START + 2] + at_m * edges[edge, ALONG + 2]
    points_m[first, 0], points_m[first, 1], points_m[first, 2] = edge_x, edge_y, edge_z
    x, y, z = edge_x, edge_y, edge_z
    for k in range(len(facets)):
        ok, x, y, z = _meet(planes, uv_m, facets[k], x, y, z,
                            mirror[k, 0], mirror[k, 1], mirror[k, 2])
        if not ok:
            return False, x, y, z
        place = first + 1 + k
        points_m[place, 0], points_m[place, 1], points_m[place, 2] = x, y, z
    return True, edge_x, edge_y, edge_z


@njit(cache=True, error_model="numpy")
def _meet(planes: np.ndarray, uv_m: np.ndarray, facet: int, x: float, y: float, z: float,
          image_x: float, image_y: float, image_z: float) -> tuple[bool, float, float, float]:
    """Return where the line from a point to an image [m] crosses a facet; False if it misses."""
    before_m = height(planes, facet, x, y, z)
    behind_m = -height(planes, facet, image_x, image_y, image_z)
    if before_m < ON_PLANE_M or behind_m < ON_PLANE_M:
        return False, x, y, z
    share = before_m / (before_m + behind_m)
    x = x + share * (image_x - x)
    y = y + share * (image_y - y)
    z = z + share * (image_z - z)
    return within(planes, uv_m, facet, x, y, z), x, y, z


def found_clear(city: CityMap, surfaces: Surfaces, candidates: Candidates, device_m: np.ndarray,
                receiver_m: np.ndarray, buffer: PathBuffer) -> Iterator[np.ndarray]:
    """Find the unblocked paths from a device (3,) to receivers (n, 3) [m], one buffer at a time.

    Yields:
        (m,) rows of the buffer with unblocked paths, ascending; the next step overwrites them.
    """
    order = _neighbours_together(receiver_m)
    sorted_m = np.ascontiguousarray(receiver_m[order])
    cursor = 0
    while cursor < len(candidates.edge) * len(receiver_m):
        found, cursor = find_paths(surfaces, candidates, device_m, sorted_m, cursor, buffer)
        buffer.receiver[:found] = order[buffer.receiver[:found]]
        yield clear_paths(city, surfaces, candidates, buffer, found)


def _neighbours_together(points_m: np.ndarray) -> np.ndarray:
    """Sort points (n, 3) [m] so that `GROUP` consecutive ones are neighbours; return rows (n,)."""
    order = np.arange(len(points_m))
    parts = [(0, len(points_m))]
    while parts:
        first, end = parts.pop()
        if end - first <= GROUP:
            continue
        rows = order[first:end]
        axis = np.ptp(points_m[rows], axis=0).argmax()
        half = GROUP * (-(-(end - first) // GROUP) // 2)
        order[first:end] = rows[np.argpartition(points_m[rows, axis], half)]
        parts += [(first, first + half), (first + half, end)]
    return order


def clear_paths(city: CityMap, surfaces: Surfaces, candidates: Candidates, buffer: PathBuffer,
                found: int) -> np.ndarray:
    """Test the first `found` paths in a buffer for obstacles; return the unblocked rows (m,).

    Points of interaction are moved off their surface by `SKIN_M`, so that no surface blocks the
    path that it reflects or diffracts.
    """
    legs = buffer.count[:found] - 1
    points_m = np.empty((int(legs.max(initial=0)) + 1, found, 3))
    _move_off_surfaces(surfaces, candidates, buffer, SKIN_M, points_m)
    # Last legs first: these are blocked most often, since rays were shot along the first ones.
    rows = np.arange(found)
    for leg in range(len(points_m) - 1):
        used = np.flatnonzero(legs[rows] > leg)
        tested = rows[used]
        end = legs[tested] - leg
        clear = np.ones(len(rows), dtype=bool)
        clear[used] = city.line_of_sight(points_m[end - 1, tested], points_m[end, tested])
        rows = rows[clear]
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _move_off_surfaces(surfaces: Surfaces, candidates: Candidates, buffer: PathBuffer,
                       skin_m: float, points_m: np.ndarray) -> None:
    """Write the points of paths (k, paths, 3) [m], interactions moved off surfaces by `skin_m`."""
    planes, edges = surfaces.planes, surfaces.edges
    for path in range(points_m.shape[1]):
        row, last = buffer.candidate[path], buffer.count[path] - 1
        before = sequence_length(candidates.before, row)
        for k in range(last + 1):
            x = y = z = 0.0
            if k == 0 or k == last:
                pass
            elif k == before + 1:
                edge = candidates.edge[row]
                x = edges[edge, NORMAL_0] + edges[edge, NORMAL_N]
                y = edges[edge, NORMAL_0 + 1] + edges[edge, NORMAL_N + 1]
                z = edges[edge, NORMAL_0 + 2] + edges[edge, NORMAL_N + 2]
                norm = np.sqrt(x * x + y * y + z * z)
                x, y, z = x / norm, y / norm, z / norm
            else:
                facet = candidates.before[row, k - 1] if k <= before \
                    else candidates.after[row, k - before - 2]
                x, y, z = planes[facet, NORMAL], planes[facet, NORMAL + 1], \
                    planes[facet, NORMAL + 2]
            points_m[k, path, 0] = buffer.points_m[path, k, 0] + skin_m * x
            points_m[k, path, 1] = buffer.points_m[path, k, 1] + skin_m * y
            points_m[k, path, 2] = buffer.points_m[path, k, 2] + skin_m * z
