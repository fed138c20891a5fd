"""Read the tables of a run's folder with the types that a page needs."""

from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.io.cells import read_cells, refuse
from radiotwin.io.forms import MAX_NUMBER, MAX_POSITION_M

POSITION = ("x_m", "y_m", "z_m")
TRACK = {"flight": "text", "uav": "text", "time_s": "number", "x_m": "number", "y_m": "number",
         "z_m": "number or nothing"}
RESIDUALS = {
    "flight": "text", "receiver": "text", "device": "text", "los": "0 or 1",
    **dict.fromkeys((f"{end}_{name}" for end in ("receiver", "device") for name in POSITION),
                    "number or nothing"),
    "before_db": "number or nothing", "after_db": "number or nothing"}
PLANNING = {"method": "text", "trained_in": "text", "real_episodes": "number",
            "truth_ratio": "number"}
"""Column -> kind of its cells; the columns that a table must have."""


def read_table(path: Path, kinds: dict[str, str], optional: dict[str, str] | None = None,
               ) -> pd.DataFrame:
    """Read columns of a table that a run holds.

    Args:
        path: `.csv` or `.csv.gz`.
        kinds: column -> `text`, `number`, `number or nothing` (NaN), or `0 or 1`.
        optional: the same, of columns that may be missing.

    Raises:
        BadInput: it cannot be read, a column is missing, or a cell is of another kind.
    """
    cells = read_cells(path)
    missing = [name for name in kinds if name not in cells]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; make the run again")
    wanted = kinds | {name: kind for name, kind in (optional or {}).items() if name in cells}
    return pd.DataFrame({name: cells[name] if kind == "text" else
                         _numbers(path, name, cells[name], kind)
                         for name, kind in wanted.items()})


def _numbers(path: Path, name: str, column: pd.Series, kind: str) -> pd.Series:
    numbers = pd.to_numeric(column, errors="coerce").astype(float)
    nothing = column.str.strip().isin(["", "nan"]) & (kind == "number or nothing")
    most = MAX_POSITION_M if name.endswith("_m") else MAX_NUMBER
    refuse(path, name, column, ~nothing & ~(np.abs(numbers) <= most),
           f"is not a number within ±{most:g}; make the run again")
    if kind == "0 or 1":
        refuse(path, name, column, ~numbers.isin([0.0, 1.0]), "is neither 0 nor 1; make the run "
                                                              "again")
    return numbers
