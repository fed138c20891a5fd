"""One reader for all tables of sites: devices, receivers and transmitters, of every command.

A column is known by the usual names of its quantity, with its unit at the end: `azimuth`,
`Antenna Height (ft)`. What a command does not use is reported, and a column that is nearly a known
one is refused, as a quantity that is dropped is wrong physics. What cannot be meant, such as a
slipped decimal, is found here, for all commands.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.geo import between_frames, is_same_frame, to_local
from radiotwin.io.budgets import DEVICES
from radiotwin.io.cells import as_numbers, as_text, listed, refuse, shown
from radiotwin.io.forms import Origin, name_fault
from radiotwin.links.cell_limits import refuse_limits

POSITION = ("latitude", "longitude", "altitude", "height", "x", "y", "z")
HEIGHTS = ("altitude", "height", "z", "above_ground_m")
LIMITS_DEG = {"latitude": 90.0, "longitude": 360.0}
METRES = {"m": 1.0, "ft": 0.3048}  # the international foot, exact since 1959
FAR_M, MAX_APART_M = 100_000.0, 1e6  # from what is measured or mapped: odd, longer than any link
HIGH_M = 200.0  # above the ground: an altitude above the sea is suspected; masts are lower
ERP_DB = 2.15  # EIRP less ERP, which refers to a half-wave dipole (ITU-R V.573-6, A43)
_EARTH_M = 6_371_008.8  # mean radius (Moritz 2000, GRS80)
_NAMED = 5  # names in a message
_MIN_LETTERS, _LONG = 5, 9  # of a name of which one letter, or two, may be mistaken

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
    "latitude": (_ANGLES, "latitude, lat, latitud, latitude wgs84, wgs84 latitude, lat wgs84, "
                          "lat dd, gps latitude, gps lat, decimal latitude, latitude decimal"),
    "longitude": (_ANGLES, "longitude, lon, long, lng, longitud, longitude wgs84, wgs84 longitude, "
                           "lon wgs84, long wgs84, lon dd, long dd, gps longitude, gps lon, "
                           "gps long, gps lng, decimal longitude, longitude decimal"),
    "x": (_LENGTHS, "x"), "y": (_LENGTHS, "y"), "z": (_LENGTHS, "z"),
    "height": (_LENGTHS, "height"),
    "altitude": (_LENGTHS, "altitude, alt, altitude amsl, height amsl, amsl, height asl, asl, "
                           "height above sea level, height above mean sea level, above sea level, "
                           "antenna amsl, antenna altitude"),
    "above_ground_m": (_LENGTHS, "above ground, height above ground, height above ground level, "
                                 "agl, height agl, agl height, antenna agl, antenna height agl, "
                                 "antenna height, ant height, height of antenna, antenna hgt, "
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
                          "mtilt, dtilt"),
    "load": (_SHARES, "load, duty cycle"),
    "antenna": (_NO_UNIT, "antenna, antenna file, antenna pattern, pattern file"),
    "role": (_NO_UNIT, "role"), "reads_levels": (_NO_UNIT, "reads levels"),
    "since": (_NO_UNIT, "since"), "until": (_NO_UNIT, "until")}
"""Quantity -> units, and names in the order in which they count."""
_TEXTS = ("antenna", "role", "since", "until")
_TURNED = ("downtilt", "mechanicaltilt", "mechtilt", "mtilt", "dtilt")
"""Names of tilts that count downwards, as planning programs do."""
_ENDS = ("device", "site", "cell", "sector", "antenna", "ant", "tx", "transmitter", "gateway",
         "station", "bs", "node", "receiver", "rx")
"""What may stand before the name of a position or a direction."""
_OF_ENDS = ("latitude", "longitude", "x", "y", "z", "height", "altitude", "azimuth_deg",
            "frequency_hz")
_ANY_NAME = ("name, id, label, site, site id, site name, station, station id, station name, node, "
             "node id")
_NAMES = {
    "device": "device, device id, cell, cell id, cell name, sector, sector id, sector name, "
              "transmitter, transmitter id, transmitter name, gateway, gateway id, tx, "
              f"base station, bs, enb, gnb, beacon, bssid, {_ANY_NAME}",
    "receiver": f"receiver, receiver id, receiver name, rx, sensor, sensor id, probe, {_ANY_NAME}"}
_IN_PARTS = re.compile(r"(lat|lon|long|latitude|longitude)(min|minute|minutes|sec|second|seconds)")
_PROJECTED = {"x": "easting, utm x, utm easting, utm e",
              "y": "northing, utm y, utm northing, utm n"}


def _plain(name: str) -> str:
    """Return a name in lower case without what separates its words."""
    return re.sub(r"[\W_]+", "", name.casefold())


def _words(names: str) -> list[str]:
    return [_plain(name) for name in names.split(",")]


@dataclass(frozen=True)
class _Known:
    """What a name of a column stands for: a quantity, how much it comes first, and its unit."""

    quantity: str
    rank: int
    convert: Convert | None


@cache
def _known_names(projected: bool) -> dict[str, _Known]:
    """Return all names of columns; `convert` is None where a name needs a unit and has none."""
    found: dict[str, _Known] = {}

    def add(quantity: str, words: Sequence[str]) -> None:
        for rank, word in enumerate(words):
            turn = (lambda values: values + ERP_DB) if "erp" in word else \
                np.negative if word.endswith(_TURNED) else None
            for unit, convert in {"": None, **_QUANTITIES[quantity][0]}.items():
                if convert is not None and turn is not None:
                    convert = _then(convert, turn)
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
    """Return the known name that a name is nearly: one letter is wrong, or two of a long one.

    Digits count: `latitude2` is another column. Names are as of `_plain`.
    """
    if len(name) < _MIN_LETTERS:
        return None
    for other in known:
        most = 2 if min(len(name), len(other)) >= _LONG else 1
        if (len(other) >= _MIN_LETTERS and abs(len(name) - len(other)) <= most
                and len(set(name) ^ set(other)) <= 2 * most
                and re.sub(r"\D", "", name) == re.sub(r"\D", "", other)
                and _edits(name, other) <= most):
            return other
    return None


def _edits(one: str, other: str) -> int:
    """Return the fewest letters to add, drop, replace or swap with the next (Damerau 1964)."""
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
    """Sites of a table, one a row.

    Attributes:
        path: of the file, for messages.
        names: (k,) of the sites; its index is that of the cells.
        values: columns by quantity: degrees, metres and the units of `devices.csv`, NaN or `""`
            where empty; x and y of a projected system in its own unit.
        columns: quantity -> column of the file; the end, such as `device` -> that of the names.
        cells: of the file.
        where: row -> `row 7`, as the file's user counts.
        notes: on what was not used, and on what is probably not meant.
    """

    path: Path | str
    names: pd.Series
    values: pd.DataFrame
    columns: dict[str, str]
    cells: pd.DataFrame
    where: Callable[[int], str]
    notes: tuple[str, ...] = ()

    def refuse(self, quantity: str, bad: ArrayLike, reason: str) -> None:
        """Raise BadInput about the first bad cell (k,) of a quantity, if there is one."""
        name = self.columns[quantity]
        _refuse(self, name, bad, reason)

    def refuse_rows(self, bad: ArrayLike, reason: Callable[[int], str]) -> None:
        """Raise BadInput about the first bad row (k,); the reason is made of its number."""
        rows = np.flatnonzero(bad)
        if len(rows):
            first = int(rows[0])
            raise BadInput(f"{self.path}: {self.where(self.names.index[first])}: {reason(first)}"
                           + (f" ({len(rows)} such rows)" if len(rows) > 1 else ""))

    def local_m(self, origin: Origin | None, own: Origin | None, what: str) -> np.ndarray:
        """Return positions (k, 3) in a frame [m]; NaN where empty, or where z is above the ground.

        Args:
            origin: of that frame; None where it is not known.
            own: of the frame that x and y are in; None: the same.
            what: has that frame, for messages.

        Raises:
            BadInput: latitudes without an origin, or a site far outside the frame.
        """
        if "latitude" in self.values and origin is None:
            raise BadInput(f"{self.path}: latitude and longitude need the origin of the frame of "
                           f"{what}, which is not known; give x_m and y_m, or add its [origin]")
        position_m = local_positions(self.values, origin)
        if own is not None and origin is not None and not is_same_frame(own, origin) \
                and "x" in self.values:
            position_m = between_frames(position_m, own, origin)
        return position_m


def _refuse(table: SiteTable, column: str, bad: ArrayLike, reason: str) -> None:
    cells = table.cells[column]
    refuse(table.path, column, as_text(cells), bad, reason,
           lambda row: table.where(cells.index[row]))


def read_site_table(path: Path | str, cells: pd.DataFrame, where: Callable[[int], str], end: str,
                    uses: Collection[str], length_unit: str | None = None, crs: bool = False,
                    names: Collection[str] = ()) -> SiteTable:
    """Read the cells of a table of sites.

    Args:
        path: of the file, for messages.
        cells: of the file: texts, or typed columns.
        where: index of a row -> its place in the file.
        end: `device` or `receiver`: the column of the names.
        uses: other quantities than positions that the command uses.
        length_unit: of columns without one in their name; None: such are refused.
        crs: whether x and y are of a projected system, in its unit.
        names: that are expected; of several columns of names that with most of them counts.

    Raises:
        BadInput: names file, row and column of the first that cannot be used, or a column that is
            nearly a known one.
    """
    if cells.empty:
        raise BadInput(f"{path}: has no rows; it needs one for each {end}")
    DEVICES.check(len(cells), path)
    header = list(map(str, cells.columns))
    columns, unused = _columns(path, header, crs)
    key, others = _key(path, cells, end, names, set(columns.values()))
    unused = {name: why for name, why in unused.items() if name != key} | others
    used = {*POSITION, "above_ground_m", *uses}
    unused |= {name: "not used here" for quantity, name in columns.items() if quantity not in used}
    columns = {quantity: name for quantity, name in columns.items() if quantity in used}
    for name in (key, *columns.values()):
        if cells[name].map(lambda cell: isinstance(cell, (list, dict, tuple, np.ndarray))).any():
            raise BadInput(f"{path}: column {name} holds lists or records; it needs one value in "
                           "each row")
    text = cells[key] if isinstance(cells[key].dtype, pd.StringDtype) else as_text(cells[key])
    text = text.fillna("").str.strip()
    table = SiteTable(path, text, pd.DataFrame(index=cells.index), columns, cells, where)
    for name in text.unique():
        if fault := name_fault(name):
            _refuse(table, key, text == name, fault)
    known = _known_names(crs)
    values = {quantity: as_text(cells[name]) if quantity in _TEXTS else
              _numbers(table, quantity, known[_plain(name)].convert, length_unit, crs)
              for quantity, name in columns.items()}
    table = replace(table, values=pd.DataFrame(values, index=cells.index))
    _check_positions(table)
    table.columns[end] = key
    return replace(table, notes=(*_unused_note(path, unused), *_implausible(table)))


def unused_columns(path: Path | str, header: Iterable[str], used: Collection[str],
                   known: Collection[str]) -> list[str]:
    """Return a note on the columns of a table of fixed names that are not used.

    Raises:
        BadInput: one is nearly a known name that the table does not have.
    """
    unused = {name: "" for name in header if name not in used}
    plain = {_plain(name): name for name in known if name not in used}
    for name in unused:
        near = _plain(name) if _plain(name) in plain else misspelt(_plain(name), plain)
        if near:
            raise BadInput(f"{path}: column {shown(name)} is nearly {plain[near]!r}; correct its "
                           "name, or leave the column out")
    return _unused_note(path, unused)


def _unused_note(path: Path | str, unused: Mapping[str, str]) -> list[str]:
    if not unused:
        return []
    columns = listed(f"{name} ({why})" if why else name for name, why in unused.items())
    return [f"{Path(path).name}: column{'s' * (len(unused) > 1)} not used: {columns}"]


def _columns(path: Path | str, header: Sequence[str],
             crs: bool) -> tuple[dict[str, str], dict[str, str]]:
    """Return the column of each quantity, and the others with the reason why they are not used."""
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
            raise BadInput(f"{path}: column {shown(name)} is a part of an angle; give latitude and "
                           "longitude in decimal degrees, in one column each")
        near = misspelt(plain, known)
        if plain not in known and plain not in keys and near \
                and known[near].quantity not in found:
            raise BadInput(f"{path}: column {shown(name)} is nearly one of a "
                           f"{known[near].quantity}; correct its name, or leave the column out. "
                           f"The table has {listed(header)}")
    if {"latitude", "x"} <= found.keys():
        for quantity in ("latitude", "longitude") if crs else ("x", "y"):
            if quantity in found:
                unused[found.pop(quantity)] = "the position is known already"
    return found, unused


def _key(path: Path | str, cells: pd.DataFrame, end: str, names: Collection[str],
         taken: set[str]) -> tuple[str, dict[str, str]]:
    """Return the column of the names, and other ones that could be it."""
    words = _words(_NAMES[end])
    found = sorted((name for name in map(str, cells)
                    if _plain(name) in words and name not in taken),
                   key=lambda name: words.index(_plain(name)))
    if not found:
        raise BadInput(f"{path}: column {end!r} is missing: which one has the names of the {end}s? "
                       f"It has {listed(cells)}")
    if len(found) > 1 and names and found[0] != end:
        found.sort(key=lambda name: -as_text(cells[name]).isin(set(names)).sum())
    return found[0], {name: f"{found[0]} has the names" for name in found[1:]}


def _numbers(table: SiteTable, quantity: str, convert: Convert | None, length_unit: str | None,
             crs: bool) -> np.ndarray:
    """Return the numbers (k,) of a quantity in its unit; NaN where empty."""
    name = table.columns[quantity]
    text = as_text(table.cells[name])
    numbers = as_numbers(text)
    _refuse(table, name, np.isnan(numbers) & (text != ""), "is not a number")
    _refuse(table, name, np.isinf(numbers), "is not finite")
    if convert is None:
        units = _QUANTITIES[quantity][0]
        if units is _LENGTHS and crs and quantity in "xy":
            convert = _SAME
        elif units is _LENGTHS and length_unit is not None:
            convert = _LENGTHS[length_unit]
        elif units is _FREQUENCIES and np.nanmin(numbers, initial=np.inf) >= 1e6:
            convert = _SAME  # so many MHz are no radio
        else:
            given = numbers[np.isfinite(numbers)]
            span = f" from {given.min():g} to {given.max():g}" if len(given) else ""
            endings = " or ".join(f"{name}_{unit}" for unit in list(units)[:1] + [
                unit for unit in ("ft", "w", "mhz") if unit in units])
            raise BadInput(f"{table.path}: column {shown(name)}: the unit of its numbers{span} is "
                           f"not known; end its name in it: {endings}"
                           + (", or give length_unit" if units is _LENGTHS else ""))
    numbers = convert(numbers)
    _refuse(table, name, np.isinf(numbers) | (np.isnan(numbers) & (text != "")),
            "is no power above zero")
    is_projected = crs and quantity in "xy"
    is_length = _QUANTITIES[quantity][0] is _LENGTHS and not is_projected
    refuse_limits(partial(_refuse, table, name),
                  f"{quantity.removesuffix('_m')}_m" if is_length else quantity, numbers)
    return numbers


def _check_positions(table: SiteTable) -> None:
    """Check that sites have a place in one form, and one height at most."""
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
    for name, limit in LIMITS_DEG.items():
        if name not in given:
            continue
        bad = table.values[name].abs() > limit
        hint = ""
        if name == "latitude" and (table.values["longitude"].abs() <= limit).all():
            hint = "; are latitude and longitude swapped?"
        table.refuse(name, bad, f"is no {name}; allowed are -{limit:g} to {limit:g} degrees{hint}")


def _implausible(table: SiteTable) -> list[str]:
    notes = []
    if "tilt_deg" in table.values:
        notes += tilt_notes(table.values["tilt_deg"].to_numpy())
    if "above_ground_m" in table.values:
        notes += high_notes(table.values["above_ground_m"].to_numpy())
    return [f"{Path(table.path).name}: {note}" for note in notes]


def tilt_notes(tilt_deg: np.ndarray) -> list[str]:
    """Return a note where antennas (k,) are said to look upwards, and downtilts are meant."""
    up, known = tilt_deg > 0, np.isfinite(tilt_deg)
    if not up.any() or (tilt_deg < 0).any():
        return []
    return [f"{up.sum()} of {known.sum()} declared tilts are above zero, which is upwards, and "
            "none is below; where the table counts downtilts, call the column downtilt_deg"]


def high_notes(above_ground_m: np.ndarray) -> list[str]:
    """Return a note where all sites (k,) are higher above the ground than masts are [m]."""
    known_m = above_ground_m[np.isfinite(above_ground_m)]
    if not len(known_m) or known_m.min() < HIGH_M:
        return []
    return [f"the lowest of {len(known_m)} sites is {known_m.min():.0f} m above the ground; if "
            "those are altitudes above the sea, call the column altitude_m, and give the ground's "
            "in the origin"]


def local_positions(values: pd.DataFrame, origin: Origin | None) -> np.ndarray:
    """Convert columns of `POSITION` [degrees, m] to x, y, z (k, 3) [m] about an origin.

    NaN stands for unknown; without an origin all positions are local already.
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


