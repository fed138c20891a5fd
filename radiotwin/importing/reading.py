"""Read the files of an import as links: one row for each reading of a device by a receiver."""

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.display import count as counted
from radiotwin.errors import BadInput
from radiotwin.importing.formats import FORMATS, expected, find_format, format_named
from radiotwin.importing.log_files import LogFile, flight_names
from radiotwin.importing.read_source import read_source
from radiotwin.importing.repeats import without_repetition
from radiotwin.importing.settings import (
    BY_DAY,
    BY_FILE,
    BY_POSITION,
    QUANTITIES,
    Settings,
    Wide,
    merged,
)
from radiotwin.importing.source import (
    ALWAYS,
    BadRows,
    Problems,
    Source,
    Tally,
    are_few,
    columns_of,
)
from radiotwin.importing.units import (
    LEVEL_COLUMN,
    calendar_days,
    in_metres,
    past_midnights,
    read_levels,
    seconds,
)
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import as_numbers, as_text, cell_text, listed
from radiotwin.io.forms import name_fault
from radiotwin.links.plausible import MAX_DEGREES, READS, height_placeholders, refuse_implausible
from radiotwin.links.site_table import HEIGHTS, METRES

ANGLES = ("heading", "pitch", "roll")
NAMES = ("device", "receiver", "flight")
_HZ = {"mhz": 1e6, "ghz": 1e9}
_FIXED_LENGTH = re.compile(rf"{ALWAYS}([-+]?\d+(?:\.\d+)?) (m|ft)")
FILE_DATE = "{file date}"
_DATE = r"(?<!\d)((?:19|20)\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])(?!\d)"
_DOTTED_DATE = r"(?<!\d)(0[1-9]|[12]\d|3[01])\.(0[1-9]|1[0-2])\.((?:19|20)\d\d)(?!\d)"


@dataclass(frozen=True)
class LevelColumn:
    """A column of levels, with the quantities of that column alone, and an offset [dB]."""

    spec: str
    own: dict[str, str]
    offset_db: float = 0.0


def build_links(source: Source, settings: Settings, tally: Tally, problems: Problems,
                file_name: str) -> tuple[pd.DataFrame, int]:
    """Convert the rows of a file to links; with any `problems` the result is incomplete.

    Returns:
        links in the order of the file, with the index of the source, and the number of readings per
        row. With a column `snr`, an SNR below 0 dB is added to the level. Columns: `device,
        receiver, flight, level_db` [dB or dBm]; if given, `QUANTITIES` and `device_` +
        `QUANTITIES` [deg, m], and `time_s, heading_deg, pitch_deg, roll_deg, quality,
        frequency_hz`.
    """
    columns = settings.columns.model_dump(exclude_none=True)
    columns = {name: _from_file_name(source, name, spec, file_name)
               for name, spec in columns.items()}
    levels: list[LevelColumn] = []
    with problems.noted():
        levels = _level_columns(source, settings)
    with problems.noted():
        source.require({name: spec for name, spec in columns.items()
                        if spec not in (BY_DAY, BY_POSITION)})
    shared = _row_columns(source, columns, settings, problems)
    if "time_s" in shared and len(shared) and not problems:
        ends = [name for name in ("device", "receiver") if name in shared]
        shared["time_s"], note = past_midnights(
            source, columns["time"], shared["time_s"].to_numpy(),
            lambda: shared.groupby(ends, sort=False).ngroup().to_numpy())
        tally.notes += [note] * bool(note)
        if columns["flight"] == BY_DAY:
            shared["flight"] = calendar_days(shared["time_s"].to_numpy(), settings.time_zone)
    if not problems:
        shared = source.bad_rows.drop_noted(shared, tally, len(levels), source.where)
        source = source.select(source.table.index.isin(shared.index))
    ROWS.check(len(source) * len(levels), f"{source.path}: rows times columns of levels")
    parts = []
    for level in levels:
        if any(name not in source.table for name in columns_of(level.spec, source.table)):
            continue  # reported already
        with problems.noted():
            parts.append(_rows_as_links(source, level, shared, settings, tally))
    if problems:
        return shared, 0
    links = parts[0] if len(parts) == 1 else pd.concat(parts).sort_index(kind="stable")
    return links, len(levels)


