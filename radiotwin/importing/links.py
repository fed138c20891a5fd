"""The rows of a file as links: one row per receiver, device and reading."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.budgets import ROWS
from radiotwin.cells import listed, shown
from radiotwin.errors import BadInput
from radiotwin.importing.lengths import in_metres
from radiotwin.importing.levels import read_levels
from radiotwin.importing.problems import Problems
from radiotwin.importing.settings import BY_DAY, BY_FILE, BY_POSITION, QUANTITIES, Settings, Wide
from radiotwin.importing.source import ALWAYS, Source, columns_of
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
        offset_db: added to its levels.
    """

    spec: str
    own: dict[str, str]
    offset_db: float = 0.0


def build_links(source: Source, settings: Settings, tally: Tally, problems: Problems,
                file_name: str) -> tuple[pd.DataFrame, int]:
    """Convert rows to links.

    Args:
        source: the file.
        settings: mapping and units.
        tally: counts the readings that are left out.
        problems: gets all that is wrong; then the links are incomplete.
        file_name: the name that `by file` stands for.

    Returns:
        links in the order of the file, and the number of readings per row of the file. The index is
        that of the source. Columns: `device, receiver, flight, level_db`; those of `QUANTITIES` and
        of `device_` + `QUANTITIES` that are given [degrees, m]; and `time_s, heading_deg,
        pitch_deg, roll_deg, quality, frequency_hz` where given.
    """
    columns = settings.columns.model_dump(exclude_none=True)
    columns = {name: f"{ALWAYS}{file_name}" if spec == BY_FILE else spec
               for name, spec in columns.items()}
    levels: list[LevelColumn] = []
    with problems.noted():
        levels = _level_columns(source, settings)
    with problems.noted():
        source.require({name: spec for name, spec in columns.items()
                        if spec not in (BY_DAY, BY_POSITION)})
    shared = _shared(source, columns, settings, problems)
    ROWS.check(len(source) * len(levels), f"{source.path}: rows times columns of levels")
    parts = []
    for level in levels:
        if any(name not in source.table for name in columns_of(level.spec, source.table)):
            continue  # which is reported already
        with problems.noted():
            parts.append(_rows_as_links(source, level, shared, settings, tally))
    if problems:
        return shared, 0
    links = parts[0] if len(parts) == 1 else pd.concat(parts).sort_index(kind="stable")
    return links, len(levels)


def _shared(source: Source, columns: dict[str, str], settings: Settings,
            problems: Problems) -> pd.DataFrame:
    """Return the columns that all levels of a row share: times, positions, names."""
    shared = pd.DataFrame(index=source.table.index)
    present = {name for name, spec in columns.items()
               if spec in (BY_DAY, BY_POSITION)
               or all(column in source.table for column in columns_of(spec, source.table))}
    if "time" in present:
        with problems.noted():
            shared["time_s"] = seconds(source, columns["time"], settings.time_format,
                                       settings.time_zone)
    quantities = [prefix + name for prefix in ("device_", "") for name in QUANTITIES]
    without_unit = False
    for name in (*quantities, *ANGLES, "quality", "frequency_hz", "snr"):
        if name not in present:
            continue
        is_length = _is_length(name, settings)
        if is_length and settings.length_unit is None and without_unit:
            continue  # it is reported once
        without_unit = without_unit or is_length
        with problems.noted():
            column = f"{name}_deg" if name in ANGLES else name
            shared[column] = _quantity(source, name, columns[name], settings)
    if problems:
        return shared
    for name in NAMES:
        if name in present:
            with problems.noted():
                shared[name] = _names(source, name, columns[name], shared, settings)
    return shared


