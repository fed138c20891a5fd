"""Height of a building from its tags, or from the columns of a publisher, with its source.

Tags and units are as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.
A height counts from the ground beside the building, and includes the roof. An elevation counts from
a vertical datum, so that of the ground is subtracted. Storeys count 3 m each; `building:levels` are
those below the roof [5], which `roof:height` or `roof:levels` are added to. Only columns whose
meaning and unit are published are known by name: OpenStreetMap [1], Overture Maps [2], CityGML 2.0
(section 10.3), 3D BAG [3], swissBUILDINGS3D 3.0, the LoD models of German states (AdV), BD TOPO of
IGN, OS MasterMap, buildings of New York City [4] and INSPIRE BU.

[1] https://wiki.openstreetmap.org/wiki/Key:height
[2] https://docs.overturemaps.org/schema/reference/buildings/building
[3] https://docs.3dbag.nl/en/schema/attributes
[4] https://github.com/CityOfNewYork/nyc-geo-metadata
[5] https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from radiotwin.errors import BadInput

LEVEL_M = 3.0  # [m], a usual storey
FOOT_M = 0.3048
STOREYS = "storeys"
UNITS_M = {"m": 1.0, "ft": FOOT_M, "cm": 0.01, "mm": 0.001, STOREYS: LEVEL_M}
MAX_LISTED = 20  # columns in a message
_UNIT = re.compile(r"(.+):(m|ft|cm|mm|storeys)", re.IGNORECASE | re.DOTALL)
# A comma may separate decimals, where it cannot separate thousands
_DECIMAL = r"\d+(?:\.\d*|,\d{1,2})?|\.\d+"
_NUMBER = re.compile(rf"\s*([+-]?(?:{_DECIMAL}))\s*")
# Tags and columns whose `:` a table cannot have in its names, and names of Overture Maps
ALIASES = {key.replace(":", "_"): key for key in (
    "building:part", "building:levels", "building:min_level", "building:material",
    "building:height", "building:levels:underground", "roof:height", "roof:levels")} | {
    "min_floor": "building:min_level", "num_floors_underground": "building:levels:underground",
    "facade_material": "building:material", "hasparts": "has_parts", "minheight": "min_height"}
ESTIMATED = "est_height"
HIGHEST = "max_level"  # storey, of which the one at the ground is 0: Simple Indoor Tagging
ROOFLESS = ("building:levels", "num_floors")  # storeys that do not count those of the roof
TAG_SD_M, STOREYS_SD_M = 1.5, 3.0  # of a height that is given in metres; counted from storeys
GUESS_SD_M = 6.0  # of a default, where few heights of the map are known
MIN_KNOWN = 10  # heights of a map that tell how far a default is off
MAX_HEIGHT_M = 1000.0  # [m], the tallest building has 828 m
_METRES = re.compile(rf"([+-]?(?:{_DECIMAL}))\s*(?:m|meters?|metres?)?", re.IGNORECASE)
_FEET = re.compile(rf"([+-]?(?:{_DECIMAL}))\s*(?:'|′|’|ft\.?|feet|foot)\s*"
                   rf"(?:(\d{{1,2}}(?:[.,]\d*)?)\s*(?:\"|″|”|''|in\.?|inch(?:es)?)?)?",
                   re.IGNORECASE)


@dataclass(frozen=True)
class HeightColumn:
    """A column with the top of a building.

    Attributes:
        name: of the column, in lower case.
        unit: key of `UNITS_M`.
        ground: column with the elevation of the ground, where `name` is an elevation; or "".
    """

    name: str
    unit: str = "m"
    ground: str = ""

    @property
    def label(self) -> str:
        """Its name in `buildings.csv` and in reports."""
        return f"{self.name} - {self.ground}" if self.ground else self.name

    @property
    def sd_m(self) -> float:
        """Standard deviation of the heights in it [m]."""
        return STOREYS_SD_M if self.unit == STOREYS or self.name == ESTIMATED else TAG_SD_M


def _elevations(ground: str, *names: str) -> tuple[HeightColumn, ...]:
    return tuple(HeightColumn(name, ground=ground) for name in names)


KNOWN = (
    *(HeightColumn(name) for name in (
        "height", "building:height", "measuredheight", "gesamthoehe", "gebaeudehoehe", "hoehe",
        "height_m", "hauteur", "relhmax", "relh2")),
    HeightColumn(ESTIMATED),
    *(HeightColumn(name, "ft") for name in ("heightroof", "height_roof", "height_ft")),
    *_elevations("b3_h_maaiveld", "b3_h_dak_max", "b3_h_max", "b3_h_dak_70p",
                 "b3_h_70p", "b3_h_dak_50p", "b3_h_50p"),
    *_elevations("h_maaiveld", "h_dak_max"),
    *_elevations("gelaendepunkt", "dach_max"),
    *_elevations("hoehegrund", "hoehedach"),
    *(HeightColumn(name, STOREYS) for name in (
        "building:levels", "num_floors", "storeysaboveground", "b3_bouwlagen", "numfloors",
        "nombre_d_etages", "nb_etages", "numberoffloorsaboveground", "aog", "geschosse",
        "storeys", "stories", "floors", "levels", HIGHEST)))
"""Known columns; of a building, the first usable one counts."""
READ_COLUMNS = frozenset(name for column in KNOWN for name in (column.name, column.ground)) | {
    "roof:height", "roof:levels", "min_height", "building:min_level"}


def column_name(text: str) -> str:
    """Return a column's name as `Feature.tags` has it.

    >>> column_name("Building_Levels"), column_name("HOEHE")
    ('building:levels', 'hoehe')
    """
    return ALIASES.get(text.lower(), text.lower())


def full_names(cut: Iterable[str], length: int = 10) -> dict[str, str]:
    """Return the known columns that names were cut to, as Shapefiles do.

    Those of elevations are left out: `b3_h_dak_m` may be of the highest or of the lowest roof.

    >>> full_names(["b3_h_maaiv", "b3_h_dak_m", "height"])
    {'b3_h_maaiv': 'b3_h_maaiveld'}
    """
    known = {column.ground or column.name for column in KNOWN}
    found = {}
    for name in cut:
        longer = [one for one in known if len(one) > length and one[:length] == name]
        if len(longer) == 1 and name not in known:
            found[name] = longer[0]
    return found


def declared_column(text: str, ground: str | None) -> HeightColumn:
    """Parse a column that the user names: `NAME`, in metres, or `NAME:UNIT` of `UNITS_M`.

    >>> declared_column("FLOORS:storeys", None)
    HeightColumn(name='floors', unit='storeys', ground='')
    """
    found = _UNIT.fullmatch(text)
    name, unit = (found[1], found[2].lower()) if found else (text, "m")
    return HeightColumn(column_name(name), unit, column_name(ground or ""))


def check_declared(column: HeightColumn, rows: Iterable[Mapping[str, str]], source: object) -> None:
    """Raise BadInput unless the columns that the user named are in the tags of some building."""
    there = {key for tags in rows for key in tags}
    for name in (column.name, column.ground):
        if name and name not in there:
            raise BadInput(f"{source} has no column {name!r}; its columns are: "
                           f"{listed_names(there)}")


def no_height_text(rows: list[Mapping[str, str]]) -> str | None:
    """Return the error message for rows without a usable height; None if no column has numbers."""
    counts: dict[str, int] = {}
    for tags in rows:
        for key, value in tags.items():
            counts[key] = counts.get(key, 0) + bool(_NUMBER.fullmatch(value))
    numeric = [key for key, count in counts.items() if count]
    if not numeric:
        return None
    for column in KNOWN:  # the sign of a usable height is checked where it is read
        if column.name in numeric and not column.ground:
            value = next(tags[column.name] for tags in rows
                         if _NUMBER.fullmatch(tags.get(column.name, "")))
            return (f"no building has a height that can be used: column {column.name!r} holds none "
                    f"above 0 and up to 1,000 m, only such as {value.strip()[:20]}. Correct it, "
                    "name another column or unit with --height-column NAME (NAME:ft, NAME:cm, "
                    "NAME:mm), or give all buildings one height with --height-default M. Its "
                    f"columns of numbers are: {listed_names(numeric)}")
    elevations = [f"{column.name} is an elevation, from which the ground's ({column.ground}) has "
                  "to be subtracted, and the file has none"
                  for column in KNOWN if column.ground and column.name in counts
                  and column.ground not in counts]
    hint = f" ({elevations[0]})" if elevations else ""
    return ("none of its columns is known to hold heights" + hint + ". Name one with "
            "--height-column NAME (metres above ground; NAME:ft, NAME:cm or NAME:storeys; of an "
            "elevation, with --ground-column NAME), or give all buildings one height with "
            f"--height-default M. Its columns of numbers are: {listed_names(numeric)}")


def listed_names(names: Iterable[str]) -> str:
    """Return names in order, of many the first twenty."""
    ordered = sorted(names)
    more = len(ordered) - MAX_LISTED
    return ", ".join(repr(name[:60]) for name in ordered[:MAX_LISTED]) + (
        f" and {more} more" if more > 0 else "") or "(none)"


def parse_length_m(text: str) -> float:
    """Parse a length of OpenStreetMap [m]; NaN if the text is none.

    >>> parse_length_m("12,5"), round(parse_length_m("33'"), 4)
    (12.5, 10.0584)
    """
    text = text.strip()
    if found := _METRES.fullmatch(text):
        return number(found[1])
    if found := _FEET.fullmatch(text):
        feet, inches = number(found[1]), number(found[2] or "0")
        length_m = abs(feet) * 0.3048 + inches * 0.0254
        return math.copysign(length_m, feet)
    return math.nan


@dataclass(frozen=True)
class Height:
    """Vertical extent of a building above the ground.

    Attributes:
        bottom_m: lower end [m].
        top_m: upper end [m].
        source: of the top: a tag or column, as `HeightColumn.label` has it, `model` of a solid that
            the file holds, or `default`.
        unusable: tags that were skipped, as `height=-3`.
        sd_m: standard deviation of the top [m]; NaN of a default.
    """

    bottom_m: float
    top_m: float
    source: str
    unusable: list[str] = field(default_factory=list)
    sd_m: float = TAG_SD_M


def height_of(tags: Mapping[str, str], default_m: float,
              declared: HeightColumn | None = None) -> Height:
    """Return the vertical extent of a building; values that cannot be used are listed.

    The top is the first usable of the declared column, the known ones (see `KNOWN`), and the
    default; the bottom that of `min_height`, `building:min_level` × 3 m, and the ground, where it
    is below that, too.
    """
    unusable: list[str] = []
    top_m, source, sd_m = default_m, "default", math.nan
    for column in (*((declared,) if declared else ()), *KNOWN):
        if column.name not in tags or (column.ground and column.ground not in tags):
            continue
        value_m = _top_m(column, tags)
        if column.name in ROOFLESS and value_m >= 0:
            value_m += _first(tags, (("roof:height", 1.0), ("roof:levels", LEVEL_M)), unusable)
        if 0 < value_m <= MAX_HEIGHT_M:
            top_m, source, sd_m = value_m, column.label, column.sd_m
            break
        unusable.append(", ".join(f"{name}={tags[name]}" for name in (column.name, column.ground)
                                  if name))
    bottom_m = _first(tags, (("min_height", 1.0), ("building:min_level", LEVEL_M)), unusable,
                      -MAX_HEIGHT_M)
    return Height(max(bottom_m, 0.0), top_m, source, unusable, sd_m)


def _first(tags: Mapping[str, str], keys: Iterable[tuple[str, float]], unusable: list[str],
           least_m: float = 0.0) -> float:
    """Return the first usable length [m] among tags, given with their units; 0 if there is none."""
    for key, unit_m in keys:
        if key in tags:
            value_m = parse_length_m(tags[key]) if unit_m == 1 else unit_m * number(tags[key])
            if least_m <= value_m <= MAX_HEIGHT_M:
                return value_m
            unusable.append(f"{key}={tags[key]}")
    return 0.0


def height_sds_m(top_m: np.ndarray, sd_m: np.ndarray) -> np.ndarray:
    """Return the standard deviations (n,) of heights [m], with estimates for defaults.

    The error of a default is estimated as the RMS difference of the map's known heights from it.

    Args:
        top_m: (n,) heights of the tops above the ground [m].
        sd_m: (n,) standard deviations [m]; NaN: of a default.
    """
    guessed = np.isnan(sd_m)
    if guessed.any():
        spread_m = GUESS_SD_M
        if (~guessed).sum() >= MIN_KNOWN:
            spread_m = float(np.sqrt(np.mean((top_m[~guessed] - top_m[guessed][0]) ** 2)))
        sd_m = np.where(guessed, max(spread_m, STOREYS_SD_M), sd_m)
    return sd_m


def source_text(source: str, declared: HeightColumn | None = None) -> str:
    """Return the source of a height as a report names it.

    >>> source_text("num_floors"), source_text("height")
    ('num_floors × 3 m', 'height tag')
    """
    column = next((one for one in (*((declared,) if declared else ()), *KNOWN)
                   if one.label == source), None)
    if column is None or column.unit == "m":
        return {"height": "height tag", "model": "model"}.get(source, source)
    return f"{source} × {LEVEL_M:g} m" if column.unit == STOREYS else f"{source} [{column.unit}]"


def _top_m(column: HeightColumn, tags: Mapping[str, str]) -> float:
    """Return the top above the ground [m]; NaN where a text is no number."""
    unit_m = UNITS_M[column.unit]
    top = parse_length_m(tags[column.name]) if column.unit == "m" else number(tags[column.name])
    top += column.name == HIGHEST
    ground = parse_length_m(tags[column.ground]) if column.ground else 0.0
    return unit_m * (top - ground)


def number(text: str) -> float:
    """Parse a number, with a decimal point or comma; NaN if the text is none."""
    found = _NUMBER.fullmatch(text)
    return float(found[1].replace(",", ".")) if found else math.nan
