"""Tables of positions: names, positions, and the optional columns of `devices.csv`."""

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.budgets import DEVICES
from radiotwin.cells import listed
from radiotwin.errors import BadInput
from radiotwin.importing.frame import to_geographic
from radiotwin.importing.lengths import METRES, in_metres
from radiotwin.importing.links import LIMITS_DEG
from radiotwin.importing.places import SINCE, UNTIL, numbered
from radiotwin.importing.read_source import read_source
from radiotwin.importing.settings import POSITION, Settings, check_position
from radiotwin.importing.source import Source
from radiotwin.importing.times import ISO, seconds
from radiotwin.measurement_columns import refuse_limits
from radiotwin.measurements import DEVICE_OPTIONAL


def read_positions(path: str, key: str, settings: Settings) -> pd.DataFrame:
    """Read a table of positions.

    Several rows of one device are its places over time: column `since`, and `until` where it was
    nowhere in between, in ISO 8601. They become devices `NAME@1`, `NAME@2`, ….

    The position is `latitude, longitude` and `altitude` or `height`, or `x, y, z`. A column's name
    may end in its unit (`latitude_deg`, `height_m`, `z_ft`); lengths without one are in
    `length_unit`.

    Args:
        path: of the table.
        key: column of the names, `device` or `receiver`.
        settings: `length_unit` and `crs`.

    Returns:
        columns of `POSITION` [degrees, m] and those of `DEVICE_OPTIONAL` that the table has; the
        index holds the names.

    Raises:
        BadInput: names file, row and column.
    """
    source = read_source(path)
    DEVICES.check(len(source), path)
    names = pd.Series(source.names(key, f"the {key}s' names"), index=source.table.index)
    source.refuse(key, names, names == "", f"is empty; every {key} needs a name")
    period: dict[str, np.ndarray] = {}
    if key == "device" and "since" in source.table:
        period = _period(source, settings)
        names = numbered(names, period[SINCE])
    source.refuse(key, names, names.duplicated(), f"occurs twice; every {key} has one row")
    columns = {name: (spec, unit) for spec in map(str, source.table)
               for name, unit in [_quantity_and_unit(spec)] if name}
    try:
        check_position(set(columns), "")
        if not {"latitude", "x"} & set(columns):
            raise ValueError("there is no position; columns latitude, longitude or x, y are "
                             f"needed, the table has {listed(source.table.columns)}")
    except ValueError as error:
        raise BadInput(f"{path}: {error}") from None
    positions = pd.DataFrame({name: _quantity(source, name, spec, unit, settings)
                              for name, (spec, unit) in columns.items()},
                             index=names.to_numpy(dtype=object))
    others = {name: source.numbers(name, name) for name in DEVICE_OPTIONAL if name in source.table}
    for name, numbers in others.items():
        def refuse(bad: ArrayLike, reason: str, name: str = name) -> None:
            source.refuse(name, source.table[name], bad, reason)

        refuse_limits(refuse, name, numbers)
    return to_geographic(positions, settings.crs).assign(**others, **period)


def _period(source: Source, settings: Settings) -> dict[str, np.ndarray]:
    """Return since when, and until when, a device was at a place [s]; NaN where not given."""
    since_s = seconds(source, "since", ISO, settings.time_zone)
    until_s = np.full(len(source), np.nan)
    if "until" in source.table:
        until_s = seconds(source, "until", ISO, settings.time_zone)
    source.refuse("until", source.cells("since", "since"), until_s <= since_s,
                  "is not before the time until which the device was there")
    return {SINCE: since_s, UNTIL: until_s}


def _quantity_and_unit(spec: str) -> tuple[str | None, str | None]:
    """Return the quantity of `POSITION` in a column, and the unit at the end of its name."""
    name, _, ending = spec.rpartition("_")
    if ending in METRES and name in POSITION and name not in LIMITS_DEG:
        return name, ending
    if ending == "deg" and name in LIMITS_DEG:
        return name, None
    return (spec, None) if spec in POSITION else (None, None)


def _quantity(source: Source, name: str, spec: str, unit: str | None,
              settings: Settings) -> np.ndarray:
    """Return the numbers of a column [degrees, m, or the unit of the crs], (n,)."""
    numbers = source.numbers(spec, name)
    if name in LIMITS_DEG:
        limit = LIMITS_DEG[name]
        source.refuse(spec, source.table[spec], abs(numbers) > limit,
                      f"is no {name}; allowed are -{limit:g} to {limit:g} degrees")
        return numbers
    if settings.crs and name in "xy":
        return numbers
    return in_metres(numbers, unit or settings.length_unit, f"{source.path}: column {spec}")
