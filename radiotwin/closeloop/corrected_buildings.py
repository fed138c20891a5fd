"""`buildings.csv` of a corrected scene: without what is gone, with roofs as estimated."""

import numpy as np
import pandas as pd

from radiotwin.cells import as_numbers, read_cells
from radiotwin.effects.roof_heights import Roof
from radiotwin.inputs import require_within
from radiotwin.scene.scene import Scene

SOURCE = "close-loop"  # of an estimated height, in `height_from`
MIN_SD_M = 0.1


def stretch(roof: Roof, base_m: float) -> float:
    """Return how much taller a building that stands on `base_m` is than on the map, a ratio."""
    off_m = roof.true_offset_m
    return 1.0 + off_m / max(roof.height_m - base_m, abs(off_m))


def corrected_buildings(scene: Scene, shapes_of: dict[int, set[str]], left: set[str],
                        roofs: list[Roof], base_m: np.ndarray) -> pd.DataFrame | None:
    """Return the table of a scene's buildings as they are after the correction.

    Args:
        scene: before it.
        shapes_of: the shapes in `city.xml` of each building, as `buildings` numbers them.
        left: shapes that the corrected scene still has.
        roofs: whose heights are corrected.
        base_m: (buildings,) what each stands on, before it [m].

    Returns:
        all its columns as texts; None where the scene has no such table.

    Raises:
        BadInput: the table cannot be read, or lies outside the folder.
    """
    path = scene.folder / "buildings.csv"
    if not path.is_file():
        return None
    table = read_cells(require_within(scene.folder, path, str(scene.folder)))
    if "shape" not in table:
        return table
    table = table[table["shape"].isin(left)].reset_index(drop=True)
    if not {"top_m", "height_from", "height_sd_m"} <= set(table.columns):
        return table
    top_m = as_numbers(table["top_m"])
    for roof in roofs:
        own_m = float(base_m[roof.building])
        for row in np.flatnonzero(table["shape"].isin(shapes_of[roof.building])):
            raised_m = own_m + stretch(roof, own_m) * (top_m[row] - own_m)
            table.loc[row, ["top_m", "height_from", "height_sd_m"]] = [
                f"{raised_m:.3f}", SOURCE, f"{max(roof.offset_sd_m, MIN_SD_M):.1f}"]
    return table
