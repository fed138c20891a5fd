"""Reader of GeoParquet [1]: geometries in well-known binary, read by pyarrow.

[1] https://geoparquet.org/releases/v1.1.0
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shapely

from radiotwin.budgets import DOCUMENT_BYTES, FEATURES
from radiotwin.cells import read_cells, require_pyarrow
from radiotwin.errors import BadInput
from radiotwin.footprints.features import MapFile
from radiotwin.footprints.gis_files import area_of_wkb, map_file
from radiotwin.footprints.systems import WGS84, chosen_system
from radiotwin.inputs import open_input, parse_json


def read_geoparquet(path: Path, crs: str | None = None) -> MapFile:
    """Read the polygons of a GeoParquet file, in any coordinate reference system.

    Nested columns, such as the names and sources of Overture Maps, are left out.

    Args:
        path: `.parquet` file.
        crs: coordinate reference system of a file that names none; None: longitude and latitude, as
            [1] has it, or where it says that the system is not known, refuse it.

    Raises:
        BadInput: no such file, no GeoParquet, damaged, or too large; no pyarrow.
    """
    names, geometry, own = _schema(path)
    system = chosen_system(path, _name(path, own) if own else None, crs)
    if own is None and system is None:
        system = WGS84[0]
    cells = read_cells(path, [geometry], names)
    columns = [name for name in cells.columns if name != geometry]
    values = [cells[name].tolist() for name in columns]

    def rows() -> Iterator[tuple[str, dict[str, Any], Any]]:
        for number, data in enumerate(cells[geometry], start=1):
            tags = {name: column[number - 1] for name, column in zip(columns, values)}
            yield (f"row {number}", tags,
                   area_of_wkb(data) if isinstance(data, bytes) else None)

    try:
        return map_file(path, rows(), system)
    except shapely.errors.GEOSException as error:
        raise BadInput(f"{path}: a geometry is damaged ({str(error)[:100]}); export it again"
                       ) from None


def _schema(path: Path) -> tuple[list[str], str, dict | str | None]:
    """Return the flat columns, that of the geometry, and its system: "" unknown, None default."""
    require_pyarrow(path)
    from pyarrow import ArrowException, types
    from pyarrow.parquet import ParquetFile

    with open_input(path, "GeoParquet file") as file:
        try:
            content = ParquetFile(file)
            schema = content.schema_arrow
            FEATURES.check(content.metadata.num_rows, path)
        except (ArrowException, OSError, ValueError) as error:
            raise BadInput(f"{path} cannot be read as Parquet ({str(error)[:200]}); export it "
                           "again") from None
    text = (schema.metadata or {}).get(b"geo")
    if text is None:
        raise BadInput(f"{path} is Parquet without geometries (no metadata `geo`); export it as "
                       "GeoParquet")
    DOCUMENT_BYTES.check(len(text), f"{path}: its metadata")
    known = parse_json(text.decode("utf-8", "replace"), f"{path}: its metadata `geo`")
    try:
        geometry = str(known["primary_column"])
        column = known["columns"][geometry]
        if column["encoding"] != "WKB":
            raise BadInput(f"{path}: its geometries are encoded as {column['encoding']!r:.40}; "
                           "only WKB is read: export it again with that")
        own = column.get("crs")
        if own is None and "crs" in column:
            own = ""
        if not isinstance(own, dict | str | None) or geometry not in schema.names:
            raise TypeError
    except (KeyError, TypeError):
        raise BadInput(f"{path}: its metadata `geo` is not as GeoParquet has it (primary_column, "
                       "and of that encoding and crs); export it again") from None
    names = [field.name for field in schema if not types.is_nested(field.type)]
    return names, geometry, own


def _name(path: Path, own: dict | str) -> str:
    """Return the name of a system in PROJ's JSON: authority and code, else WKT."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if isinstance(own, str):
        return own
    known = own.get("id")
    if isinstance(known, dict) and {"authority", "code"} <= known.keys():
        return f"{known['authority']}:{known['code']}"
    try:
        return CRS.from_json_dict(own).to_wkt()
    except CRSError as error:
        raise BadInput(f"{path}: its coordinate reference system is unknown ({error!s:.100}); "
                       "export it in EPSG:4326") from None
