"""Heights of buildings from their tags or columns, with source and standard deviation.

Tags and units are as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.
A height counts from the ground beside the building, and includes the roof. An elevation counts from
a vertical datum: the ground's elevation is subtracted. A storey counts 3 m; `building:levels` does
not include those of the roof [5], so `roof:height` or `roof:levels` is added. Columns are known by
name only if their meaning and unit are published: OpenStreetMap [1], Overture Maps [2], CityGML 2.0
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
# Column -> tag: names of tables, which cannot have the `:` of a tag, and of Overture Maps
ALIASES = {key.replace(":", "_"): key for key in (
    "building:part", "building:levels", "building:min_level", "building:material",
    "building:height", "building:levels:underground", "roof:height", "roof:levels")} | {
    "min_floor": "building:min_level", "num_floors_underground": "building:levels:underground",
    "facade_material": "building:material", "hasparts": "has_parts", "minheight": "min_height"}
ESTIMATED = "est_height"
HIGHEST = "max_level"  # number of the top storey, 0 at the ground: Simple Indoor Tagging
ROOFLESS = ("building:levels", "num_floors")  # numbers of storeys without those of the roof
# Standard deviations of a height in metres, a height from storeys, and a default height of a map
# with fewer than `MIN_KNOWN` known heights
TAG_SD_M, STOREYS_SD_M, GUESS_SD_M = 1.5, 3.0, 6.0
MIN_KNOWN = 10
MAX_HEIGHT_M = 1000.0  # [m], the tallest building has 828 m
_METRES = re.compile(rf"([+-]?(?:{_DECIMAL}))\s*(?:m|meters?|metres?)?", re.IGNORECASE)
_FEET = re.compile(rf"([+-]?(?:{_DECIMAL}))\s*(?:'|′|’|ft\.?|feet|foot)\s*"
                   rf"(?:(\d{{1,2}}(?:[.,]\d*)?)\s*(?:\"|″|”|''|in\.?|inch(?:es)?)?)?",
                   re.IGNORECASE)


@dataclass(frozen=True)
class HeightColumn:
    """A column with the height or the roof's elevation of buildings.

    Attributes:
        name: name in lower case.
        unit: unit, a key of `UNITS_M`.
        ground: column of the ground's elevation if `name` is an elevation; "": it is a height.
    """

    name: str
    unit: str = "m"
    ground: str = ""

    @property
    def label(self) -> str:
        """Name in `buildings.csv` and in reports."""
        return f"{self.name} - {self.ground}" if self.ground else self.name

    @property
    def sd_m(self) -> float:
        """Standard deviation of heights from the column [m]."""
        return STOREYS_SD_M if self.unit == STOREYS or self.name == ESTIMATED else TAG_SD_M


KNOWN = (
    *(HeightColumn(name) for name in (
        "height", "building:height", "measuredheight", "gesamthoehe", "gebaeudehoehe", "hoehe",
        "height_m", "hauteur", "relhmax", "relh2")),
    HeightColumn(ESTIMATED),
    *(HeightColumn(name, "ft") for name in ("heightroof", "height_roof", "height_ft")),
    *(HeightColumn(name, ground="b3_h_maaiveld") for name in (
        "b3_h_dak_max", "b3_h_max", "b3_h_dak_70p", "b3_h_70p", "b3_h_dak_50p", "b3_h_50p")),
    HeightColumn("h_dak_max", ground="h_maaiveld"),
    HeightColumn("dach_max", ground="gelaendepunkt"),
    HeightColumn("hoehedach", ground="hoehegrund"),
    *(HeightColumn(name, STOREYS) for name in (
        "building:levels", "num_floors", "storeysaboveground", "b3_bouwlagen", "numfloors",
        "nombre_d_etages", "nb_etages", "numberoffloorsaboveground", "aog", "geschosse",
        "storeys", "stories", "floors", "levels", HIGHEST)))
"""Known columns; the first usable one of a building is taken."""
READ_COLUMNS = frozenset(name for column in KNOWN for name in (column.name, column.ground)) | {
    "roof:height", "roof:levels", "min_height", "building:min_level"}


def column_name(text: str) -> str:
    """Return the key, in OpenStreetMap's form, of a column's name; others in lower case.

    >>> column_name("Building_Levels"), column_name("HOEHE")
    ('building:levels', 'hoehe')
    """
    return ALIASES.get(text.lower(), text.lower())


def full_names(cut: Iterable[str], length: int = 10) -> dict[str, str]:
    """Return short name -> full name, for known columns that a Shapefile cut at `length`.

    Names that several known columns begin with are left out: `b3_h_dak_m` could be the highest or
    the lowest roof.

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
    """Raise BadInput if no building has a column that the user named."""
    columns = {key for tags in rows for key in tags}
    for name in (column.name, column.ground):
        if name and name not in columns:
            raise BadInput(f"{source} has no column {name!r}; its columns are: "
                           f"{listed_names(columns)}")


def no_height_text(rows: list[Mapping[str, str]]) -> str | None:
    """Return the message that no row has a usable height, and how to name a column of heights.

    None if no column holds numbers, so that none could be named.
    """
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
    """Format names in alphabetical order for a message, at most the first twenty."""
    ordered = sorted(names)
    more = len(ordered) - MAX_LISTED
    return ", ".join(repr(name[:60]) for name in ordered[:MAX_LISTED]) + (
        f" and {more} more" if more > 0 else "") or "(none)"


