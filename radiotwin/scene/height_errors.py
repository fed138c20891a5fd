"""How well a scene made from a map knows the heights of its buildings: from `buildings.csv`."""

from pathlib import Path

import pandas as pd

from radiotwin.cells import as_numbers, read_cells, refuse
from radiotwin.inputs import require_within

_MAX_SD_M, _MAX_AREA_M2 = 1000.0, 1e9


def shape_height_sds_m(folder: Path) -> dict[str, float] | None:
    """Return the standard deviation of the height of each shape [m], as `buildings.csv` has it.

    A shape is a block of buildings that touch: it has their mean, by area.

    Args:
        folder: of a scene.

    Returns:
        shape -> standard deviation; None: the folder has no such table, or one of an earlier
        version, without the column `height_sd_m`.

    Raises:
        BadInput: the table cannot be read, lies outside the folder, or has an impossible value.
    """
    path = folder / "buildings.csv"
    if not path.is_file():
        return None
    require_within(folder, path, str(folder))
    table = read_cells(path, optional=("shape", "area_m2", "height_sd_m"))
    if not {"shape", "area_m2", "height_sd_m"} <= set(table.columns):
        return None
    numbers = {name: as_numbers(table[name]) for name in ("area_m2", "height_sd_m")}
    for name, most in (("area_m2", _MAX_AREA_M2), ("height_sd_m", _MAX_SD_M)):
        refuse(path, name, table[name], ~((numbers[name] > 0) & (numbers[name] <= most)),
               f"is impossible; allowed are numbers above 0, up to {most:g}")
    areas_m2 = pd.Series(numbers["area_m2"]).groupby(table["shape"]).sum()
    sums = pd.Series(numbers["area_m2"] * numbers["height_sd_m"]).groupby(table["shape"]).sum()
    return dict((sums / areas_m2).items())