def _rows_as_links(source: Source, level: LevelColumn, shared: pd.DataFrame, settings: Settings,
              tally: Tally) -> pd.DataFrame:
    """Return the usable links of one column of levels."""
    links = shared.copy(deep=False)  # columns are added and replaced, none is changed
    for name, spec in level.own.items():
        if name not in NAMES:
            prefix = "device_" if "device" in level.own else ""
            links[prefix + name] = _quantity(source, name, spec, settings)
        elif _names_a_column(source, level, spec):
            links[name] = source.names(spec, name)
            nobody = (links[name] == "").to_numpy()
            links = tally.drop(links, nobody, f"no {name}", spec, source.where)
            source = Source(source.path, source.table[~nobody], source.where)
        else:
            if spec and (fault := name_fault(spec)):
                raise BadInput(f"{source.path}: {name} {shown(spec)} of column {level.spec} "
                               f"{fault}")
            links[name] = spec
    offset_db: float | np.ndarray = settings.level_offset_db + level.offset_db
    if "snr" in links:  # below the noise, RSSI is that of the noise (Semtech, SX1276, 5.5.5)
        offset_db = offset_db + np.minimum(links.pop("snr").fillna(0.0).to_numpy(), 0.0)
    levels = read_levels(source, level.spec, settings, offset_db)
    links["level_db"] = levels.db
    unmeasured = levels.not_measured
    links = tally.drop(links, unmeasured, "not measured", level.spec, source.where)
    links = tally.drop(links, levels.impossible[~unmeasured], "impossible level", level.spec,
                       source.where)
    for name in NAMES:
        if name in links:
            links = tally.drop(links, links[name] == "", f"no {name}",
                               _spec(settings, level, name), source.where)
    for prefix in ("", "device_"):
        if {prefix + name for name in LIMITS_DEG} <= set(links):
            for name in LIMITS_DEG:
                _check_degrees(source, links, prefix, name, _spec(settings, level, prefix + name))
            no_fix = (links[prefix + "latitude"] == 0) & (links[prefix + "longitude"] == 0)
            reason = f"{prefix}latitude, longitude 0, 0 (no fix)".replace("_", " ")
            links = tally.drop(links, no_fix, reason, _spec(settings, level, prefix + "latitude"),
                               source.where)
    return links


def _names_a_column(source: Source, level: LevelColumn, spec: str) -> bool:
    """Return whether a name of a column of levels is in another column, as `PCI 1` is."""
    return spec in source.table and spec != level.spec


def _is_length(name: str, settings: Settings) -> bool:
    base = name.removeprefix("device_")
    return base in QUANTITIES and base not in LIMITS_DEG and not (settings.crs and base in "xy")


def _quantity(source: Source, name: str, spec: str, settings: Settings) -> np.ndarray:
    """Return the numbers of a column in the project's units, (n,)."""
    numbers = source.numbers(spec, name)
    if _is_length(name, settings):
        return in_metres(numbers, settings.length_unit, f"{source.path}: column {spec}")
    refuse_limits(lambda bad, reason: source.refuse(spec, source.cells(spec, name), bad, reason),
                  f"{name}_deg" if name in ANGLES else name, numbers)
    return numbers


def _names(source: Source, name: str, spec: str, shared: pd.DataFrame,
           settings: Settings) -> np.ndarray:
    """Return the names of devices, receivers or flights, (n,); `""` where there is none."""
    if name == "flight" and spec == BY_DAY:
        return calendar_days(shared["time_s"].to_numpy(), settings.time_zone)
    if name == "device" and spec == BY_POSITION:
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
    own = block.model_dump(exclude_none=True, exclude={"level", "level_offset_db"})
    found: list[LevelColumn] = []
    names = list(map(str, source.table))
    for pattern in [block.level] if isinstance(block.level, str) else block.level:
        matches = {name: star for name in names
                   if (star := _match(pattern, name)) is not None}
        if not matches:
            raise BadInput(f"{source.path}: no column fits {pattern!r} (wide.level); the file has "
                           f"{listed(names)}. Correct the mapping")
        found += [LevelColumn(name, {key: spec.replace("*", star) for key, spec in own.items()},
                              block.level_offset_db) for name, star in matches.items()]
    for name in own.keys() & set(NAMES):
        in_columns = [_names_a_column(source, column, column.own[name]) for column in found]
        if any(in_columns) and not all(in_columns):
            column = found[in_columns.index(False)]
            raise BadInput(f"{source.path}: wide.{name} = {own[name]!r} names columns of the file "
                           f"for some columns of levels, but for {column.spec} there is no column "
                           f"{column.own[name]!r}; the file has {listed(names)}. Correct the "
                           "mapping")
    return found


def naming_notes(source: Source, settings: Settings) -> list[str]:
    """Return notes on names that are made of those of columns, as a misspelt column would be.

    Args:
        source: the file.
        settings: mapping.
    """
    notes = []
    for block in settings.wide:
        for end in ("device", "receiver"):
            spec = getattr(block, end)
            if not spec or "*" not in spec or spec == "*":
                continue
            columns = _wide_columns(source, block)
            names = [column.own[end] for column in columns
                     if not _names_a_column(source, column, column.own[end])]
            if names:
                notes.append(f"wide.{end} = {spec!r} is no column of the file: the {end}s are "
                             f"named {listed(names)}")
    return notes


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
