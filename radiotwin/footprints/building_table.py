"""The file `buildings.csv`: position, height and material of each building, and their sources."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from radiotwin.footprints.heights import height_sds_m
from radiotwin.footprints.solids import Prism


def building_table(prisms: Sequence[Prism], shape_of: Mapping[int, str],
                   on_terrain: bool = False) -> pd.DataFrame:
    """Return the table of buildings, with one row a prism.

    Args:
        prisms: of all buildings.
        shape_of: prism -> name of its shape in `city.xml`.
        on_terrain: whether the ground is not flat.

    Returns:
        Columns building, shape, x_m, y_m (a point inside), area_m2, on terrain ground_m (the lowest
        ground under the building), bottom_m and top_m (as ground_m above the datum), height_from,
        height_sd_m (see `height_sds_m`), unusable (tags that were skipped), material and
        material_from.
    """
    rows, heights_sd_m = [], height_sds_m(
        np.array([prism.height.top_m - prism.ground_m for prism in prisms]),
        np.array([prism.height.sd_m for prism in prisms]))
    for index, prism in enumerate(prisms):
        inside = prism.area.representative_point()
        rows.append({
            "building": prism.name, "shape": shape_of.get(index, ""),
            "x_m": round(inside.x, 2), "y_m": round(inside.y, 2),
            "area_m2": round(prism.area.area, 1),
            **({"ground_m": prism.ground_m} if on_terrain else {}),
            "bottom_m": round(prism.height.bottom_m, 3),
            "top_m": round(prism.height.top_m, 3), "height_from": prism.height.source,
            "height_sd_m": round(float(heights_sd_m[index]), 1),
            "unusable": "; ".join(prism.height.unusable), "material": prism.material.name,
            "material_from": prism.material_from})
    return pd.DataFrame(rows)


def height_counts(table: pd.DataFrame) -> dict[str, int]:
    """Count the buildings by the source of their height, once for each source of a building."""
    return dict(Counter(table.drop_duplicates(["building", "height_from"])["height_from"]))
