"""The rows of a file as links: one row per receiver, device and reading."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.budgets import ROWS
from radiotwin.cells import listed, shown
from radiotwin.errors import BadInput
from radiotwin.importing.lengths import in_metres
from radiotwin.importing.levels import read_levels
from radiotwin.importing.settings import POSITION, Settings, Wide
from radiotwin.importing.source import Source
from radiotwin.importing.tally import Tally
from radiotwin.importing.times import calendar_days, seconds
from radiotwin.measurement_columns import refuse_limits
from radiotwin.tables import name_fault

ANGLES = ("heading", "pitch", "roll")
LIMITS_DEG = {"latitude": 90.0, "longitude": 360.0}
NAMES = ("device", "receiver", "flight")


@dataclass(frozen=True)
class LevelColumn:
    """One column of levels.

    Attributes:
        spec: name of the column.
        own: quantity -> column or name, for those that belong to this column of levels only.
    """

    spec: str
    own: dict[str, str]


def build_links(source: Source, settings: Settings, tally: Tally) -> tuple[pd.DataFrame, int]:
    """Convert rows to links.

    Args:
        source: the file.
        settings: mapping and units.
        tally: counts the readings that are left out.

    Returns:
        links in the order of the file, and the number of readings per row of the file. The index is
        that of the source. Columns: `device, receiver, flight, level_db`; those of `POSITION` and
        of `device_` + `POSITION` that are given [degrees, m]; and `time_s, heading_deg, pitch_deg,
        roll_deg, quality, frequency_hz` where given.

    Raises:
        BadInput: a column is missing, a cell cannot be read, or a unit is not declared.
    """
    columns = settings.columns.model_dump(exclude_none=True)
    shared = pd.DataFrame(index=source.table.index)
    if "time" in columns:
        shared["time_s"] = seconds(source, columns["time"], settings.time_format,
                                   settings.time_zone)
    quantities = [prefix + name for prefix in ("device_", "") for name in POSITION]
    for name in (*quantities, *ANGLES, "quality", "frequency_hz"):
        if name in columns:
            column = f"{name}_deg" if name in ANGLES else name
            shared[column] = _quantity(source, name, columns[name], settings)
    for name in NAMES:
        if name in columns:
            shared[name] = _names(source, name, columns[name], shared, settings)
    levels = _level_columns(source, settings)
    ROWS.check(len(source) * len(levels), f"{source.path}: rows times columns of levels")
    parts = [_links_of(source, level, shared, settings, tally) for level in levels]
    links = parts[0] if len(parts) == 1 else pd.concat(parts).sort_index(kind="stable")
    return links, len(levels)


def _links_of(source: Source, level: LevelColumn, shared: pd.DataFrame, settings: Settings,
              tally: Tally) -> pd.DataFrame:
    """Return the usable links of one column of levels."""
    links = shared.copy(deep=False)  # columns are added and replaced, none is changed
    for name, spec in level.own.items():
        if name in NAMES:
            if spec and (fault := name_fault(spec)):
                raise BadInput(f"{source.path}: {name} {shown(spec)} of column {level.spec} "
                               f"{fault}")
            links[name] = spec
        else:
            prefix = "device_" if "device" in level.own else ""
            links[prefix + name] = _quantity(source, name, spec, settings)
    levels = read_levels(source, level.spec, settings)
    links["level_db"] = levels.db
    unmeasured = levels.not_measured
    links = tally.drop(links, unmeasured, "not measured", level.spec, source.where)
    links = tally.drop(links, levels.impossible[~unmeasured], "impossible level", level.spec,
                       source.where)
    for name in NAMES:
        links = tally.drop(links, links[name] == "", f"no {name}", _spec(settings, level, name),
                           source.where)
    for prefix in ("", "device_"):
        if prefix + "latitude" in links:
            for name in LIMITS_DEG:
                _check_degrees(source, links, prefix, name, _spec(settings, level, prefix + name))
            no_fix = (links[prefix + "latitude"] == 0) & (links[prefix + "longitude"] == 0)
            reason = f"{prefix}latitude, longitude 0, 0 (no fix)".replace("_", " ")
            links = tally.drop(links, no_fix, reason, _spec(settings, level, prefix + "latitude"),
                               source.where)
    return links


def _quantity(source: Source, name: str, spec: str, settings: Settings) -> np.ndarray:
    """Return the numbers of a column in the project's units, (n,)."""
    numbers = source.numbers(spec, name)
    base = name.removeprefix("device_")
    is_length = base in POSITION and base not in LIMITS_DEG
    if is_length and not (settings.crs and base in "xy"):
        return in_metres(numbers, settings.length_unit, f"{source.path}: column {spec}")
    refuse_limits(lambda bad, reason: source.refuse(spec, source.cells(spec, name), bad, reason),
                  f"{name}_deg" if name in ANGLES else name, numbers)
    return numbers