def _from_file_name(source: Source, name: str, spec: str, file_name: str) -> str:
    """Replace `by file` and `{file date}` in a mapping's entry by what the file name says.

    `by file` is the whole name, for names, else the one number with a unit in it, or BadInput.
    """
    if spec == BY_FILE and name in NAMES:
        return f"{ALWAYS}{file_name}"
    if spec == BY_FILE:
        pattern = r"(?<![\d.])(\d+(?:\.\d+)?) ?(" + (
            "mhz|ghz" if name == "frequency_hz" else "m|ft") + r")(?![a-z])"
        found = {(float(number), unit) for number, unit in
                 re.findall(pattern, file_name.lower().replace("_", " "))}
        if len(found) == 1:
            number, unit = found.pop()
            return f"{ALWAYS}{number * _HZ.get(unit, 1.0):.12g} {unit if unit in METRES else ''}"
        example = "868MHz" if name == "frequency_hz" else "30m, 100ft"
        raise BadInput(f"{source.path}: {name} = {BY_FILE!r} needs one number with its unit in the "
                       f"file's name, such as {example}; it has {len(found)}. Give a column, or "
                       f"{ALWAYS}VALUE")
    if FILE_DATE not in spec:
        return spec
    dates = {"-".join(parts) for parts in re.findall(_DATE, file_name)}
    dates |= {f"{year}-{month}-{day}" for day, month, year in re.findall(_DOTTED_DATE, file_name)}
    if len(dates) != 1:
        raise BadInput(f"{source.path}: {FILE_DATE} needs one date in the file's name, such as "
                       f"2024-05-01, 20240501 or 01.05.2024; it has {len(dates)}. Write the date "
                       "in place of it")
    return spec.replace(FILE_DATE, dates.pop())


def _row_columns(source: Source, columns: dict[str, str], settings: Settings,
                 problems: Problems) -> pd.DataFrame:
    """Read times, positions and names of rows, which belong to all levels in a row."""
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
        is_length = settings.length_unit is None and _is_length(name, settings)
        if is_length and without_unit:
            continue  # it is reported once
        before = len(problems)
        with problems.noted():
            column = f"{name}_deg" if name in ANGLES else name
            shared[column] = _quantity(source, name, columns[name], settings)
        without_unit |= is_length and len(problems) > before
    if problems:
        return shared
    for name in NAMES:
        if name in present:
            with problems.noted():
                shared[name] = _names(source, name, columns[name], shared, settings)
    return shared


