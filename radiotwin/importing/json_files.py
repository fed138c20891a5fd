"""Read tables from JSON: a row for each record, or for each object of its list of receptions.

Records are objects: one per line, one after the other over several lines, in an array, or features
of GeoJSON (RFC 7946; RFC 8142 has one per line). Nested values become columns with dots in their
names. Tables of pandas, with a list or an object for each column, are read as well.
"""

import io
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo import ALLOWED, reference_system
from radiotwin.importing.log_files import HEAD_BYTES, Lines, LogFile
from radiotwin.importing.source import BadRows, Source
from radiotwin.io.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, NESTING, ROWS
from radiotwin.io.cells import cell_text, listed
from radiotwin.io.inputs import parse_json

_MAX_NUMBERED = 16  # longest list whose values become columns, such as coordinates
_PLACE = ("longitude", "latitude", "altitude")
BEFORE = "before"
"""Column of the text before the object of a line, such as a topic of MQTT."""
_SEPARATOR = "\x1e"  # before each record of RFC 8142


class _Table:
    """Collects the rows of records; for its arguments see `read_json_log`."""

    def __init__(self, file: LogFile, used: Collection[str], chosen: str | None,
                 crs: str | None) -> None:
        self._file, self._used, self._chosen = file, used, chosen
        self.crs = crs
        self.rows: list[dict[str, str]] = []
        self.numbers: list[int] = []  # of the records
        self._columns: dict[str, None] = {}  # in the order of their first use
        self._cells = 0
        self._is_rows: dict[str, bool] = {}  # of each list by name
        self._without: list[int] = []  # rows of records without such a list
        self.unread = Counter[str]()

    def add(self, record: dict[str, Any], number: int, where: str) -> None:
        """Add the rows of a record, number `number` of its file; BadInput if they are too many."""
        if record.get("type") == "Feature" and "geometry" in record:
            record = _point_record(record, where)
        for row, is_reception in self._rows(record, ""):
            if not is_reception:
                self._without.append(len(self.rows))
            self.rows.append(row)
            self.numbers.append(number)
            self._columns |= dict.fromkeys(row)
            self._cells += len(row)
            # After each row: one record may have many.
            COLUMNS.check(len(self._columns), self._file)
            ROWS.check(len(self.rows), self._file)
            CELLS.check(len(self.rows) * len(self._columns), self._file)
            DOCUMENT_BYTES.check(10 * self._cells, self._file)  # each is an object in memory

    def source(self, where: Callable[[int], str],
               bad: list[tuple[str, int, str]]) -> Source:
        """Return all rows; if some records have lists of receptions, those without are left out."""
        lists = tuple(f"{name}." for name, is_rows in self._is_rows.items() if is_rows)
        others = {row for row in self._without if lists
                  and not any(name.startswith(lists) for name in self.rows[row])}
        left_out = [("no reception: a record without " + " or ".join(each[:-1] for each in lists),
                     len(others), where(self.numbers[min(others)]))] if others else []
        left_out += bad
        kept = [row for row in range(len(self.rows)) if row not in others]
        table = pd.DataFrame({name: pd.Series([self.rows[row].get(name, "") for row in kept],
                                              dtype=str) for name in self._columns})
        numbers = np.array([self.numbers[row] for row in kept], dtype=np.int64)
        notes: tuple[str, ...] = ()
        if self.unread:
            lists_text = listed(f"{name} ({number} values)"
                                for name, number in self.unread.items())
            notes = (f"{self._file.name}: lists that are not read: {lists_text}; name a column of "
                     "one, or --list, to have a row for each of its objects",)
        if self.crs is not None and set(_PLACE[:2]) <= set(table):
            table = table.assign(**_to_degrees(self._file, table, self.crs))
        return Source(str(self._file), table, lambda index: where(int(numbers[index])), notes,
                      left_out=tuple(left_out))

    def _rows(self, value: dict[str, Any], prefix: str) -> Iterator[tuple[dict[str, str], bool]]:
        """Yield a row for each object in a record's lists, and True; or one row, and False."""
        flat: dict[str, str] = {}
        receptions: list[tuple[str, list[Any]]] = []
        self._flatten(value, prefix, flat, receptions)
        if not receptions:
            yield flat, False
        for name, items in receptions:
            for item in items:
                for reception, _ in self._rows(item, f"{name}."):
                    yield flat | reception, True

    def _flatten(self, value: dict[str, Any], prefix: str, flat: dict[str, str],
                 receptions: list[tuple[str, list[Any]]]) -> None:
        """Add nested values to `flat` as `a.b`, and lists of objects to `receptions`, in place."""
        for key, item in value.items():
            name = f"{prefix}{key}"
            if isinstance(item, dict):
                self._flatten(item, f"{name}.", flat, receptions)
            elif isinstance(item, list):
                self._add_list(name, item, flat, receptions)
            elif item is not None:
                flat[name] = str(item)

    def _add_list(self, name: str, items: list[Any], flat: dict[str, str],
                  receptions: list[tuple[str, list[Any]]]) -> None:
        """Add a list to `receptions` if of objects, to `flat` if short; else count it as unread."""
        if items and all(isinstance(each, dict) for each in items):
            if name not in self._is_rows:
                begin = f"{name.lower()}."
                self._is_rows[name] = (
                    self._chosen in (name, name.rpartition(".")[2]) if self._chosen else
                    not self._used or any(each.startswith(begin) for each in self._used))
            if self._is_rows[name]:
                receptions.append((name, items))
                return
        elif len(items) <= _MAX_NUMBERED and not any(isinstance(each, (dict, list))
                                                     for each in items):
            flat |= {f"{name}.{i}": str(each) for i, each in enumerate(items) if each is not None}
            return
        self.unread[name] += len(items)


