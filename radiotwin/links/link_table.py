"""Read and check the table of links, from a file or a data frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo import median_origin
from radiotwin.io.cells import as_numbers, listed, read_cells, refuse
from radiotwin.io.forms import Origin, name_fault
from radiotwin.links.plausible import LEVELS, refuse_implausible
from radiotwin.links.site_table import SiteTable, read_site_table

NAMES = ("flight", "receiver", "device")
RECEIVER_POSITION = ["receiver_x_m", "receiver_y_m", "receiver_z_m"]
DEVICE_POSITION = ["device_x_m", "device_y_m", "device_z_m"]
# Columns of measurements.csv, as in docs/conventions.md.
REQUIRED = ["flight", "receiver", *RECEIVER_POSITION, "device"]
ABOVE_GROUND = "receiver_above_ground_m"
OPTIONAL = ["time_s", "heading_deg", "pitch_deg", "roll_deg", "quality", ABOVE_GROUND]
MAY_BE_EMPTY = {"receiver_z_m", *LEVELS, *OPTIONAL}
FRAME = "the data frame"  # in messages


def read_links(path: Path) -> pd.DataFrame:
    """Read `measurements.csv`; BadInput names file, row and column of the first bad value."""
    return _checked(path, read_cells(path, REQUIRED, OPTIONAL + LEVELS), refuse)


def is_table_of_links(frame: pd.DataFrame) -> bool:
    """Return whether a data frame has all columns of `measurements.csv`, in their types."""
    return set(REQUIRED) <= set(frame) and all(
        (name in NAMES) != (frame[name].dtype.kind in "fiu")
        for name in frame if name in {*REQUIRED, *OPTIONAL, *LEVELS})


def links_of_frame(frame: pd.DataFrame, origin: Origin | None
                   ) -> tuple[pd.DataFrame, Origin | None, tuple[str, ...]]:
    """Convert a data frame of another layout to a table of links; return its origin and notes, too.

    Receiver positions may be in any columns that a table of sites may have, such as `lat` and
    `lon`. Without a column `flight` or `receiver`, all links are of one `1`. Without an origin, the
    middle of latitudes and longitudes becomes it. BadInput names row and column.
    """
    table, notes = frame.reset_index(drop=True), tuple[str, ...]()
    require_level(FRAME, table)
    if "device" not in table:
        raise BadInput(f"{FRAME}: column 'device' is missing: whose level is it? Rename the column "
                       "that says so, or add one, frame.assign(device='mast'); it has "
                       f"{listed(table)}")
    if not {*RECEIVER_POSITION} <= set(table):
        sites = receivers_of_frame(table)
        if "latitude" in sites.values and "x" not in sites.values and origin is None:
            origin = median_origin(sites.values)
        position_m = sites.local_m(origin, None, "the measurements")
        table = table.drop(columns=list(sites.columns.values()), errors="ignore").assign(
            **dict(zip(RECEIVER_POSITION, position_m.T)))
        if "above_ground_m" in sites.values:
            table[ABOVE_GROUND] = sites.values["above_ground_m"].to_numpy()
        notes = sites.notes
    for name in ("flight", "receiver"):
        if name not in table:
            table[name] = "1"
    known = [name for name in table if name in {*REQUIRED, *OPTIONAL, *LEVELS}]
    checked = _checked(FRAME, table[known].copy(), partial(refuse, where="row {}".format))
    return table.assign(**{name: checked[name] for name in known}), origin, notes


def receivers_of_frame(frame: pd.DataFrame) -> SiteTable:
    """Read the receiver positions in a data frame of links, from columns such as `lat`, `lon`.

    Columns of names, levels and devices are not searched. BadInput: see `read_site_table`.
    """
    other = {*NAMES, *OPTIONAL, *LEVELS} - {ABOVE_GROUND}
    names = [name for name in frame if name not in other and not str(name).startswith("device")]
    if len(frame) and not names:
        raise BadInput(f"{FRAME}: there is no position; columns latitude, longitude or x_m, y_m "
                       f"are needed, it has {listed(frame)}")
    cells = frame[names].rename(columns={ABOVE_GROUND: "above_ground_m"}).reset_index(drop=True)
    return read_site_table(FRAME, cells, "row {}".format, None)


def require_level(source: object, table: pd.DataFrame) -> None:
    """Raise BadInput unless a table has exactly one of the columns `LEVELS`."""
    levels = [name for name in LEVELS if name in table]
    if len(levels) != 1:
        rename = f"; rename the one that holds levels (it has {listed(table)}): gains in dB, or " \
                 "received powers in dBm" if source == FRAME else ""
        raise BadInput(f"{source}: needs exactly one of the columns {' and '.join(LEVELS)}, it "
                       f"has {'both' if levels else 'neither'}{rename}")


def _checked(source: Path | str, table: pd.DataFrame, refuse: Callable[..., None]) -> pd.DataFrame:
    """Convert the columns of a table in place: names to texts, others to numbers (NaN: empty)."""
    for name in table.columns:
        cells = table[name]
        if name in NAMES:
            table[name] = _names(source, name, cells, refuse)
        else:
            table[name] = _numbers(source, name, cells, name in MAY_BE_EMPTY, refuse)
            refuse_implausible(partial(refuse, source, name, cells), name, table[name].to_numpy())
    return table


def _names(path: Path | str, name: str, column: pd.Series,
           refuse: Callable[..., None]) -> pd.Series:
    """Convert a column of names to stripped texts; BadInput on one that cannot be a name."""
    try:
        codes, known = pd.factorize(column)
    except TypeError:
        raise BadInput(f"{path}: column {name} holds lists or records; it needs one name in each "
                       "row") from None
    # pandas reads a column of whole numbers with missing ones as floats.
    texts = [str(int(each) if isinstance(each, float) and each.is_integer() else each).strip()
             for each in known.tolist()]
    names = pd.Series(np.array([*texts, ""], dtype=object)[codes], column.index, dtype=str)
    for text in dict.fromkeys([*texts, ""]):
        if fault := name_fault(text):
            refuse(path, name, names, names == text, fault)
    return names


def _numbers(path: Path | str, name: str, column: pd.Series, may_be_empty: bool,
             refuse: Callable[..., None]) -> pd.Series:
    """Convert a column to finite numbers, NaN where empty; BadInput on any other cell."""
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