def _rows_as_links(source: Source, level: LevelColumn, shared: pd.DataFrame, settings: Settings,
              tally: Tally) -> pd.DataFrame:
    """Make a link of each row's level in one column; unusable ones are counted and dropped."""
    links = shared.copy(deep=False)  # columns are added and replaced, never changed in place
    for name, spec in level.own.items():
        if name not in NAMES:
            prefix = "device_" if "device" in level.own else ""
            links[prefix + name] = _quantity(source, name, spec, settings)
        elif _names_a_column(source, level, spec):
            links[name] = source.names(spec, name)
            nobody = (links[name] == "").to_numpy()
            links = tally.drop(links, nobody, f"no {name}", spec, source.where)
            source = source.select(~nobody)
        else:
            if spec and (fault := name_fault(spec)):
                raise BadInput(f"{source.path}: {name} {cell_text(spec)} of column {level.spec} "
                               f"{fault}")
            links[name] = spec
    offset_db: float | np.ndarray = settings.level_offset_db + level.offset_db
    if "snr" in links:  # below the noise, RSSI is that of the noise (Semtech, SX1276, 5.5.5)
        offset_db = offset_db + np.minimum(links.pop("snr").fillna(0.0).to_numpy(), 0.0)
    links["level_db"], links["reason"] = read_levels(source, level.spec, settings, offset_db)
    links = source.bad_rows.drop_noted(links, tally, 1, source.where)
    for reason in ("not measured", "impossible level"):
        links = tally.drop(links, links["reason"] == reason, reason, level.spec, source.where)
    links = links.drop(columns="reason")
    for name in NAMES:
        if name in links:
            links = tally.drop(links, links[name] == "", f"no {name}",
                               _column_name(settings, level, name), source.where)
    for prefix in ("", "device_"):
        if {prefix + name for name in MAX_DEGREES} <= set(links):
            for name in MAX_DEGREES:
                links = _drop_impossible_degrees(source, links, prefix, name,
                                            _column_name(settings, level, prefix + name), tally)
            no_fix = (links[prefix + "latitude"] == 0) & (links[prefix + "longitude"] == 0)
            reason = f"{prefix}latitude, longitude 0, 0 (no fix)".replace("_", " ")
            links = tally.drop(links, no_fix, reason,
                               _column_name(settings, level, prefix + "latitude"), source.where)
        for name in HEIGHTS:
            column = prefix + name.removesuffix("_m")
            if column in links:
                links = tally.drop(links, height_placeholders(links[column].to_numpy()),
                                   "impossible height", _column_name(settings, level, column),
                                   source.where)
    return links


def _names_a_column(source: Source, level: LevelColumn, spec: str) -> bool:
    """Return whether the name that belongs to a column of levels is itself in a column."""
    return spec in source.table and spec != level.spec


def _is_length(name: str, settings: Settings) -> bool:
    """Return whether a quantity is a length, which needs a unit."""
    base = name.removeprefix("device_")
    return base in QUANTITIES and base not in MAX_DEGREES and not (settings.crs and base in "xy")


def _quantity(source: Source, name: str, spec: str, settings: Settings) -> np.ndarray:
    """Read the numbers of a quantity (n,): lengths in metres, others as in the file; NaN: empty."""
    if _is_length(name, settings) and (fixed := _FIXED_LENGTH.fullmatch(spec)):
        return np.full(len(source), float(fixed[1]) * METRES[fixed[2]])
    numbers = source.numbers(spec, name)
    if _is_length(name, settings):
        return in_metres(numbers, settings.length_unit, f"{source.path}: column {spec}")
    refuse_implausible(
        lambda bad, reason: source.refuse(spec, source.cells(spec, name), bad, reason),
        f"{name}_deg" if name in ANGLES else name, numbers)
    return numbers


def _names(source: Source, name: str, spec: str, shared: pd.DataFrame,
           settings: Settings) -> np.ndarray:
    """Read or make the names (n,) of devices, receivers or flights; `""`: none."""
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
    """Return the column of levels, or in a wide table (a column for each end) all of them."""
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
    """Return the columns of levels that fit a block's patterns, one for each device or receiver."""
    specs = block.model_dump(exclude_none=True, exclude={"level", "level_offset_db"})
    found: list[LevelColumn] = []
    names = list(map(str, source.table))
    for pattern in [block.level] if isinstance(block.level, str) else block.level:
        matches = {name: star for name in names
                   if (star := _match(pattern, name)) is not None}
        if not matches:
            raise BadInput(f"{source.path}: no column fits {pattern!r} (wide.level); the file has "
                           f"{listed(names)}. Correct the mapping")
        found += [LevelColumn(name, {key: spec.replace("*", star) for key, spec in specs.items()},
                              block.level_offset_db) for name, star in matches.items()]
    for name in specs.keys() & set(NAMES):
        in_columns = [_names_a_column(source, column, column.own[name]) for column in found]
        if any(in_columns) and not all(in_columns):
            column = found[in_columns.index(False)]
            raise BadInput(f"{source.path}: wide.{name} = {specs[name]!r} names columns of the "
                           f"file for some columns of levels, but for {column.spec} there is no "
                           f"column {column.own[name]!r}; the file has {listed(names)}. Correct "
                           "the mapping")
    return found


