"""All files of an import, each by its own format, as links."""

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.budgets import ROWS
from radiotwin.cells import as_numbers, listed
from radiotwin.errors import BadInput
from radiotwin.importing.formats import FORMATS, expected, find_format, format_named
from radiotwin.importing.levels import LEVEL_COLUMN
from radiotwin.importing.links import build_links, naming_notes
from radiotwin.importing.log_files import LogFile, flight_names
from radiotwin.importing.problems import Problems
from radiotwin.importing.read_source import read_source
from radiotwin.importing.repetition import without_repetition
from radiotwin.importing.settings import BY_FILE, Settings
from radiotwin.importing.settings_file import merged
from radiotwin.importing.source import Source, as_text, columns_of
from radiotwin.importing.tally import Tally


@dataclass(frozen=True)
class Logs:
    """The links of all files.

    Attributes:
        source: all files, for messages only.
        links: as of `build_links`, one after the other.
        level_column: of `measurements.csv`.
        rows: of all files.
        readings: in these rows.
        files: name, rows, readings and format of each file, for the report.
        notes: on how files were read.
        format: of all files, or None.
    """

    source: Source
    links: pd.DataFrame
    level_column: str
    rows: int
    readings: int
    files: list[dict[str, Any]]
    notes: list[str]
    format: str | None


def read_logs(files: list[LogFile], settings: Settings, tally: Tally,
              on_progress: Callable[[str], None]) -> Logs:
    """Read files.

    Args:
        files: at least one.
        settings: of the import; what they do not say is from each file's format.
        tally: counts the readings that are left out.
        on_progress: called with the name of each step.

    Raises:
        BadInput: all that is wrong, with file, row and column.
    """
    problems = Problems()
    parts: list[pd.DataFrame] = []
    records: list[dict[str, Any]] = []
    wheres: list[tuple[int, Callable[[int], str]]] = []
    level_column = ""
    formats, notes = set(), []
    rows = 0
    may_be = expected([format_named(settings.format)] if settings.format else FORMATS,
                      _declared_columns(settings))
    by_default = BY_FILE if len(files) > 1 else "always flight"
    for file, name in zip(files, flight_names(files)):
        on_progress(f"reading {file.name}" if len(files) > 1 else "reading")
        with problems.noted():
            source = read_source(file, settings, may_be)
            own, format_name, caution = _settings_of(source, settings, by_default)
            source = _numbered_from(source, rows, file.name if len(files) > 1 else "")
            wheres.append((rows, source.where))
            count = len(source)
            rows += count
            ROWS.check(rows, "all files")
            on_progress("links")
            links, per_row = _links_of(source, own, tally, problems, name)
            if not per_row:
                continue
            parts.append(links)
            formats.add(format_name)
            level_column = LEVEL_COLUMN[str(own.level_unit)]  # one for all files
            records.append({"file": file.name, "rows": count, "readings": count * per_row,
                            "format": format_name})
            notes += [*source.notes, *naming_notes(source, own),
                      *([f"{file.name}: {caution}"] if caution else [])]
    problems.check()
    links = parts[0] if len(parts) == 1 else pd.concat(parts)
    starts = [start for start, _ in wheres]

    def where(index: int) -> str:
        return wheres[bisect_right(starts, index) - 1][1](index)

    label = files[0] if len(files) == 1 else f"{len(files)} files"
    whole = Source(str(label), links.iloc[:0], where)
    if len(files) > 1:
        links = _without_copies(whole, links, starts, tally)
    return Logs(whole, links, level_column, rows,
                sum(record["readings"] for record in records), records,
                list(dict.fromkeys(notes)), formats.pop() if len(formats) == 1 else None)


def _declared_columns(settings: Settings) -> set[str]:
    """Return the columns that the mapping names, in lower case."""
    specs = settings.columns.model_dump(exclude_none=True).values()
    names = {name.lower() for spec in specs for name in columns_of(spec, ())}
    for block in settings.wide:
        names |= {each.lower() for each in
                  ([block.level] if isinstance(block.level, str) else block.level)
                  if "*" not in each}
    return names


def _settings_of(source: Source, settings: Settings,
                 flight: str) -> tuple[Settings, str | None, str]:
    """Return the settings for a file, with those of its format, its name and its caution."""
    header = list(map(str, source.table))
    found = None
    if settings.format:
        found = format_named(settings.format)
        if not found.fits(header):
            raise BadInput(f"{source.path} is not of format {found.name}, which has the columns "
                           f"{', '.join(found.signature)}; it has {listed(header)}")
    elif not settings.columns.level and not settings.wide:
        found = find_format(header)
    defaults: Mapping[str, Any] = {"columns": {"flight": flight}}
    if found is not None:
        defaults = {**found.settings, "columns": {"flight": flight, **found.mapping(header)}}
    own = merged(settings, defaults)
    own.require_columns(str(source.path), header)
    return own, found.name if found else None, found.caution if found else ""


def _numbered_from(source: Source, first: int, name: str) -> Source:
    """Return the same file with rows numbered from `first`, and its name in every place."""
    prefix = f"{name}: " * bool(name)
    own = source.where
    table = source.table.set_axis(pd.RangeIndex(first, first + len(source)))
    return Source(source.path, table, lambda index: f"{prefix}{own(index - first)}", source.notes)


def _links_of(source: Source, settings: Settings, tally: Tally, problems: Problems,
              name: str) -> tuple[pd.DataFrame, int]:
    """Return the links of a file and its readings per row; count what is left out."""
    whole, repeated = without_repetition(source)
    chosen, others = _only(whole, settings)
    links, per_row = build_links(chosen, settings, tally, problems, name)
    for index, reason, column in ((repeated, "repeats an earlier row exactly", ""), *others):
        tally.count(reason, column, len(index) * per_row,
                    source.where(index[0]) if len(index) else "")
    return links, per_row


def _only(source: Source, settings: Settings) -> tuple[Source, list[tuple[list[int], str, str]]]:
    """Return the chosen rows, and the indices, the reason and the column of the others."""
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
        source = Source(source.path, source.table[~bad], source.where, source.notes)
    return source, left_out


def _without_copies(source: Source, links: pd.DataFrame, starts: list[int],
                    tally: Tally) -> pd.DataFrame:
    """Remove readings that an earlier file has; without times, equal readings are no copies."""
    if "time_s" not in links:
        return links
    file = np.searchsorted(starts, links.index.to_numpy(), side="right")
    columns = [name for name in links if name != "flight"]
    reading = links.groupby(columns, sort=False, dropna=False).ngroup().to_numpy()
    _, first, number = np.unique(reading, return_index=True, return_inverse=True)
    copies = (file != file[first[number]]) & np.isfinite(links["time_s"].to_numpy())
    return tally.drop(links, copies, "repeats a reading of another file", "", source.where)
