"""`buildings.csv`: where every building stands, how tall it is, and how that is known."""

from collections import Counter
from collections.abc import Mapping, Sequence

import pandas as pd

from radiotwin.footprints.solids import Prism


def building_table(prisms: Sequence[Prism], shape_of: Mapping[int, str]) -> pd.DataFrame:
    """One row a prism: building, shape (in `city.xml`), x_m, y_m (a point inside), area_m2, bottom_m, top_m,
    height_from, unusable (tags passed over), material, material_from."""
    rows = []
    for index, prism in enumerate(prisms):
        inside = prism.area.representative_point()
        rows.append({
            "building": prism.name, "shape": shape_of.get(index, ""),
            "x_m": round(inside.x, 2), "y_m": round(inside.y, 2),
            "area_m2": round(prism.area.area, 1), "bottom_m": round(prism.height.bottom_m, 3),
            "top_m": round(prism.height.top_m, 3), "height_from": prism.height.provenance,
            "unusable": "; ".join(prism.height.unusable), "material": prism.material.name,
            "material_from": prism.material_from})
    return pd.DataFrame(rows)


def height_counts(table: pd.DataFrame) -> dict[str, int]:
    """How many buildings have their height from where; a building of several prisms counts once for each source."""
    return dict(Counter(table.drop_duplicates(["building", "height_from"])["height_from"]))
