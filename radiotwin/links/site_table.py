"""Read tables of sites: devices, receivers and transmitters, for every command.

A column is recognised by a usual name of its quantity and its unit at the end: `azimuth`, `Antenna
Height (ft)`. Unused columns are noted. A column whose name is nearly a known one is refused, since
dropping a quantity would give wrong physics. Implausible values are refused or noted.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput
from radiotwin.geo import between_frames, is_same_frame, to_local
from radiotwin.io.budgets import DEVICES, ROWS
from radiotwin.io.cells import as_numbers, as_text, cell_text, listed, refuse
from radiotwin.io.forms import Origin, name_fault
from radiotwin.links.plausible import (
    HEIGHTS_M,
    MAX_DEGREES,
    height_placeholders,
    high_notes,
    refuse_implausible,
    tilt_notes,
)

POSITION = ("latitude", "longitude", "altitude", "height", "x", "y", "z")
HEIGHTS = ("altitude", "height", "z", "above_ground_m")
METRES = {"m": 1.0, "ft": 0.3048}  # the international foot, exact since 1959
ERP_DB = 2.15  # EIRP minus ERP, which refers to a half-wave dipole (ITU-R V.573-6, A43)
MAX_TWICE_APART_M = 1.0  # between x, y and latitude, longitude of a site, rounded to 1e-5 degrees
_MIN_LETTERS, _LONG = 5, 9  # letters of a name in which one, or two, may be wrong

Convert = Callable[[np.ndarray], np.ndarray]


def _times(factor: float) -> Convert:
    return lambda values: values * factor


def _in_dbm(factor: float) -> Convert:
    def convert(values: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return 10 * np.log10(values * factor)
    return convert


_SAME = _times(1.0)
_DEGREES: Convert = np.degrees
_LENGTHS = {"m": _SAME, "meter": _SAME, "meters": _SAME, "metre": _SAME, "metres": _SAME,
            "ft": _times(METRES["ft"]), "feet": _times(METRES["ft"]), "foot": _times(METRES["ft"]),
            "km": _times(1e3), "cm": _times(1e-2), "mm": _times(1e-3)}
_ANGLES = {"": _SAME, "deg": _SAME, "degree": _SAME, "degrees": _SAME, "rad": _DEGREES,
           "radians": _DEGREES}
_LOSSES = {"": _SAME, "db": _SAME}
_POWERS = {"dbm": _SAME, "dbw": lambda values: values + 30.0, "mw": _in_dbm(1.0),
           "w": _in_dbm(1e3), "watt": _in_dbm(1e3), "watts": _in_dbm(1e3), "kw": _in_dbm(1e6)}
_FREQUENCIES = {"hz": _SAME, "khz": _times(1e3), "mhz": _times(1e6), "ghz": _times(1e9)}
_SHARES = {"": _SAME, "percent": _times(1e-2), "pct": _times(1e-2)}
_NO_UNIT = {"": _SAME}

_QUANTITIES: dict[str, tuple[Mapping[str, Convert], str]] = {
    "latitude": (_ANGLES, "latitude, lat, latitud, latitude dms, lat dms, latitude wgs84, "
                          "wgs84 latitude, lat wgs84, lat dd, gps latitude, gps lat, "
                          "decimal latitude, latitude decimal"),
    "longitude": (_ANGLES, "longitude, lon, long, lng, longitud, longitude dms, lon dms, long dms, "
                           "longitude wgs84, wgs84 longitude, "
                           "lon wgs84, long wgs84, lon dd, long dd, gps longitude, gps lon, "
                           "gps long, gps lng, decimal longitude, longitude decimal"),
    "x": (_LENGTHS, "x"), "y": (_LENGTHS, "y"), "z": (_LENGTHS, "z"),
    "height": (_LENGTHS, "height"),
    "altitude": (_LENGTHS, "altitude, alt, altitude amsl, alt amsl, altitude msl, alt msl, "
                           "altitude asl, alt asl, height amsl, height msl, amsl, msl, height asl, "
                           "asl, height above sea level, height above mean sea level, "
                           "above sea level, "
                           "antenna amsl, antenna altitude"),
    "above_ground_m": (_LENGTHS, "above ground, height above ground, height above ground level, "
                                 "agl, height agl, agl height, antenna agl, antenna height agl, "
                                 "antenna height, ant height, height of antenna, antenna hgt, "
                                 "antenna ht, ant ht, antenna height above ground, "
                                 "rad center, radiation center, rad centre, center line, "
                                 "centerline, mast height, tower height, structure height"),
    "tx_power_dbm": (_POWERS, "tx power, transmit power, transmitter power, transmitted power, "
                              "output power, power, tx pwr, ptx, power out"),
    "eirp_dbm": (_POWERS, "eirp, max eirp, erp, max erp"),
    "cable_loss_db": (_LOSSES, "cable loss, feeder loss, line loss, cable losses, feeder losses, "
                               "cable attenuation, feeder attenuation, feed loss"),
    "frequency_hz": (_FREQUENCIES, "frequency, freq, carrier frequency, center frequency, "
                                   "centre frequency, downlink frequency, dl frequency, dl freq, "
                                   "tx frequency, tx freq, transmit frequency, frecuencia, "
                                   "frequenz"),
    "azimuth_deg": (_ANGLES, "azimuth, azi, az, azimut, antenna azimuth, bearing, boresight, "
                             "orientation, antenna direction, direction, antenna bearing, "
                             "pointing direction, heading"),
    "tilt_deg": (_ANGLES, "tilt, antenna tilt, total tilt, downtilt, total downtilt, "
                          "antenna downtilt, mechanical tilt, mechanical downtilt, mech tilt, "
                          "tilt mech, tilt mechanical, mtilt, dtilt"),
    "load": (_SHARES, "load, duty cycle"),
    "antenna": (_NO_UNIT, "antenna, antenna file, antenna pattern, pattern file"),
    "role": (_NO_UNIT, "role"), "reads_levels": (_NO_UNIT, "reads levels"),
    "since": (_NO_UNIT, "since"), "until": (_NO_UNIT, "until")}
"""Quantity -> its units, and its column names in order of preference."""
_TEXTS = ("antenna", "role", "since", "until")
_DOWNTILTS = ("downtilt", "mechanicaltilt", "mechtilt", "tiltmech", "tiltmechanical", "mtilt",
              "dtilt")
"""Column names of tilts that are positive downwards, as in planning programs."""
_ENDS = ("device", "site", "cell", "sector", "antenna", "ant", "tx", "transmitter", "gateway",
         "station", "bs", "node", "receiver", "rx")
"""Prefixes of column names of positions, directions and frequencies, `_OF_ENDS`."""
_OF_ENDS = ("latitude", "longitude", "x", "y", "z", "height", "altitude", "azimuth_deg", "tilt_deg",
            "frequency_hz")
_UNUSED = {"electricaltilt": "it is in the pattern of the antenna",
           "electricaldowntilt": "it is in the pattern of the antenna",
           "etilt": "it is in the pattern of the antenna",
           "tiltel": "it is in the pattern of the antenna",
           "gain": "give an EIRP, or the pattern of the antenna",
           "antennagain": "give an EIRP, or the pattern of the antenna",
           "groundelevation": "of the ground", "siteelevation": "of the ground"}
"""Names of columns that a user may expect to be used -> why they are not."""
_ANY_NAME = ("name, id, label, site, site id, site name, station, station id, station name, node, "
             "node id")
_NAMES = {
    "device": "device, device id, cell, cell id, cell name, sector, sector id, sector name, "
              "transmitter, transmitter id, transmitter name, gateway, gateway id, gtw id, "
              "gateway eui, eui, tx, "
              f"base station, bs, enb, gnb, beacon, bssid, {_ANY_NAME}",
    "receiver": f"receiver, receiver id, receiver name, rx, sensor, sensor id, probe, {_ANY_NAME}"}
_IN_PARTS = re.compile(r"(lat|lon|long|latitude|longitude)(min|minute|minutes|sec|second|seconds)")
_DMS = re.compile(
    r"""([NSEW]?)\s*([-+]?\d+(?:\.\d+)?)(?:[°º:\sD]\s*(?:(\d+(?:\.\d+)?)['′’:\sM]?\s*"""
    r"""(?:(\d+(?:\.\d+)?)(?:["″”S]|'')?\s*)?)?)?([NSEW]?)""")
_DMS_CHARACTERS = 40
_UNIT_AND_ZERO = re.compile(r"[\s_([]+(m|ft|feet|met(?:re|er)s?)[\s_]+"
                            r"(a\.?g\.?l|a?m?\.?s\.?l)\.?[)\]]?$")  # `Height (ft AGL)`
_WITH_UNIT = re.compile(r"([-+]?\d+(?:\.\d+)?)\s*([A-Za-z]+|['′°%])\.?")
_UNIT_SIGNS = {"'": "ft", "′": "ft", "°": "deg", "%": "percent"}
_PROJECTED = {"x": "easting, utm x, utm easting, utm e",
              "y": "northing, utm y, utm northing, utm n"}


def _plain(name: str) -> str:
    """Return a column name in lower case without separators, with its unit at the end."""
    name = _UNIT_AND_ZERO.sub(r" \2\1", name.casefold())
    return re.sub(r"[\W_]+", "", name)


def _words(names: str) -> list[str]:
    return [_plain(name) for name in names.split(",")]


@dataclass(frozen=True)
class _Known:
    """Meaning of a column name: quantity, preference (0 is best), and conversion of its unit."""

    quantity: str
    rank: int
    convert: Convert | None


@cache
def _known_names(projected: bool) -> dict[str, _Known]:
    """Return the known column names of a table of sites, each with its quantity and unit.

    With `projected`, names of projected coordinates such as `easting` are included.
    """
    found: dict[str, _Known] = {}

    def add(quantity: str, words: Sequence[str]) -> None:
        for rank, word in enumerate(words):
            adjust = (lambda values: values + ERP_DB) if "erp" in word else \
                np.negative if word.endswith(_DOWNTILTS) else None
            for unit, convert in {"": None, **_QUANTITIES[quantity][0]}.items():
                if convert is not None and adjust is not None:
                    convert = _then(convert, adjust)
                found.setdefault(word + unit, _Known(quantity, rank, convert))

    for quantity, (_, names) in _QUANTITIES.items():
        add(quantity, _words(names))
    for quantity in _PROJECTED if projected else ():
        add(quantity, _words(_PROJECTED[quantity]))
    for quantity in _OF_ENDS:
        names = _QUANTITIES[quantity][1]
        add(quantity, [end + word for word in _words(names) for end in _ENDS])
    return found


def _then(first: Convert, second: Convert) -> Convert:
    return lambda values: second(first(values))


def misspelt(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that a name misspells by one letter (two in a long one), else None.

    Digits must be equal. Names are in the form of `_plain`.
    """
    if len(name) < _MIN_LETTERS:
        return None
    for other in known:
        max_edits = 2 if min(len(name), len(other)) >= _LONG else 1
        if (len(other) >= _MIN_LETTERS and abs(len(name) - len(other)) <= max_edits
                and len(set(name) ^ set(other)) <= 2 * max_edits
                and re.sub(r"\D", "", name) == re.sub(r"\D", "", other)
                and _edits(name, other) <= max_edits):
            return other
    return None


def _edits(one: str, other: str) -> int:
    """Count the letters added, dropped, replaced or swapped between two words (Damerau 1964)."""
    before: list[int] = []
    last, row = before, list(range(len(other) + 1))
    for i, letter in enumerate(one, start=1):
        before, last, row = last, row, [i]
        for j, to in enumerate(other, start=1):
            row.append(min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (letter != to)))
            if i > 1 and j > 1 and letter == other[j - 2] and one[i - 2] == to:
                row[j] = min(row[j], before[j - 2] + 1)
    return row[-1]


@dataclass(frozen=True, eq=False)
class SiteTable:
    """k sites of a table, one a row.

    Attributes:
        path: of the file, for messages.
        names: (k,) names of the sites; indexed like the cells.
        values: one column per quantity, in degrees, metres and the units of `devices.csv`; NaN or
            `""`: empty. x and y of a projected system stay in its unit.
        columns: quantity -> column of the file; `device` or `receiver` -> the column of names.
        cells: of the file, without blank rows.
        where: index of a row -> `row 7`, as in the file.
        notes: on unused columns and implausible values.
    """

    path: Path | str
    names: pd.Series
    values: pd.DataFrame
    columns: dict[str, str]
    cells: pd.DataFrame
    where: Callable[[int], str]
    notes: tuple[str, ...] = ()

    def refuse(self, quantity: str, bad: ArrayLike, reason: str) -> None:
        """Raise BadInput about the first bad cell of a quantity, if the mask (k,) has any."""
        _refuse(self, self.columns[quantity], bad, reason)

    def refuse_rows(self, bad: ArrayLike, reason: Callable[[int], str]) -> None:
        """Raise BadInput about the first bad row of a mask (k,); `reason` takes its position."""
        rows = np.flatnonzero(bad)
        if len(rows):
            first = int(rows[0])
            raise BadInput(f"{self.path}: {self.where(self.names.index[first])}: {reason(first)}"
                           + (f" ({len(rows)} such rows)" if len(rows) > 1 else ""))

    def local_m(self, origin: Origin | None, own: Origin | None, what: str) -> np.ndarray:
        """Return positions (k, 3) [m] in a local frame; NaN: unknown, or z is above the ground.

        The frame is about `origin`, and `what` has it; x and y are about `own`, None: the same.
        BadInput for latitudes without an origin, or x, y that contradict latitude and longitude.
        """
        if "latitude" in self.values and origin is None and "x" not in self.values:
            raise BadInput(f"{self.path}: latitude and longitude need the origin of the frame of "
                           f"{what}, which is not known; give x_m and y_m, or add its [origin]")
        on_globe_m = local_positions(self.values.drop(columns=["x", "y"], errors="ignore"), origin)
        if "x" not in self.values:
            return on_globe_m
        position_m = local_positions(self.values, None)
        position_m[:, 2] = on_globe_m[:, 2]  # of an altitude, above the origin
        if own is not None and origin is not None and not is_same_frame(own, origin):
            position_m = between_frames(position_m, own, origin)
        apart_m = np.linalg.norm(position_m[:, :2] - on_globe_m[:, :2], axis=1)
        self.refuse_rows(apart_m > MAX_TWICE_APART_M, lambda row: (
            f"x, y = {position_m[row, 0]:g}, {position_m[row, 1]:g} is {apart_m[row]:,.0f} m from "
            f"its latitude and longitude about {what}'s origin; leave out the wrong two columns"))
        return position_m


def _refuse(table: SiteTable, column: str, bad: ArrayLike, reason: str) -> None:
    """Raise BadInput about the first bad cell of a column, if the mask (k,) has any."""
    cells = table.cells[column]
    refuse(table.path, column, as_text(cells), bad, reason,
           lambda row: table.where(cells.index[row]))


def read_site_table(path: Path | str, cells: pd.DataFrame, where: Callable[[int], str],
                    end: str | None, uses: Collection[str] = (), length_unit: str | None = None,
                    crs: bool = False, prefers_globe: bool = False,
                    names: Collection[str] = ()) -> SiteTable:
    """Read the cells of a table of sites.

    Args:
        path: of the file, for messages.
        cells: of the file: texts, or typed columns.
        where: index of a row -> its place in the file, for messages.
        end: kind of the sites, `device` or `receiver`; None: points without names.
        uses: quantities that the command uses besides positions.
        length_unit: of length columns whose name has no unit. `""`: such a column is refused, with
            advice to give the setting; None: refused without, as the command has no such setting.
        crs: whether x and y are of a projected system, in its unit.
        prefers_globe: ignore x and y if latitude and longitude are given.
        names: expected names; they decide between several columns of names.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used, or a column
            whose name is nearly a known one.
    """
    if cells.empty:
        raise BadInput(f"{path}: has no rows; it needs one for each {end or 'point'}")
    (ROWS if end is None else DEVICES).check(len(cells), path)
    header = list(map(str, cells.columns))
    columns, unused = _columns(path, header, crs)
    if {"latitude", "x"} <= columns.keys() and (crs or prefers_globe):
        for quantity in ("latitude", "longitude") if crs else ("x", "y"):
            if quantity in columns:
                unused[columns.pop(quantity)] = "the position is known already"
    key = None
    if end is not None:
        key, others = _name_column(path, cells, end, names, set(columns.values()))
        unused = {name: why for name, why in unused.items() if name != key} | others
        cells = _without_blank_rows(cells, key)
    used = {*POSITION, "above_ground_m", *uses}
    unused |= {name: "not used here" for quantity, name in columns.items() if quantity not in used}
    columns = {quantity: name for quantity, name in columns.items() if quantity in used}
    for name in filter(None, (key, *columns.values())):
        if cells[name].dtype == object and cells[name].map(
                lambda cell: isinstance(cell, (list, dict, tuple, np.ndarray))).any():
            raise BadInput(f"{path}: column {name} holds lists or records; it needs one value in "
                           "each row")
    text = pd.Series(cells.index, cells.index) if key is None else cells[key]
    text = text if isinstance(text.dtype, pd.StringDtype) else as_text(text)
    text = text.fillna("").str.strip()
    table = SiteTable(path, text, pd.DataFrame(index=cells.index), columns, cells, where)
    if key is not None:
        for name in text.unique():
            if fault := name_fault(name):
                _refuse(table, key, text == name, fault)
    known = _known_names(crs)
    values = {quantity: as_text(cells[name]) if quantity in _TEXTS else
              _numbers(table, quantity, known[_plain(name)].convert, length_unit, crs)
              for quantity, name in columns.items()}
    table = replace(table, values=pd.DataFrame(values, index=cells.index))
    _check_positions(table)
    if end is not None and key is not None:
        table.columns[end] = key
    return replace(table, notes=(*_unused_note(path, unused), *_implausible(table)))


def is_site_table(header: Iterable[str]) -> bool:
    """Return whether columns of these names hold positions."""
    known = _known_names(True)
    given = {known[_plain(str(name))].quantity for name in header if _plain(str(name)) in known}
    return {"latitude", "longitude"} <= given or {"x", "y"} <= given


def unused_columns(path: Path | str, header: Iterable[str], used: Collection[str],
                   known: Collection[str]) -> list[str]:
    """Note the columns of a table that are not used, where the names of columns are fixed.

    Raises:
        BadInput: an unused column is nearly a known name that the table lacks.
    """
    unused = {name: "" for name in header if name not in used}
    plain = {_plain(name): name for name in known if name not in used}
    for name in unused:
        near = _plain(name) if _plain(name) in plain else misspelt(_plain(name), plain)
        if near:
            raise BadInput(f"{path}: column {cell_text(name)} is nearly {plain[near]!r}; correct "
                           "its name, or leave the column out")
    return _unused_note(path, unused)


def _unused_note(path: Path | str, unused: Mapping[str, str]) -> list[str]:
    """Make a note of unused columns (name -> reason, or `""`); no note if there are none."""
    if not unused:
        return []
    reasons = {name: why or next((why for word, why in _UNUSED.items() if re.fullmatch(
        f"{word}(deg|dbi?|dbd|m|ft)?", _plain(name))), "") for name, why in unused.items()}
    columns = listed(f"{name or 'one without a name'}" + f" ({why})" * bool(why)
                     for name, why in reasons.items())
    return [f"{Path(path).name}: column{'s' * (len(unused) > 1)} not used: {columns}"]


def _columns(path: Path | str, header: Sequence[str],
             crs: bool) -> tuple[dict[str, str], dict[str, str]]:
    """Assign columns to quantities by their names; return also unused columns -> reason or `""`."""
    known = _known_names(crs)
    by_rank = sorted((name for name in header if _plain(name) in known),
                     key=lambda name: known[_plain(name)].rank)
    found: dict[str, str] = {}
    unused = dict.fromkeys(header, "")
    for name in by_rank:
        quantity = known[_plain(name)].quantity
        if quantity in found:
            unused[name] = f"{found[quantity]} says it"
        else:
            found[quantity] = name
            del unused[name]
    keys = {word for names in _NAMES.values() for word in _words(names)}
    for name in unused:
        plain = _plain(name)
        if _IN_PARTS.fullmatch(plain):
            raise BadInput(f"{path}: column {cell_text(name)} is a part of an angle; give latitude "
                           "and longitude in decimal degrees, in one column each")
        near = misspelt(plain, known)
        if plain not in known and plain not in keys and near \
                and known[near].quantity not in found:
            raise BadInput(f"{path}: column {cell_text(name)} is nearly a name of "
                           f"{known[near].quantity}; correct its name, or leave the column out. "
                           f"The table has {listed(header)}")
    return found, unused


def _name_column(path: Path | str, cells: pd.DataFrame, end: str, names: Collection[str],
                 used: set[str]) -> tuple[str, dict[str, str]]:
    """Return the column of names (`end`, or with most of `names`), and others -> why not used."""
    words = _words(_NAMES[end])
    found = sorted((name for name in map(str, cells)
                    if _plain(name) in words and name not in used),
                   key=lambda name: words.index(_plain(name)))
    if not found:
        raise BadInput(f"{path}: column {end!r} is missing: which one has the names of the {end}s? "
                       f"It has {listed(cells)}; a table without a header needs one")
    if len(found) > 1 and names and found[0] != end:
        found.sort(key=lambda name: -as_text(cells[name]).isin(set(names)).sum())
    return found[0], {name: f"{found[0]} has the names" for name in found[1:]}


def _numbers(table: SiteTable, quantity: str, convert: Convert | None, length_unit: str | None,
             crs: bool) -> np.ndarray:
    """Convert cells of a quantity to numbers (k,) in its unit, NaN: empty; or raise BadInput."""
    name = table.columns[quantity]
    cells = table.cells[name]
    if cells.dtype.kind in "fiu":
        cells = cells.astype(float)
        text = pd.Series(np.where(cells.isna(), "", "a number"), cells.index)
        numbers = cells.to_numpy()
    else:
        text = as_text(cells)
        numbers = as_numbers(text)
    if quantity in MAX_DEGREES:
        for i in np.flatnonzero(np.isnan(numbers) & (text != "")):
            numbers[i] = dms_degrees(text.iloc[i], quantity)
    with_unit = np.isnan(numbers) & (text != "").to_numpy()
    by_cell = np.full(len(numbers), np.nan)
    for i in np.flatnonzero(with_unit):
        by_cell[i], numbers[i] = _number_with_unit(text.iloc[i], name, quantity, crs)
    _refuse(table, name, np.isnan(numbers) & np.isnan(by_cell) & (text != ""), "is not a number")
    _refuse(table, name, np.isinf(numbers), "is not finite")
    if convert is None and np.isnan(numbers).all() and with_unit.any():
        convert = _SAME  # each cell has its unit
    if convert is None:
        units = _QUANTITIES[quantity][0]
        if units is _LENGTHS and crs and quantity in "xy":
            convert = _SAME
        elif units is _LENGTHS and length_unit:
            convert = _LENGTHS[length_unit]
        elif units is _FREQUENCIES and np.nanmin(numbers, initial=np.inf) >= 1e6:
            convert = _SAME  # so many MHz are no radio
        else:
            given = numbers[np.isfinite(numbers)]
            span = f" from {given.min():g} to {given.max():g}" if len(given) else ""
            endings = " or ".join(f"{name}_{unit}" for unit in list(units)[:1] + [
                unit for unit in ("ft", "w", "mhz") if unit in units])
            raise BadInput(f"{table.path}: column {cell_text(name)}: the unit of its numbers{span} "
                           f"is not known; end its name in it: {endings}"
                           + (", or give length_unit" if units is _LENGTHS
                              and length_unit is not None else ""))
    numbers = np.where(np.isnan(by_cell), convert(numbers), by_cell)
    _refuse(table, name, np.isinf(numbers) | (np.isnan(numbers) & (text != "")),
            "is no power above zero")
    is_projected = crs and quantity in "xy"
    is_length = _QUANTITIES[quantity][0] is _LENGTHS and not is_projected
    refuse_implausible(partial(_refuse, table, name),
                  f"{quantity.removesuffix('_m')}_m" if is_length else quantity, numbers)
    if quantity in HEIGHTS:
        _refuse(table, name, height_placeholders(numbers), "is no height; allowed are "
                f"{HEIGHTS_M[0]:,.0f} to {HEIGHTS_M[1]:,.0f} m; leave the cell empty where it is "
                "not known")
    return numbers


def _number_with_unit(text: str, name: str, quantity: str, crs: bool) -> tuple[float, float]:
    """Read a cell with a unit, such as `30 m`, `100'`, `20 W`, in the quantity's unit; NaN if none.

    If the column's name has the same unit, the number as written is the second one instead.
    """
    found = _WITH_UNIT.fullmatch(text) if len(text) <= _DMS_CHARACTERS else None
    nothing = (np.nan, np.nan)
    if found is None or quantity in MAX_DEGREES or found[2] == "MW":  # mW, or megawatts?
        return nothing
    number, unit = float(found[1]), _UNIT_SIGNS.get(found[2], found[2].casefold())
    known, plain = _known_names(crs), _plain(name)
    column_unit = max((end for end in _QUANTITIES[quantity][0] if end and plain.endswith(end)
                       and plain.removesuffix(end) in known), key=len, default="")
    if column_unit:
        return (np.nan, number) if column_unit == unit else nothing
    convert = known[plain + unit].convert if plain + unit in known else None
    return nothing if convert is None else (float(convert(np.array([number]))[0]), np.nan)


def _without_blank_rows(cells: pd.DataFrame, key: str) -> pd.DataFrame:
    """Drop rows that are empty in all columns, also in that of the names, `key`."""
    nameless = cells[(as_text(cells[key]) == "").to_numpy()]
    if nameless.empty:
        return cells
    return cells.drop(index=nameless.index[(nameless.apply(as_text) == "").all(axis=1)])


def dms_degrees(text: str, quantity: str) -> float:
    """Convert an angle such as `48°06'12.5"N` to degrees; NaN if it is none."""
    found = _DMS.fullmatch(text.upper()) if len(text) <= _DMS_CHARACTERS else None
    if found is None:
        return np.nan
    before, *parts, after = found.groups()
    whole_deg, minutes, seconds = (float(part or 0) for part in parts)
    letter = before or after or ""
    letters = "NS" if quantity == "latitude" else "EW"
    if minutes >= 60 or seconds >= 60 or (before and after) or letter not in ("", *letters):
        return np.nan
    sign = -1.0 if letter == letters[1] or parts[0].startswith("-") else 1.0
    return sign * (abs(whole_deg) + minutes / 60 + seconds / 3600)


def _check_positions(table: SiteTable) -> None:
    """Raise BadInput without columns of positions, or for a row of two heights or bad degrees."""
    given = table.columns.keys()
    for pair in (("latitude", "longitude"), ("x", "y")):
        if len(given & set(pair)) == 1:
            raise BadInput(f"{table.path}: {pair[0]} and {pair[1]} are given together or not at "
                           f"all; it has {listed(table.cells)}")
    if not {"latitude", "x"} & given:
        raise BadInput(f"{table.path}: there is no position; columns latitude, longitude or x, y "
                       f"are needed, the table has {listed(table.cells)}")
    heights = {name: table.columns[name] for name in HEIGHTS if name in given}
    table.refuse_rows(table.values[list(heights)].notna().sum(axis=1) > 1, lambda row: (
        f"{table.names.iloc[row]!r} has several heights, {' and '.join(heights.values())}; leave "
        "one empty, or a column out"))
    for name, limit in MAX_DEGREES.items():
        if name not in given:
            continue
        bad = table.values[name].abs() > limit
        hint = ""
        if name == "latitude" and (table.values["longitude"].abs() <= limit).all():
            hint = "; are latitude and longitude swapped?"
        table.refuse(name, bad, f"is no {name}; allowed are -{limit:g} to {limit:g} degrees{hint}")


def _implausible(table: SiteTable) -> list[str]:
    """Note implausible tilts and heights above the ground."""
    notes = []
    if "tilt_deg" in table.values:
        notes += tilt_notes(table.values["tilt_deg"].to_numpy())
    if "above_ground_m" in table.values:
        notes += high_notes(table.values["above_ground_m"].to_numpy())
    return [f"{Path(table.path).name}: {note}" for note in notes]


def local_positions(values: pd.DataFrame, origin: Origin | None) -> np.ndarray:
    """Convert columns of `POSITION` [deg, m] to x, y, z (k, 3) [m] about an origin.

    NaN is unknown. Without an origin, latitude and longitude are ignored, and altitudes are z.
    """
    places_m = np.full((len(values), 3), np.nan)
    for axis, name in enumerate("xy"):
        if name in values:
            places_m[:, axis] = values[name]
    ground_m = 0.0 if origin is None else origin.altitude_m
    for name, zero_m in (("altitude", ground_m), ("z", 0.0), ("height", 0.0)):
        if name in values:  # the last one counts
            height_m = values[name].to_numpy(dtype=float) - zero_m
            known = ~np.isnan(height_m)
            places_m[known, 2] = height_m[known]
    if origin is not None and "latitude" in values:
        known = values[["latitude", "longitude"]].notna().all(axis=1).to_numpy()
        places_m[known, 0], places_m[known, 1] = to_local(
            origin, values["longitude"][known], values["latitude"][known])
    return places_m
