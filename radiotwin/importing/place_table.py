"""A table of places beside the file: names, positions, and what `devices.csv` may hold besides."""

import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.frame import to_geographic
from radiotwin.importing.lengths import METRES, in_metres
from radiotwin.importing.links import LIMITS_DEG, refuse_frequencies
from radiotwin.importing.read import Source, read_source
from radiotwin.importing.settings import POSITION, Settings, check_position
from radiotwin.measurements import DEVICE_OPTIONAL


def read_places(path: str, key: str, settings: Settings) -> pd.DataFrame:
    """Read a table with a column `key` (`device` or `receiver`) and a position.

    The position is `latitude, longitude` and `altitude` or `height`, or `x, y, z`. A name may end in its unit
    (`latitude_deg`, `height_m`, `z_ft`); lengths that do not are in `length_unit`.

    Returns:
        columns of `POSITION` [degrees, m] and those of `DEVICE_OPTIONAL` that the table has; the index is the name.

    Raises:
        BadInput: names file, row and column.
    """
    source = read_source(path)
    names = source.text(key, f"the {key}s' names")
    source.refuse(key, names, names == "", f"is empty; every {key} needs a name")
    source.refuse(key, names, names.duplicated(), f"stands there twice; every {key} has one row")
    columns = {name: (spec, unit) for spec in map(str, source.table) for name, unit in [_meaning(spec)] if name}
    try:
        check_position(set(columns), "")
        if not {"latitude", "x"} & set(columns):
            raise ValueError(f"there is no position; columns latitude, longitude or x, y are needed, the table has "
                             f"{', '.join(map(str, source.table.columns))}")
    except ValueError as error:
        raise BadInput(f"{path}: {error}") from None
    places = pd.DataFrame({name: _quantity(source, name, spec, unit, settings)
                           for name, (spec, unit) in columns.items()}, index=names.to_numpy(dtype=object))
    others = {name: source.numbers(name, name) for name in DEVICE_OPTIONAL if name in source.table}
    if "frequency_hz" in others:
        refuse_frequencies(source, "frequency_hz", source.table["frequency_hz"], others["frequency_hz"])
    return to_geographic(places, settings.crs).assign(**others)


def _meaning(spec: str) -> tuple[str | None, str | None]:
    """The quantity of `POSITION` that a column holds, and the unit that its name ends in."""
    name, _, ending = spec.rpartition("_")
    if ending in METRES and name in POSITION and name not in LIMITS_DEG:
        return name, ending
    if ending == "deg" and name in LIMITS_DEG:
        return name, None
    return (spec, None) if spec in POSITION else (None, None)


def _quantity(source: Source, name: str, spec: str, unit: str | None, settings: Settings):
    numbers = source.numbers(spec, name)
    if name in LIMITS_DEG:
        limit = LIMITS_DEG[name]
        source.refuse(spec, source.table[spec], abs(numbers) > limit,
                      f"is no {name}; allowed are -{limit:g} to {limit:g} degrees")
        return numbers
    if settings.crs and name in "xy":
        return numbers
    return in_metres(numbers, unit or settings.length_unit, f"{source.path}: column {spec}")
