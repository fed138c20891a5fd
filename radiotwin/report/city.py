"""Prepare a city for the viewer: its triangles, or blocks where a browser could not draw them."""

import numpy as np

from radiotwin.report.packing import pack, pack_m
from radiotwin.scene import Scene
from radiotwin.scene.preview import height_grid
from radiotwin.scene.surfaces import FLAT_M

MAX_FACES = 80_000
BLOCK_CELLS = 160  # along the longer side of a city that is drawn as blocks


def city_mesh(scene: Scene) -> tuple[dict, str]:
    """Return the buildings of a scene for the viewer.

    Flat ground is left out. A city of more than `MAX_FACES` triangles is drawn as blocks, each as
    high as the highest surface in its cell.

    Args:
        scene: with its 3D map.

    Returns:
        packed coordinates and faces, and a note on what was simplified (empty for nothing)
    """
    city = scene.city
    keep = city.vertices[city.faces][:, :, 2].max(axis=1) > FLAT_M
    if keep.sum() <= MAX_FACES:
        used, index = np.unique(city.faces[keep], return_inverse=True)
        return _packed(city.vertices[used], index.reshape(-1, 3)), ""
    height_m, (x_min, x_max, y_min, y_max) = height_grid(scene, BLOCK_CELLS,
                                                              above_datum=True)
    cell_m = max(x_max - x_min, y_max - y_min) / BLOCK_CELLS
    return _packed(*blocks(height_m, x_min, y_min, cell_m)), (
        f"The city has {keep.sum():,} triangles and is drawn as blocks of {cell_m:.1f} m.")


def blocks(height_m: np.ndarray, x_m: float, y_m: float,
           cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Build roofs over the cells of a grid, and walls where neighbours differ in height.

    Args:
        height_m: (ny, nx) heights, south first [m]; cells up to `FLAT_M` stay open.
        x_m: west edge of the grid [m].
        y_m: south edge of the grid [m].
        cell_m: side of a cell [m].

    Returns:
        (v, 3) vertices [m], and (f, 3) faces
    """
    high_m = np.pad(np.where(height_m > FLAT_M, height_m, 0.0), 1)
    row, column = np.nonzero(high_m)
    west, south, top = x_m + (column - 1) * cell_m, y_m + (row - 1) * cell_m, high_m[row, column]
    east, north = west + cell_m, south + cell_m
    quads = [_quads(west, south, top, east, south, top, east, north, top, west, north, top)]
    for ny, nx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        low = high_m[row + ny, column + nx]
        wall = low < top
        x0, y0, foot, head = (values[wall] for values in (west, south, low, top))
        ax, ay = x0 + cell_m * (nx > 0), y0 + cell_m * (ny > 0)
        bx, by = ax + cell_m * (nx == 0), ay + cell_m * (ny == 0)
        quads.append(_quads(ax, ay, foot, bx, by, foot, bx, by, head, ax, ay, head))
    corners = np.concatenate(quads)
    first = 4 * np.arange(len(corners))[:, None]
    return corners.reshape(-1, 3), np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])


def _quads(*coordinates: np.ndarray) -> np.ndarray:
    """Stack twelve coordinates (n,) to corners (n, 4, 3)."""
    return np.stack(coordinates, axis=-1).reshape(-1, 4, 3)


def _packed(vertices_m: np.ndarray, faces: np.ndarray) -> dict:
    return {axis: pack_m(vertices_m[:, i]) for i, axis in enumerate("xyz")} | \
        {corner: pack(faces[:, i].astype(np.int32)) for i, corner in enumerate("ijk")}
