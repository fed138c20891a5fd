"""Where no UAV may be: in areas that are forbidden, and near buildings."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.scene import Scene

STEP_M = 3.0  # between the points around a position at which buildings are looked for


def keep_out(scene: Scene, areas: Sequence[BaseGeometry], clearance_m: float) -> np.ndarray:
    """Return the positions (nz, ny, nx) of a scene's lattice at which no UAV may be.

    A move goes half a step beyond a position, so all of that is looked at.

    Args:
        scene: its lattice and its buildings.
        areas: no-fly areas in the local frame, at all heights.
        clearance_m: distance that UAVs keep from buildings, beside and below them [m].
    """
    lattice = scene.lattice
    blocked = scene.blocked.copy()
    half_m = lattice.step_m / 2
    if areas:
        x_m, y_m = np.meshgrid(lattice.x_m, lattice.y_m)
        cells = shapely.box(x_m - half_m, y_m - half_m, x_m + half_m, y_m + half_m)
        blocked |= shapely.intersects(shapely.union_all(list(areas)), cells)
    if clearance_m > 0:
        positions_m = lattice.positions_m
        near = np.zeros(len(positions_m), dtype=bool)
        for offset_m in _around(half_m, clearance_m):
            left = np.flatnonzero(~near)
            near[left] = scene.city.inside(positions_m[left] + offset_m)
        blocked |= near.reshape(lattice.shape)
    return blocked


def _around(half_m: float, clearance_m: float) -> np.ndarray:
    """Return offsets (n, 3) [m] to the points that a UAV comes within a clearance of."""
    reach = int(np.ceil((half_m + clearance_m) / STEP_M))
    axis_m = np.linspace(-half_m - clearance_m, half_m + clearance_m, 2 * reach + 1)
    x, y = (each.ravel() for each in np.meshgrid(axis_m, axis_m))
    along_x = np.hypot(np.maximum(np.abs(x) - half_m, 0.0), y)
    along_y = np.hypot(x, np.maximum(np.abs(y) - half_m, 0.0))
    near = np.minimum(along_x, along_y) <= clearance_m
    beside = np.column_stack([x[near], y[near], np.zeros(near.sum())])
    below = beside[np.minimum(along_x, along_y)[near] == 0] - [0.0, 0.0, clearance_m]
    return np.concatenate([beside, below])