def starts_json(line: str) -> bool:
    """Return whether a file's first line is JSON, or an object after some words (MQTT clients)."""
    if re.match("\x1e?{|\\[ *({|$)", line):
        return True
    before, brace, _ = line.partition("{")
    if not brace or not line.endswith("}") or not before.endswith(" ") or "," in before:
        return False
    try:
        return isinstance(json.loads(brace + line.partition("{")[2]), dict)
    except (ValueError, RecursionError):
        return False


def read_json_log(file: LogFile, declared: Collection[str], may_be: Collection[str],
                  chosen: str | None, crs: str | None, bad_rows: BadRows) -> Source:
    """Read the records of a JSON document, or of JSON lines.

    Args:
        file: `.json`, `.jsonl`, `.geojson` or a text.
        declared: needed columns, in lower case.
        may_be: columns of known formats. The objects of a list become rows if one of these or of
            the declared columns is in it. If columns are missing, or none are given, the objects of
            all lists become rows, so that a message can name their columns.
        chosen: name, or end of the name, of the only list whose objects become rows; None: see
            above.
        crs: reference system of the coordinates of features, if the file declares none.
        bad_rows: where lines that are no JSON are noted.

    Returns:
        the cells as texts, `""` for null, a missing value, and a list that is not read.

    Raises:
        BadInput: no JSON, no records, or features that are no points.
    """
    found = _read(file, {*declared, *may_be}, chosen, crs, bad_rows)
    columns = {name.lower() for name in found.table}
    known = declared or {name for name in may_be if name in columns and "." in name}
    if chosen is None and found.notes and not (known and set(known) <= columns):
        return _read(file, (), None, crs, bad_rows)
    return found


def _read(file: LogFile, used: Collection[str], chosen: str | None, crs: str | None,
          bad_rows: BadRows) -> Source:
    """Read the records of a file once, see `read_json_log`."""
    table = _Table(file, used, chosen, crs)
    try:
        if _has_lines(file):
            left_out = _add_lines(file, table, bad_rows)
            return table.source(lambda number: f"line {number}", left_out)
        is_map, left_out = _add_document(file, table, bad_rows)
    except UnicodeDecodeError:
        raise BadInput(f"{file} is not text in UTF-8; save it as UTF-8") from None
    noun = "feature" if is_map else "record"
    return table.source(lambda number: f"{noun} {number}", left_out)


