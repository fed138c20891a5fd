"""Random cities of blocks between avenues and streets, with every building's height declared.

The parameters follow the maps of Chen et al., "Model-aided Federated Reinforcement Learning for
Multi-UAV Trajectory Planning in IoT Networks", GLOBECOM Workshops 2023. The cities are our own
draws.
"""

from dataclasses import dataclass

import numpy as np
import trimesh


@dataclass(frozen=True)
class CityParameters:
    """Parameters of a random city, lengths in metres.

    Attributes:
        width_m, depth_m: Size of the map along x and y.
        avenue_width_m: Width of an avenue.
        avenue_spacing_m: Side of the large block between two avenues.
        street_width_m: Width of the streets that cut large blocks into small ones.
        block_mean_m, block_min_m: Side of a small block: Poisson(mean), at least the minimum.
        side_min_m, side_mean_m: Side of a building: max(min, Exp(mean)), clipped to its block.
        mean_height_m: Mean height of buildings.
        first_block_m: South-west corner of the first large block; may lie off the map.
        min_height_m, max_height_m: Limits of the heights.
        side_kept_m: Least length of a clipped side; shorter ones are dropped with their building.
        buildings_per_m2: Density of buildings in a small block, before any is dropped.
        clearance_m: Free ground on each side of a device.
    """

    width_m: float
    depth_m: float
    avenue_width_m: float
    avenue_spacing_m: float
    street_width_m: float
    block_mean_m: float
    block_min_m: float
    side_min_m: float
    mean_height_m: float
    first_block_m: tuple[float, float]
    max_height_m: float = 50.0
    side_mean_m: float = 80.0
    side_kept_m: float = 30.0
    min_height_m: float = 5.0
    buildings_per_m2: float = 0.001
    clearance_m: float = 10.0


def draw_buildings(parameters: CityParameters, keep_free_m: np.ndarray, seed: int) -> np.ndarray:
    """Draw the buildings of a city as axis-aligned boxes, which may overlap.

    Args:
        parameters: Parameters of the city.
        keep_free_m: (k, 2) points to keep clear of buildings by `clearance_m` [m].
        seed: Seed of the draw.

    Returns:
        (n, 5) x_min, y_min, x_max, y_max, height [m].
    """
    rng = np.random.default_rng(seed)
    boxes = []
    period_m = parameters.avenue_spacing_m + parameters.avenue_width_m
    for x0 in np.arange(parameters.first_block_m[0], parameters.width_m, period_m):
        for y0 in np.arange(parameters.first_block_m[1], parameters.depth_m, period_m):
            columns = _small_blocks(x0, parameters.width_m, parameters, rng)
            for row in _small_blocks(y0, parameters.depth_m, parameters, rng):
                for column in columns:
                    boxes += _buildings_in(column, row, parameters, keep_free_m, rng)
    return np.array(boxes).reshape(-1, 5)


def _small_blocks(low: float, length_m: float, p: CityParameters, rng: np.random.Generator
                  ) -> list[tuple[float, float]]:
    """Cut one side of the large block at `low` by streets, and clip the pieces to the map.

    The rest after the last street is a block of at least the minimum.
    """
    blocks, high = [], low + p.avenue_spacing_m
    while high - low >= 2 * p.block_min_m + p.street_width_m:
        side = max(rng.poisson(p.block_mean_m), p.block_min_m)
        side = min(side, high - low - p.street_width_m - p.block_min_m)
        blocks.append((low, low + side))
        low += side + p.street_width_m
    clipped = [(max(a, 0.0), min(b, length_m)) for a, b in [*blocks, (low, high)]]
    return [(a, b) for a, b in clipped if b - a >= p.side_kept_m]


def _buildings_in(column: tuple[float, float], row: tuple[float, float], p: CityParameters,
                  keep_free_m: np.ndarray, rng: np.random.Generator) -> list[tuple]:
    (x0, x1), (y0, y1) = column, row
    boxes = []
    for _ in range(rng.poisson((x1 - x0) * (y1 - y0) * p.buildings_per_m2)):
        centre = rng.uniform((x0, y0), (x1, y1))
        sides = np.maximum(p.side_min_m, rng.exponential(p.side_mean_m, 2))
        height = min(rng.exponential(p.mean_height_m),
                     abs(rng.normal()) * 3 * np.sqrt(p.max_height_m - p.mean_height_m)
                     + p.mean_height_m)
        low = np.maximum(centre - sides / 2, (x0, y0))
        high = np.minimum(centre + sides / 2, (x1, y1))
        low, high = _trimmed(low, high, keep_free_m, p.clearance_m)
        if np.all(high - low >= p.side_kept_m):
            boxes.append((*low.round(2), *high.round(2),
                          round(float(np.clip(height, p.min_height_m, p.max_height_m)), 2)))
    return boxes


def _trimmed(low: np.ndarray, high: np.ndarray, keep_free_m: np.ndarray, clearance_m: float
             ) -> tuple[np.ndarray, np.ndarray]:
    """Free every point from a rectangle by moving the side that costs the least area."""
    for point in keep_free_m:
        near, far = point - clearance_m, point + clearance_m
        if np.any(far <= low) or np.any(near >= high):
            continue
        choices = []
        for axis in (0, 1):
            for side, value in ((high, near[axis]), (low, far[axis])):
                trimmed = side.copy()
                trimmed[axis] = value
                choices.append((trimmed, high) if side is low else (low, trimmed))
        low, high = max(choices, key=lambda c: np.prod(np.maximum(c[1] - c[0], 0.0)))
    return low, high


def building_meshes(boxes: np.ndarray) -> list[trimesh.Trimesh]:
    """Return boxes as watertight solids, one per group of boxes that touch.

    Overlapping boxes are united, as the ray tracer would hit coplanar walls and roofs inside one
    another twice.

    Args:
        boxes: (n, 5) x_min, y_min, x_max, y_max, height [m].

    Returns:
        Meshes with outward normals, from west to east.
    """
    solids = [trimesh.creation.box(bounds=[[x0, y0, 0.0], [x1, y1, height]])
              for x0, y0, x1, y1, height in boxes]
    union = trimesh.boolean.union(solids, engine="manifold")
    return sorted(union.split(), key=lambda mesh: tuple(mesh.bounds[0]))
