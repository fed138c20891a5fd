"""Columns of measurements and of devices: what their cells may hold."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.cells import as_numbers, read_cells, refuse
from radiotwin.tables import name_fault

LEVELS = ["gain_db", "rssi_dbm"]
_TEXT = {"flight", "receiver", "device", "role"}
# Limits that no measurement exceeds: what lies beyond them is another unit or a placeholder.
MAX_LEVEL_DB = 300.0
MAX_COORDINATE_M = 1e7  # a quarter of a meridian
FREQUENCIES_HZ = (1e6, 450e9)  # as of a scene; materials of ITU-R P.2040 end at 450 GHz
MAX_TIME_S = 1e11  # the year 5138; milliseconds since 1970 lie beyond
MAX_SPAN_S = 3.2e9  # a century, the longest campaign
MAX_TILT_DEG = 90.0
MAX_ANGLE_DEG = 1e6  # thousands of turns in one direction, which some compasses count
MAX_POWER_DBM = 300.0  # as of a level
MAX_QUALITY = 1e15  # whole numbers are exact up to there


def read_columns(path: Path, required: list[str], optional: list[str],
                 may_be_empty: set[str]) -> pd.DataFrame:
    """Read the columns of a table, names as texts and all others as numbers.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet`.
        required: columns that it must have.
        optional: columns that it may have.
        may_be_empty: columns whose cells may be empty: NaN.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used.
    """
    table = read_cells(path, required, optional)
    for name in table.columns:
        if name in _TEXT:
            table[name] = _names(path, name, table[name])
        else:
            cells = table[name]
            table[name] = _numbers(path, name, cells, name in may_be_empty)
            refuse_limits(partial(refuse, path, name, cells), name, table[name].to_numpy())
    return table


def _names(path: Path, name: str, column: pd.Series) -> pd.Series:
    """Return the names in a column without spaces around them."""
    names = column.astype(str).str.strip()
    faults = {text: fault for text in names.unique() if (fault := name_fault(text))}
    for text, fault in faults.items():
        refuse(path, name, names, names == text, fault)
    return names


def _numbers(path: Path, name: str, column: pd.Series, may_be_empty: bool) -> pd.Series:
    """Convert the cells of a column, NaN where empty."""
    needed = "every row needs one: fill it in, or leave the row out"
    if column.dtype.kind in "fiu":
        numbers, empty = column.astype(float), column.isna()
    else:
        text = column.fillna("").astype(str).str.strip()
        empty = text == ""
        numbers = pd.Series(as_numbers(text), index=column.index)
        named_nan = numbers.isna() & ~empty
        named_nan[named_nan] = text[named_nan].str.lower().isin(["nan", "na", "none"])
        refuse(path, name, column, numbers.isna() & ~empty & ~named_nan, "is not a number")
        remedy = "leave the cell empty where there is no value" if may_be_empty else needed
        refuse(path, name, column, named_nan, f"is not a number; {remedy}")
    remedy = "; leave the cell empty where nothing was detected" if name in LEVELS else ""
    refuse(path, name, column, np.isinf(numbers), f"is not finite{remedy}")
    if not may_be_empty:
        refuse(path, name, column, empty, f"is empty; {needed}")
    return numbers


def refuse_limits(refuse: Callable[[np.ndarray, str], None], name: str,
                  numbers: np.ndarray) -> None:
    """Refuse numbers of a column that can only be mistakes, such as a wrong unit.

    Args:
        refuse: called with (n,) bool and the reason; raises where one is true.
        name: of the column, as in `measurements.csv` or `devices.csv`.
        numbers: (n,) in its unit; NaN where empty.
    """
    if name in LEVELS:
        refuse(np.abs(numbers) > MAX_LEVEL_DB,
               f"is no level; allowed are -{MAX_LEVEL_DB:g} to {MAX_LEVEL_DB:g}")
    if name == "gain_db":
        refuse(numbers > 0,
               "is above 0 dB, which no channel gain is; received power [dBm] goes into a column "
               "rssi_dbm, and a path loss needs a minus sign")
    if name == "frequency_hz":
        low, high = FREQUENCIES_HZ
        refuse((numbers < low) | (numbers > high),
               f"is no frequency; allowed are {low:g} to {high:g} Hz; the unit is Hz")
    if name.endswith("_m"):
        refuse(np.abs(numbers) > MAX_COORDINATE_M,
               f"is too far away; allowed are -{MAX_COORDINATE_M:g} to {MAX_COORDINATE_M:g} m in "
               "the scene's frame")
    if name == "time_s":
        refuse(np.abs(numbers) > MAX_TIME_S,
               f"is no time; allowed are -{MAX_TIME_S:g} to {MAX_TIME_S:g} s; the unit is s, not "
               "ms")
        if np.isfinite(numbers).any():
            refuse(numbers - np.nanmin(numbers) > MAX_SPAN_S,
                   f"is more than a century ({MAX_SPAN_S:g} s) after the first time, "
                   f"{np.nanmin(numbers):g} s; is one of them wrong, or in another unit?")
    if name == "tilt_deg":
        refuse(np.abs(numbers) > MAX_TILT_DEG,
               f"is no tilt; allowed are -{MAX_TILT_DEG:g} (down) to {MAX_TILT_DEG:g} (up)")
    for ending, limit in (("_deg", MAX_ANGLE_DEG), ("tx_power_dbm", MAX_POWER_DBM),
                          ("quality", MAX_QUALITY)):
        if name.endswith(ending):
            refuse(np.abs(numbers) > limit,
                   f"is out of range; allowed are -{limit:g} to {limit:g}")