def _has_lines(file: LogFile) -> bool:
    """Return whether a file has JSON lines: its first line is a complete object."""
    with file.open() as content:
        head = content.read(HEAD_BYTES).decode("utf-8-sig", "replace")
    lines = [line for line in (each.strip().lstrip(_SEPARATOR).rstrip(",")
                               for each in head.splitlines()) if line]
    if lines and not lines[0].startswith(("{", "[")) and starts_json(lines[0]):
        return True
    return (len(lines) > 1 and lines[0].startswith("{") and lines[0].endswith("}")
            and "FeatureCollection" not in lines[0])


def _add_lines(file: LogFile, table: _Table,
               bad_rows: BadRows) -> list[tuple[str, int, str]]:
    """Add the records of JSON lines to a table; return reason, number and first of bad lines."""
    bad: list[int] = []
    cut: list[tuple[str, int, str]] = []
    with file.open() as content, io.TextIOWrapper(content, "utf-8", newline="") as text:
        lines = Lines(text, file)
        for line in lines:
            is_whole = line.endswith("\n")
            line = line.strip().lstrip(_SEPARATOR).rstrip(",")
            if not line:
                continue
            where = f"{file}: line {lines.number}"
            before, brace, _ = line.partition("{")
            before = before.strip() if brace and not before.startswith("[") else ""
            try:
                record = parse_json(line[len(before):], where, allow_nan=True)
                if not isinstance(record, dict):
                    raise BadInput(f"{where} is no JSON object; allowed is one object a line")
                if before:
                    record = {BEFORE: before} | record
            except BadInput as error:
                if bad_rows.limit >= 0 and not is_whole and not line.endswith("}"):  # the last one
                    cut = [("row was cut off", 1, f"line {lines.number}")]
                    continue
                if not bad_rows.add(f"{bad_rows.prefix}line {lines.number}", "", line[:80],
                                    "is no JSON object"):
                    raise BadInput(f"{error}{bad_rows.hint(1)}") from None
                bad.append(lines.number)
                continue
            table.add(record, lines.number, where)
    return [*cut, *([("bad row", len(bad), f"line {bad[0]}")] if bad else [])]


def _add_document(file: LogFile, table: _Table,
                  bad_rows: BadRows) -> tuple[bool, list[tuple[str, int, str]]]:
    """Add the records of JSON documents to a table; return whether they are features; bad ones."""
    is_map = False
    bad: list[tuple[str, int, str]] = []
    number = 0
    for value in _documents(file):
        if isinstance(value, dict) and value.get("type") == "FeatureCollection":
            features = value.get("features")
            if not isinstance(features, list):
                raise BadInput(f"{file} is a FeatureCollection without features; make it again")
            crs = str(value.get("crs") or "CRS84")
            if "name" in str(value.get("crs")) and not ("CRS84" in crs or "4326" in crs):
                table.crs = str((value["crs"].get("properties") or {}).get("name"))
            is_map, value = True, features
        elif isinstance(value, dict):
            value = _records_of_columns(value) or [value]
        elif (isinstance(value, list) and value and all(isinstance(row, list) for row in value)
              and all(isinstance(name, str) for name in value[0])):  # a header and rows
            value = [dict(zip(value[0], row)) for row in value[1:]]
        if not isinstance(value, list):
            raise BadInput(f"{file} is neither an object nor an array of objects; allowed are "
                           "records {\"rssi\": -80, …}, an array of them, and GeoJSON of points")
        ROWS.check(len(value), file)
        for record in value:
            number += 1
            noun = "feature" if is_map else "record"
            where = f"{file}: {noun} {number}"
            try:
                if not isinstance(record, dict):
                    raise BadInput(f"{where} is {cell_text(record)}; allowed are objects")
                row = _point_record(record, where) if is_map else record
            except BadInput as error:
                if not bad_rows.add(f"{bad_rows.prefix}{noun} {number}", "", record,
                                    "is no point" if is_map else "is no object"):
                    raise BadInput(f"{error}{bad_rows.hint(1)}") from None
                bad.append(("bad row", 1, f"{noun} {number}"))
                continue
            table.add(row, number, where)
    return is_map, bad


