"""Buildings as prisms: the little geometry that the cities need."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material


@dataclass(frozen=True, eq=False)
class Building:
    """A prism: footprint (k, 2) counter-clockwise [m], the inner corner of an L first; height [m]; ITU material."""

    footprint_m: np.ndarray
    height_m: float
    material: str


def corners_of(kind: str, length_m: float, width_m: float, rng: np.random.Generator) -> np.ndarray:
    """(k, 2) corners of a box, an ell (the inner corner first) or a pentagon around the origin, counter-clockwise [m]."""
    a, b = length_m / 2, width_m / 2
    if kind == "box":
        return np.array([(-a, -b), (a, -b), (a, b), (-a, b)])
    u, v = rng.uniform(-0.2, 0.4) * a, rng.uniform(-0.2, 0.4) * b
    if kind == "ell":
        return np.array([(u, v), (u, b), (-a, b), (-a, -b), (a, -b), (a, v)])
    return np.array([(-a, -b), (a, -b), (a, v), (u, b), (-a, b)])


def turned(points_m: np.ndarray, angle_rad: float) -> np.ndarray:
    """(n, 2) points turned counter-clockwise about the origin."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return points_m @ np.array([(c, s), (-s, c)])


def outline(corners_m: np.ndarray, step_m: float = 1.0) -> np.ndarray:
    """(n, 2) points along a closed polygon, at most `step_m` apart."""
    parts = []
    for start, end in zip(corners_m, np.roll(corners_m, -1, axis=0)):
        share = np.arange(0, 1, step_m / max(np.hypot(*(end - start)), step_m))
        parts.append(start + share[:, None] * (end - start))
    return np.concatenate(parts)


def inside(points_m: np.ndarray, corners_m: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 2) within a polygon (k, 2), by the parity of crossings of a ray to the east."""
    x, y = points_m[:, 0, None], points_m[:, 1, None]
    (x0, y0), (x1, y1) = corners_m.T, np.roll(corners_m, -1, axis=0).T
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return crosses.sum(axis=1) % 2 == 1


def distance_m(points_m: np.ndarray, corners_m: np.ndarray) -> np.ndarray:
    """(n,) distances of points (n, 2) from a polygon (k, 2) [m]; 0 within it."""
    start, side = corners_m, np.roll(corners_m, -1, axis=0) - corners_m
    away = points_m[:, None] - start
    share = np.clip((away * side).sum(-1) / (side**2).sum(-1), 0, 1)
    nearest = np.linalg.norm(away - share[..., None] * side, axis=-1).min(axis=1)
    return np.where(inside(points_m, corners_m), 0.0, nearest)


def fits(corners_m: np.ndarray, others_m: list[np.ndarray], room_m: float) -> bool:
    """Whether a polygon keeps `room_m` from all others."""
    points, centre = outline(corners_m), corners_m.mean(axis=0)
    for other in others_m:
        reach = np.linalg.norm(other - centre, axis=1).min()
        if reach > 80:  # larger than any building
            continue
        if distance_m(points, other).min() < room_m or inside(other, corners_m).any():
            return False
    return True


def prism(corners_m: np.ndarray, height_m: float) -> trimesh.Trimesh:
    """Walls and roof over a footprint that can be seen as a whole from its first corner; open below.

    There is no floor: it would lie in the plane of the ground, where a ray cannot tell the two.
    """
    k = len(corners_m)
    vertices = np.concatenate([np.column_stack([corners_m, np.full(k, z)]) for z in (0.0, height_m)])
    nxt = (np.arange(k) + 1) % k
    walls = [face for i, j in enumerate(nxt) for face in ((i, j, k + j), (i, k + j, k + i))]
    roof = [(k, k + i, k + i + 1) for i in range(1, k - 1)]
    return trimesh.Trimesh(vertices, np.array(walls + roof), process=False)


def write_prisms(folder: Path, side_m: float, margin_m: float, solids: Sequence[tuple[Building, Material]],
                 ground: Material) -> None:
    """Write a scene's `city.xml` and meshes: a square of ground with a margin around it, and buildings of materials."""
    low, high = -margin_m, side_m + margin_m
    plane = trimesh.Trimesh([[low, low, 0], [high, low, 0], [high, high, 0], [low, high, 0]],
                            [[0, 1, 2], [0, 2, 3]], process=False)
    write_city(folder, [CityShape("ground", plane, ground), *(
        CityShape(f"b{number:03d}", prism(one.footprint_m, one.height_m), material)
        for number, (one, material) in enumerate(solids))])


def blocked(buildings: Sequence[Building], a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    """(n,) whether a building stands between points (n, 3)."""
    solids = [prism(one.footprint_m, one.height_m) for one in buildings]
    offsets = np.cumsum([0] + [len(one.vertices) for one in solids])
    faces = np.concatenate([one.faces + offset for one, offset in zip(solids, offsets)])
    return ~CityMap(np.concatenate([one.vertices for one in solids]), faces).line_of_sight(a_m, b_m)


def blocked_alone(buildings: Sequence[Building], a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    """(buildings,) number of lines (n, 3) that each building alone blocks."""
    blocks = np.array([blocked([one], a_m, b_m) for one in buildings])
    return (blocks & (blocks.sum(axis=0) == 1)).sum(axis=1)