def _naming_notes(source: Source, settings: Settings) -> list[str]:
    """Note devices or receivers named by a pattern of a setting that may be a misspelt column."""
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
    """Return the text that `*` stands for in a name, or the name without `*`; None: no match."""
    before, star, after = map(re.escape, pattern.partition("*"))
    found = re.fullmatch(f"{before}(.*){after}" if star else f"({before})", name, re.DOTALL)
    return found[1] if found else None


def _column_name(settings: Settings, level: LevelColumn, name: str) -> str:
    """Return the column of a quantity, for messages."""
    key = name.removeprefix("device_") if "device" in level.own else name
    return level.own.get(key) or getattr(settings.columns, name, None) or name


def _drop_impossible_degrees(source: Source, links: pd.DataFrame, prefix: str, name: str, spec: str,
                        tally: Tally) -> pd.DataFrame:
    """Drop links with an impossible latitude or longitude; BadInput if many (`are_few`)."""
    limit = MAX_DEGREES[name]
    bad = links[prefix + name].abs() > limit
    if not are_few(bad.sum(), len(bad)):
        longitude = links[prefix + "longitude"].abs()
        swapped = (name == "latitude" and bad.mean() > 0.5
                   and (longitude <= MAX_DEGREES["latitude"]).all())
        hint = "; are latitude and longitude swapped in the mapping?" if swapped else ""
        source.refuse(spec, links[prefix + name], bad,
                      f"is no {name}; allowed are -{limit:g} to {limit:g} degrees{hint}")
        return source.bad_rows.drop_noted(links, tally, 1, source.where)
    return tally.drop(links, bad, f"no {name} (beyond {limit:g}°)", spec, source.where)


@dataclass(frozen=True)
class Logs:
    """The links of all files.

    Attributes:
        source: all files, for messages only.
        links: of all files, see `build_links`.
        level_column: of `measurements.csv`.
        readings: of all files.
        files: name, rows, readings, format and unused columns of each file, for the report.
        notes: on how files were read.
        bad_rows: unreadable rows that were left out, see `BadRows.rows`.
    """

    source: Source
    links: pd.DataFrame
    level_column: str
    readings: int
    files: list[dict[str, Any]]
    notes: list[str]
    bad_rows: list[dict[str, str]]


def read_logs(files: list[LogFile], settings: Settings, tally: Tally,
              on_progress: Callable[[str], None]) -> Logs:
    """Read all files of an import; undeclared settings come from each file's format.

    Raises:
        BadInput: all errors, with file, row and column.
    """
    problems, bad_rows = Problems(), BadRows(settings.skip_bad_rows)
    parts: list[pd.DataFrame] = []
    records: list[dict[str, Any]] = []
    wheres: list[tuple[int, Callable[[int], str]]] = []
    level_column = ""
    notes: list[str] = []
    rows = 0
    may_be = expected([format_named(settings.format)] if settings.format else FORMATS,
                      _declared_columns(settings))
    by_default = BY_FILE if len(files) > 1 else "always flight"
    for file, name in zip(files, flight_names(files)):
        on_progress(f"reading {file.name}" if len(files) > 1 else "reading")
        bad_rows.prefix = f"{file.name}: " * (len(files) > 1)
        with problems.noted():
            source = read_source(file, settings, may_be, bad_rows)
            file_settings, format_name, caution = _settings_for(source, settings, by_default)
            source = _renumbered(source, rows, bad_rows.prefix)
            wheres.append((rows, source.where))
            rows += len(source)
            ROWS.check(rows, "all files")
            source = _drop_truncated_rows(source, file_settings)
            count = len(source) + sum(number for _, number, _ in source.left_out)
            on_progress("links")
            links, per_row = _file_links(source, file_settings, tally, problems, name)
            if not per_row:
                continue
            for reason, number, place in source.left_out:
                tally.count(reason, "", number * per_row, place)
            if file_settings.read_at == "device":
                links[READS] = 1.0
            parts.append(links)
            level_column = LEVEL_COLUMN[str(file_settings.level_unit)]  # one for all files
            records.append({"file": file.name, "rows": count, "readings": count * per_row,
                            "format": format_name, "not_used": _unused(source, file_settings)})
            notes += [*source.notes, *_naming_notes(source, file_settings),
                      *([f"{file.name}: {caution}"] if caution else [])]
    problems.check()
    if unused := dict.fromkeys(name for record in records for name in record["not_used"]):
        notes.append(f"columns that are not used: {listed(unused)}")
    links = parts[0] if len(parts) == 1 else pd.concat(parts)
    starts = [start for start, _ in wheres]

    def where(index: int) -> str:
        return wheres[bisect_right(starts, index) - 1][1](index)

    label = files[0] if len(files) == 1 else f"{len(files)} files"
    whole = Source(str(label), links.iloc[:0], where)
    if len(files) > 1:
        links = _without_copies(whole, links, starts, tally)
    return Logs(whole, links, level_column, sum(record["readings"] for record in records), records,
                list(dict.fromkeys([*notes, *tally.notes])), list(bad_rows.rows.values()))


