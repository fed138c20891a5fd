"""Airspace closed to UAVs: no-fly areas, and the surroundings of buildings."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt, minimum_filter1d
from shapely.geometry.base import BaseGeometry

from radiotwin.scene import Scene

LAYERS = 4  # horizontal sections within the clearance below an altitude
LOWEST_M = 0.5  # lowest section above ground, so that terrain is no building [m]
STEP_M = 3.0  # approximate spacing of the points that are tested for buildings [m]


def keep_out(scene: Scene, areas: Sequence[BaseGeometry], clearance_m: float) -> np.ndarray:
    """Return the mask (nz, ny, nx) of lattice positions that are closed to UAVs.

    Closed are positions whose cell touches one of the no-fly `areas` (in the local frame, at all
    heights), and those from which half a move to a neighbour comes within `clearance_m` [m] of a
    building, sideways or above it. The insides of buildings are added by the mission.
    """
    lattice = scene.lattice
    blocked = np.zeros(lattice.shape, dtype=bool)  # a mission adds the insides of buildings
    half_m = lattice.step_m / 2
    if areas:
        x_m, y_m = np.meshgrid(lattice.x_m, lattice.y_m)
        cells = shapely.box(x_m - half_m, y_m - half_m, x_m + half_m, y_m + half_m)
        blocked |= shapely.intersects(shapely.union_all(list(areas)), cells)
    if clearance_m > 0:
        blocked |= _near_buildings(scene, clearance_m)
    return blocked


def _near_buildings(scene: Scene, clearance_m: float) -> np.ndarray:
    """Return the mask (nz, ny, nx) of lattice positions where moves are too close to buildings.

    Horizontal sections of the city, at each altitude and below it, are tested on a finer grid.
    """
    lattice = scene.lattice
    parts = max(2 * round(lattice.step_m / (2 * STEP_M)), 2)  # of a step; even, for its middle
    step_m = lattice.step_m / parts
    margin = int(np.ceil(clearance_m / step_m)) + parts // 2
    x_m, y_m = (axis[0] + step_m * np.arange(-margin, (len(axis) - 1) * parts + margin + 1)
                for axis in (lattice.x_m, lattice.y_m))
    grid_x_m, grid_y_m = (each.ravel() for each in np.meshgrid(x_m, y_m))
    ground_m: np.ndarray | float = 0.0
    if lattice.ground_m is not None:
        ground_m = np.asarray(scene.city.ground_height_m(grid_x_m, grid_y_m))
    near = np.zeros(lattice.shape, dtype=bool)
    below_m = clearance_m * np.arange(LAYERS + 1) / LAYERS
    # Each section uses the reach of the section above it, so that nothing in between is missed.
    beside_m = np.sqrt(clearance_m**2 - np.append(0.0, below_m[:-1])**2)
    lattice_points = slice(margin, -margin, parts)
    for level, altitude_m in enumerate(lattice.z_m):
        for down_m, reach_m in zip(below_m, beside_m, strict=True):
            height_m = max(altitude_m - down_m, LOWEST_M)
            inside = scene.city.inside(np.column_stack([
                grid_x_m, grid_y_m, np.broadcast_to(ground_m + height_m, grid_x_m.shape)])
                ).reshape(len(y_m), len(x_m))
            if inside.any():
                away_m = distance_transform_edt(~inside, step_m)
                along_moves_m = np.minimum(minimum_filter1d(away_m, parts + 1, axis=0),
                                           minimum_filter1d(away_m, parts + 1, axis=1))
                near[level] |= along_moves_m[lattice_points, lattice_points] <= reach_m
    return near