def far_notes(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str],
              where: Callable[[int], str], what: str) -> list[str]:
    """Return a note on sites that are odd distances away.

    Args:
        place: (k, 2) latitude and longitude [degrees], or x and y [m], of sites; NaN where unknown.
        middle: (2,) of what they belong to.
        axes: names of the two.
        where: row -> the file and the site, for messages.
        what: they belong to, such as `the readings`.

    Raises:
        BadInput: one is farther away than any link is long, or where a slip explains it: swapped
            coordinates, a wrong sign, a decimal point at a wrong place.
    """
    apart_m = _apart_m(place, middle, axes)
    far = np.flatnonzero(apart_m > FAR_M)  # not of NaN
    if not len(far):
        return []
    row = int(far[np.argmax(apart_m[far])])
    slip = _slip(place[row], middle, axes)
    text = (f"{where(row)} at {axes[0]} {place[row, 0]:.10g}, {axes[1]} {place[row, 1]:.10g} is "
            f"{apart_m[row] / 1000:,.0f} km from {what} ({axes[0]} {middle[0]:.10g}, {axes[1]} "
            f"{middle[1]:.10g})" + (f"; {len(far)} are so far away" if len(far) > 1 else ""))
    if slip or apart_m[row] > MAX_APART_M:
        raise BadInput(f"{text}: {slip or 'both need one frame, and one unit'}")
    return [text]