def _unused(source: Source, settings: Settings) -> list[str]:
    """Return the columns of a file that are not used."""
    header = list(map(str, source.table))
    used = {name for spec in settings.columns.model_dump(exclude_none=True).values()
            for name in columns_of(spec, header)} | set(settings.only)
    for block in settings.wide:
        for level in _wide_columns(source, block):
            used |= {level.spec, *level.own.values()}
    return [name for name in header if name not in used]


def _declared_columns(settings: Settings) -> set[str]:
    """Return the columns that the user's mapping names, in lower case, without patterns."""
    specs = settings.columns.model_dump(exclude_none=True).values()
    names = {name.lower() for spec in specs for name in columns_of(spec, ())}
    for block in settings.wide:
        names |= {each.lower() for each in
                  ([block.level] if isinstance(block.level, str) else block.level)
                  if "*" not in each}
    return names


def _settings_for(source: Source, settings: Settings,
                 flight: str) -> tuple[Settings, str | None, str]:
    """Complete the settings by those of the file's format; return also its name and a caution."""
    header = list(map(str, source.table))
    found = None
    if settings.format:
        found = format_named(settings.format)
        if not found.fits(header):
            raise BadInput(f"{source.path} is not of format {found.name}, which has the columns "
                           f"{', '.join(found.signature)}; it has {listed(header)}")
    elif not settings.columns.level and not settings.wide:
        found = find_format(header)
    defaults: dict[str, Any] = {"columns": {"flight": flight}}
    if found is not None:
        defaults = {**found.settings, "columns": {"flight": flight, **found.mapping(header)}}
        if settings.columns.device:  # the ends may be exchanged
            defaults.pop("read_at", None)
    complete = merged(settings, defaults)
    complete.require_columns(str(source.path), header)
    if found is None:
        return complete, None, ""
    zone = "" if settings.time_zone else found.zone_caution
    return complete, found.name, ". ".join(filter(None, [found.caution, zone]))


def _renumbered(source: Source, first: int, prefix: str) -> Source:
    """Renumber rows from `first`, to differ between files; put `prefix` before their places."""
    where = source.where
    table = source.table.set_axis(pd.RangeIndex(first, first + len(source)))
    return replace(source, table=table, where=lambda index: f"{prefix}{where(index - first)}",
                   fields={first + row: count for row, count in source.fields.items()},
                   left_out=tuple((reason, number, f"{prefix}{place}")
                                  for reason, number, place in source.left_out))


