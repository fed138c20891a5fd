"""Columns of maps that say how tall a building is, and what each publisher means by its own.

A height counts from the ground beside the building. An elevation counts from a vertical datum, so
that of the ground is subtracted. Storeys count 3 m each. Only columns whose meaning and unit are
published are known by name: OpenStreetMap [1], Overture Maps [2], CityGML 2.0 (section 10.3), 3D
BAG [3], swissBUILDINGS3D 3.0, the LoD models of German states (AdV), BD TOPO of IGN, OS MasterMap,
buildings of New York City [4] and INSPIRE BU.

[1] https://wiki.openstreetmap.org/wiki/Key:height
[2] https://docs.overturemaps.org/schema/reference/buildings/building
[3] https://docs.3dbag.nl/en/schema/attributes
[4] https://github.com/CityOfNewYork/nyc-geo-metadata
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from radiotwin.errors import BadInput

LEVEL_M = 3.0  # [m], a usual storey
FOOT_M = 0.3048
STOREYS = "storeys"
UNITS_M = {"m": 1.0, "ft": FOOT_M, "cm": 0.01, STOREYS: LEVEL_M}
MAX_LISTED = 20  # columns in a message
_UNIT = re.compile(r"(.+):(m|ft|cm|storeys)", re.IGNORECASE | re.DOTALL)
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)\s*")
# Tags and columns whose `:` a table cannot have in its names
ALIASES = {key.replace(":", "_"): key for key in (
    "building:part", "building:levels", "building:min_level", "building:material",
    "building:height")}


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


def _elevations(ground: str, *names: str) -> tuple[HeightColumn, ...]:
    return tuple(HeightColumn(name, ground=ground) for name in names)


KNOWN = (
    *(HeightColumn(name) for name in (
        "height", "building:height", "measuredheight", "gesamthoehe", "gebaeudehoehe", "hoehe",
        "height_m", "hauteur", "relhmax", "relh2")),
    *(HeightColumn(name, "ft") for name in ("heightroof", "height_roof", "height_ft")),
    *_elevations("b3_h_maaiveld", "b3_h_dak_max", "b3_h_max", "b3_h_dak_70p",
                 "b3_h_70p", "b3_h_dak_50p", "b3_h_50p"),
    *_elevations("h_maaiveld", "h_dak_max"),
    *_elevations("gelaendepunkt", "dach_max"),
    *_elevations("hoehegrund", "hoehedach"),
    *(HeightColumn(name, STOREYS) for name in (
        "building:levels", "num_floors", "storeysaboveground", "b3_bouwlagen", "numfloors",
        "nombre_d_etages", "nb_etages", "numberoffloorsaboveground", "aog", "geschosse",
        "storeys", "stories", "floors", "levels")))
"""Known columns; of a building, the first usable one counts."""


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
    """Parse a column that the user names.

    >>> declared_column("FLOORS:storeys", None)
    HeightColumn(name='floors', unit='storeys', ground='')

    Args:
        text: `NAME`, in metres, or `NAME:UNIT` with a unit of `UNITS_M`.
        ground: name of the column with the elevation of the ground; None: heights are above it.
    """
    found = _UNIT.fullmatch(text)
    name, unit = (found[1], found[2].lower()) if found else (text, "m")
    return HeightColumn(column_name(name), unit, column_name(ground or ""))


def check_declared(column: HeightColumn, rows: Iterable[Mapping[str, str]], source: object) -> None:
    """Raise BadInput unless the columns that the user named are there.

    Args:
        column: as declared.
        rows: tags of each building.
        source: of the buildings, for the message.
    """
    there = {key for tags in rows for key in tags}
    for name in (column.name, column.ground):
        if name and name not in there:
            raise BadInput(f"{source} has no column {name!r}; its columns are: {_listed(there)}")


def no_height_text(rows: list[Mapping[str, str]]) -> str | None:
    """Return what to say where no row has a known height; None where no column is of numbers.

    Args:
        rows: tags of each building.
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
                    "name another column with --height-column NAME, or give all buildings one "
                    "height with --height-default M. Its columns of numbers are: "
                    f"{_listed(numeric)}")
    elevations = [f"{column.name} is an elevation, from which the ground's ({column.ground}) has "
                  "to be subtracted, and the file has none"
                  for column in KNOWN if column.ground and column.name in counts
                  and column.ground not in counts]
    hint = f" ({elevations[0]})" if elevations else ""
    return ("none of its columns is known to hold heights" + hint + ". Name one with "
            "--height-column NAME (metres above ground; NAME:ft, NAME:cm or NAME:storeys; of an "
            "elevation, with --ground-column NAME), or give all buildings one height with "
            f"--height-default M. Its columns of numbers are: {_listed(numeric)}")


def _listed(names: Iterable[str]) -> str:
    ordered = sorted(names)
    more = len(ordered) - MAX_LISTED
    return ", ".join(repr(name[:60]) for name in ordered[:MAX_LISTED]) + (
        f" and {more} more" if more > 0 else "") or "(none)"