def parse_length_m(text: str) -> float:
    """Parse a length as in OpenStreetMap [m]; NaN if the text is no length.

    >>> parse_length_m("12,5"), round(parse_length_m("33'"), 4)
    (12.5, 10.0584)
    """
    text = text.strip()
    if found := _METRES.fullmatch(text):
        return number(found[1])
    if found := _FEET.fullmatch(text):
        feet, inches = number(found[1]), number(found[2] or "0")
        length_m = abs(feet) * FOOT_M + inches * 0.0254
        return math.copysign(length_m, feet)
    return math.nan


@dataclass(frozen=True)
class Height:
    """Vertical extent of a building above the ground.

    Attributes:
        bottom_m: lower end [m].
        top_m: upper end [m].
        source: source of the top: `HeightColumn.label` of a tag or column, `model` if the file has
            a solid, or `default`.
        unusable: tags that were skipped, such as `height=-3`.
        sd_m: standard deviation of the top [m]; NaN: of a default, see `height_sds_m`.
    """

    bottom_m: float
    top_m: float
    source: str
    unusable: list[str] = field(default_factory=list)
    sd_m: float = TAG_SD_M


def height_of(tags: Mapping[str, str], default_m: float,
              declared: HeightColumn | None = None) -> Height:
    """Return bottom and top of a building above the ground, with their source.

    The top is the first usable of the declared column, the columns `KNOWN`, and the default;
    usable is above 0, up to `MAX_HEIGHT_M`. The bottom is `min_height`, else
    `building:min_level` × 3 m, but at least 0 (the ground).

    Args:
        tags: tags of the building.
        default_m: height of a building without a usable one [m].
        declared: column that the user named.
    """
    unusable: list[str] = []
    top_m, source, sd_m = default_m, "default", math.nan
    for column in (*((declared,) if declared else ()), *KNOWN):
        if column.name not in tags or (column.ground and column.ground not in tags):
            continue
        value_m = _top_m(column, tags)
        if column.name in ROOFLESS and value_m >= 0:
            value_m += _first_length_m(tags, (("roof:height", 1.0), ("roof:levels", LEVEL_M)),
                                       unusable)
        if 0 < value_m <= MAX_HEIGHT_M:
            top_m, source, sd_m = value_m, column.label, column.sd_m
            break
        unusable.append(", ".join(f"{name}={tags[name]}" for name in (column.name, column.ground)
                                  if name))
    bottom_m = _first_length_m(tags, (("min_height", 1.0), ("building:min_level", LEVEL_M)),
                               unusable, -MAX_HEIGHT_M)
    return Height(max(bottom_m, 0.0), top_m, source, unusable, sd_m)


def _first_length_m(tags: Mapping[str, str], keys: Iterable[tuple[str, float]], unusable: list[str],
                    lowest_m: float = 0.0) -> float:
    """Return the first possible length of the tags `keys` (with units [m]) [m]; 0 if none has one.

    Tags with other values are appended to `unusable`.
    """
    for key, unit_m in keys:
        if key in tags:
            value_m = parse_length_m(tags[key]) if unit_m == 1 else unit_m * number(tags[key])
            if lowest_m <= value_m <= MAX_HEIGHT_M:
                return value_m
            unusable.append(f"{key}={tags[key]}")
    return 0.0


def height_sds_m(top_m: np.ndarray, sd_m: np.ndarray) -> np.ndarray:
    """Return the standard deviations of heights (n,) [m], estimated where the height is a default.

    It is the RMS difference of the map's known heights (`GUESS_SD_M` if there are less than
    `MIN_KNOWN`) from the default, at least that of heights counted in storeys.

    Args:
        top_m: (n,) heights of the tops above the ground [m].
        sd_m: (n,) standard deviations [m]; NaN: the height is a default.
    """
    guessed = np.isnan(sd_m)
    if guessed.any():
        spread_m = GUESS_SD_M
        if (~guessed).sum() >= MIN_KNOWN:
            spread_m = float(np.sqrt(np.mean((top_m[~guessed] - top_m[guessed][0]) ** 2)))
        sd_m = np.where(guessed, max(spread_m, STOREYS_SD_M), sd_m)
    return sd_m


def source_text(source: str, declared: HeightColumn | None = None) -> str:
    """Format the source of a height for a report.

    >>> source_text("num_floors"), source_text("height")
    ('num_floors × 3 m', 'height tag')
    """
    column = next((one for one in (*((declared,) if declared else ()), *KNOWN)
                   if one.label == source), None)
    if column is None or column.unit == "m":
        return {"height": "height tag", "model": "model"}.get(source, source)
    return f"{source} × {LEVEL_M:g} m" if column.unit == STOREYS else f"{source} [{column.unit}]"


def _top_m(column: HeightColumn, tags: Mapping[str, str]) -> float:
    """Return a building's height from a column, minus its ground column [m]; NaN: no number."""
    unit_m = UNITS_M[column.unit]
    top = parse_length_m(tags[column.name]) if column.unit == "m" else number(tags[column.name])
    top += column.name == HIGHEST
    ground = parse_length_m(tags[column.ground]) if column.ground else 0.0
    return unit_m * (top - ground)


def number(text: str) -> float:
    """Parse a number with a decimal point or comma; NaN if the text is no number."""
    found = _NUMBER.fullmatch(text)
    return float(found[1].replace(",", ".")) if found else math.nan