def _drop_truncated_rows(source: Source, settings: Settings) -> Source:
    """Drop rows cut off before the last of `settings.columns`; BadInput if there are many.

    Short rows with all these columns stay, with a note: programs omit empty last cells. Columns of
    `wide` do not count: the missing cells of a short row are read as empty. But the only row of its
    length, if it ends with a used column, may be cut off within that cell.
    """
    header = list(map(str, source.table))
    specs = settings.columns.model_dump(exclude_none=True).values()
    used = {name for spec in specs for name in columns_of(spec, header)} & set(header)
    needed = 1 + max((header.index(name) for name in used), default=-1)
    lengths = Counter(source.fields.values())
    cut = np.array([row for row, count in source.fields.items()
                    if count < needed or (count == needed and lengths[count] == 1)], dtype=int)
    short = [row for row in source.fields if row not in set(cut.tolist())]
    if short:
        last = min(source.fields[row] for row in short)
        source = replace(source, notes=(
            *source.notes, f"{counted(len(short), 'row')} without the last cells (from "
                           f"{header[last]} on), the first is {source.where(short[0])}"))
    if not len(cut):
        return source
    first, count = int(cut[0]), source.fields[int(cut[0])]
    bad_rows = source.bad_rows
    if are_few(len(cut), len(source)):
        reason = "row was cut off"
    elif all(bad_rows.add(source.where(row), "", f"{source.fields[row]} fields", "was cut off")
             for row in cut):
        reason = "bad row"
    else:
        more = f" ({len(cut)} such rows)" * (len(cut) > 1)
        raise BadInput(f"{source.path}: {source.where(first)} has {count} fields, the header has "
                       f"{len(header)}{more}; the last that is needed is {header[needed - 1]}"
                       f"{bad_rows.hint(len(cut))}")
    whole = source.select(~source.table.index.isin(cut))
    return replace(whole, left_out=(*source.left_out, (reason, len(cut), source.where(first))))


def _file_links(source: Source, settings: Settings, tally: Tally, problems: Problems,
              name: str) -> tuple[pd.DataFrame, int]:
    """Return the links of a file and its readings per row; count repeated and unselected rows."""
    unique, repeated = without_repetition(source)
    chosen, others = _selected_rows(unique, settings)
    links, per_row = build_links(chosen, settings, tally, problems, name)
    for index, reason, column in ((repeated, "repeats an earlier row exactly", ""), *others):
        tally.count(reason, column, len(index) * per_row,
                    source.where(index[0]) if len(index) else "")
    return links, per_row


def _selected_rows(source: Source, settings: Settings
                   ) -> tuple[Source, list[tuple[list[int], str, str]]]:
    """Select rows by the setting `only`: column -> values; return also why others are left out."""
    left_out = []
    for spec, values in settings.only.items():
        texts = [value for value in values if isinstance(value, str)]
        numbers = [value for value in values if not isinstance(value, str)]
        cells = as_text(source.cells(spec, "only"))
        bad = ~cells.isin(texts).to_numpy(dtype=bool)
        if numbers:  # 868.1 is 868.10, too
            bad &= ~np.isin(as_numbers(cells), numbers)
        left_out.append((list(source.table.index[bad]), "is not one of only", spec))
        if bad.all():
            allowed = sorted({str(value).removesuffix(".0") for value in numbers} | set(texts))
            raise BadInput(f"{source.path}: column {spec} never is {' or '.join(allowed)} "
                           f"(only); it is {', '.join(sorted(set(cells))[:20])}")
        source = source.select(~bad)
    return source, left_out


def _without_copies(source: Source, links: pd.DataFrame, starts: list[int],
                    tally: Tally) -> pd.DataFrame:
    """Drop readings with a time that equal a reading of an earlier file in all but the flight."""
    if "time_s" not in links:
        return links
    file = np.searchsorted(starts, links.index.to_numpy(), side="right")
    columns = [name for name in links if name != "flight"]
    reading = links.groupby(columns, sort=False, dropna=False).ngroup().to_numpy()
    _, first, number = np.unique(reading, return_index=True, return_inverse=True)
    copies = (file != file[first[number]]) & np.isfinite(links["time_s"].to_numpy())
    return tally.drop(links, copies, "repeats a reading of another file", "", source.where)