def _slip(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str]) -> str:
    """Return the slip that brings a place (2,) to where it belongs, or `""`.

    Of local metres none is known: every decimal point that slips brings a place near the origin.
    """
    if "latitude" not in axes and np.linalg.norm(middle) <= FAR_M:
        return ""
    tries = [(place[::-1], f"are {axes[0]} and {axes[1]} swapped?")]
    for sign in ([-1, 1], [1, -1], [-1, -1]):
        turned = place * sign
        tries.append((turned, f"is a sign wrong ({turned[0]:.10g}, {turned[1]:.10g})?"))
    for power in (1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6):
        for axis in ([1, 0], [0, 1], [1, 1]):
            moved = place * 10.0 ** (power * np.array(axis))
            tries.append((moved, f"has a decimal point slipped ({moved[0]:.10g}, "
                                 f"{moved[1]:.10g})?"))
    return next((text for moved, text in tries
                 if _apart_m(moved[None], middle, axes)[0] <= FAR_M), "")


def _apart_m(place: np.ndarray, middle: np.ndarray, axes: tuple[str, str]) -> np.ndarray:
    if "latitude" in axes:
        return distances_m(place, middle)
    return np.linalg.norm(place - middle, axis=1)


def distances_m(place_deg: np.ndarray, middle_deg: np.ndarray) -> np.ndarray:
    """Return distances (k,) on the sphere of latitudes and longitudes (k, 2) from one [m].

    They are infinite where a latitude is none.
    """
    (north, east), (middle_north, middle_east) = np.radians(place_deg).T, np.radians(middle_deg)
    chord = (np.sin((north - middle_north) / 2)**2
             + np.cos(north) * np.cos(middle_north) * np.sin((east - middle_east) / 2)**2)
    apart_m = 2 * _EARTH_M * np.arcsin(np.sqrt(np.clip(chord, 0, 1)))
    return np.where(np.abs(place_deg[:, 0]) > LIMITS_DEG["latitude"], np.inf, apart_m)