def _documents(file: LogFile) -> Iterator[Any]:
    """Yield the JSON documents of a text, which loggers append one after the other."""
    text = file.read_text(DOCUMENT_BYTES)
    decoder = json.JSONDecoder()
    at = 0
    while at < len(text):
        if text[at].isspace() or text[at] in ("," + _SEPARATOR):
            at += 1
            continue
        try:
            value, at = decoder.raw_decode(text, at)
        except RecursionError:
            NESTING.refuse(file, f"more than {NESTING.limit} levels of nesting")
        except ValueError as error:
            raise BadInput(f"{file} is not readable JSON ({error}); make or export it again"
                           ) from None
        yield value


def _records_of_columns(value: dict[str, Any]) -> list[dict[str, Any]] | None:
    """Convert an object that holds a table by columns to records; None if it is no such object.

    pandas writes `{"a": {"0": 1, "1": 2}}`, `{"a": [1, 2]}` and `{"columns": …, "data": …}`.
    """
    names, rows = value.get("columns"), value.get("data")
    if isinstance(names, list) and isinstance(rows, list):
        if all(isinstance(row, list) and len(row) == len(names) for row in rows):
            return [dict(zip(map(str, names), row)) for row in rows]
        return None
    columns = [list(each.values()) if isinstance(each, dict) else each for each in value.values()]
    keys = {tuple(each) if isinstance(each, dict) else (str(len(each)),)
            for each in value.values() if isinstance(each, (dict, list))}
    is_table = (len(keys) == 1 and all(isinstance(each, list) for each in columns)
                and all(key.isdigit() for key in next(iter(keys))))
    if not is_table or any(isinstance(cell, (dict, list)) for each in columns for cell in each):
        return None
    return [dict(zip(value, row)) for row in zip(*columns)]


def _point_record(feature: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the properties and coordinates of a GeoJSON feature (RFC 7946, 3.1.1)."""
    geometry = feature.get("geometry")
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    coordinates = geometry.get("coordinates") if geometry and kind == "Point" else None
    if (not isinstance(coordinates, list) or len(coordinates) not in (2, 3)
            or not all(type(value) in (int, float) for value in coordinates)):
        what = str(kind or "without a geometry")[:80]
        raise BadInput(f"{where} is {what}; allowed are points with two or three coordinates: "
                       "leave the others out")
    properties = feature.get("properties")
    return ((properties if isinstance(properties, dict) else {}) | dict(zip(_PLACE, coordinates)))


def _to_degrees(file: LogFile, table: pd.DataFrame, crs: str) -> dict[str, pd.Series]:
    """Convert coordinates of a reference system to longitude and latitude [deg], as texts."""
    from pyproj import Transformer
    from pyproj.exceptions import CRSError, ProjError

    x, y = (pd.to_numeric(table[name], errors="coerce").to_numpy() for name in _PLACE[:2])
    try:
        transformer = Transformer.from_crs(reference_system(crs), "EPSG:4326", always_xy=True)
        degrees = transformer.transform(x, y)
    except (CRSError, ProjError) as error:
        raise BadInput(f"{file}: its crs {cell_text(crs)} cannot be read ({error!s:.200}); declare "
                       f"{ALLOWED} by --crs, without that member of the file") from None
    return {name: pd.Series([repr(float(each)) if np.isfinite(each) else "" for each in values],
                            index=table.index, dtype=str)
            for name, values in zip(_PLACE, degrees)}