def _names(source: Source, name: str, spec: str, shared: pd.DataFrame,
           settings: Settings) -> np.ndarray:
    """Return the names of devices, receivers or flights, (n,); `""` where there is none."""
    if name == "flight" and spec == "by day":
        return calendar_days(shared["time_s"].to_numpy(), settings.time_zone)
    if name == "device" and spec == "by position":
        position = [column for column in shared if column.startswith("device_")]
        number = shared.groupby(position, sort=False, dropna=False).ngroup() + 1
        horizontal = [column for column in position
                      if column.endswith(("latitude", "longitude", "_x", "_y"))]
        unknown = shared[horizontal].isna().any(axis=1)
        names = "p" + number.astype(str).str.zfill(len(str(number.max())))
        return names.mask(unknown, "").to_numpy(dtype=object)
    return source.names(spec, name)


def _level_columns(source: Source, settings: Settings) -> list[LevelColumn]:
    """Return all columns of levels."""
    if not settings.wide:
        return [LevelColumn(str(settings.columns.level), {})]
    found = [column for block in settings.wide for column in _wide_columns(source, block)]
    specs = pd.Index([column.spec for column in found])
    if specs.has_duplicates:
        repeated = specs[specs.duplicated(keep=False)][0]
        raise BadInput(f"{source.path}: column {repeated!r} fits two of the wide blocks; every "
                       "column of levels belongs to one: narrow their patterns")
    return found


def _wide_columns(source: Source, block: Wide) -> list[LevelColumn]:
    """Return the columns of levels that match the patterns of a block."""
    own = block.model_dump(exclude_none=True, exclude={"level"})
    found = []
    names = list(map(str, source.table))
    for pattern in [block.level] if isinstance(block.level, str) else block.level:
        matches = {name: star for name in names
                   if (star := _match(pattern, name)) is not None}
        if not matches:
            raise BadInput(f"{source.path}: no column fits {pattern!r} (wide.level); the file has "
                           f"{listed(names)}. Correct the mapping")
        found += [LevelColumn(name, {key: spec.replace("*", star) for key, spec in own.items()})
                  for name, star in matches.items()]
    return found


def _match(pattern: str, name: str) -> str | None:
    """Return the text that `*` stands for, the name if there is no `*`, or None (no match)."""
    if "*" not in pattern:
        return name if name == pattern else None
    before, after = pattern.split("*", 1)
    if len(name) < len(before) + len(after):
        return None
    fits = name.startswith(before) and name.endswith(after)
    return name[len(before):len(name) - len(after)] if fits else None


def _spec(settings: Settings, level: LevelColumn, name: str) -> str:
    """Return the column of a quantity, for messages."""
    own = name.removeprefix("device_") if "device" in level.own else name
    return level.own.get(own) or getattr(settings.columns, name, None) or name


def _check_degrees(source: Source, links: pd.DataFrame, prefix: str, name: str, spec: str) -> None:
    limit = LIMITS_DEG[name]
    bad = links[prefix + name].abs() > limit
    if bad.any():
        longitude = links[prefix + "longitude"].abs()
        swapped = (name == "latitude" and bad.mean() > 0.5
                   and (longitude <= LIMITS_DEG["latitude"]).all())
        hint = "; are latitude and longitude swapped in the mapping?" if swapped else ""
        source.refuse(spec, links[prefix + name], bad,
                      f"is no {name}; allowed are -{limit:g} to {limit:g} degrees{hint}")