def unmatched_notes(path: Path | str, names: Iterable[str], others: Collection[str], end: str,
                    what: str) -> list[str]:
    """Return notes on names of a table that occur in no row of something, and those that it lacks.

    Args:
        path: of the table.
        names: in the table.
        others: names that occur.
        end: what they are of, such as `device`.
        what: they occur in, such as `the log`.
    """
    idle = list(dict.fromkeys(name for name in names if name not in others))
    lacking = sorted(set(others) - set(names))
    notes, file = [], Path(path).name
    if idle:
        loose = {_loosely(name): name for name in lacking}
        pairs = [f"{name} ({loose[_loosely(name)]} there)" for name in idle
                 if _loosely(name) in loose]
        notes.append(f"{file}: {len(idle)} of {len(set(names)):,} names occur in no row of {what}: "
                     f"{some(pairs or idle, _NAMED)}"
                     + ("; names are compared letter by letter: make them equal" if pairs else ""))
    if lacking and idle:
        notes.append(f"{file}: {len(lacking)} of {len(others):,} {end}s of {what} are not in it: "
                     f"{some(lacking, _NAMED)}")
    return notes


def _loosely(name: str) -> tuple[str, ...]:
    """Return a name without case, marks, zeros before its numbers, and decimals that are zero."""
    parts = re.findall(r"\d+|[^\W\d_]+", re.sub(r"(?<=\d)\.0+$", "", name.casefold()))
    return tuple(part.lstrip("0") or "0" if part.isdigit() else part for part in parts)
