"""Reader of ESRI Shapefiles [1]: a folder's `.shp`, `.dbf` and `.prj`, or a ZIP archive of them.

Polygons are outlines, multipatches are buildings in three dimensions. The bytes are read from the
named files, or from the archive in memory, and parsed by pyshp, which is plain Python and opens no
file by itself. GDAL would judge a file by its content, and could be led to others.

[1] https://www.esri.com/library/whitepapers/pdfs/shapefile.pdf
"""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.errors import BadInput, optional_package
from radiotwin.io.budgets import COLUMNS, ENTRIES, FEATURES, FILE_BYTES, OUTLINE_CORNERS, VERTICES
from radiotwin.io.inputs import open_input, read_bytes, require_within
from radiotwin.scene.checks import Problem, listed
from radiotwin.scene.readers.city_objects import (
    CityObject,
    Geometry,
    Polygon,
    city_features,
)
from radiotwin.scene.readers.features import MapFile
from radiotwin.scene.readers.gis_files import map_file
from radiotwin.scene.readers.heights import full_names
from radiotwin.scene.readers.layers import choose_layers, join_layers
from radiotwin.scene.readers.systems import (
    chosen_system,
    degrees_from,
    find_system,
    plane_of,
    vertical_unit_m,
)

MULTIPATCH = 31
_STRIP, _FAN, _OUTER, _INNER, _FIRST, _RING = range(6)  # kinds of a part [1]
_FOLLOWS = {_INNER: _OUTER, _RING: _FIRST}  # a ring, and the kind that begins its surface
_LOD = 2.0  # of a building with its roof, in the words of CityGML
_PARTS = (".shp", ".dbf", ".prj", ".cpg")
_MAGIC, _HEADER = 9994, 100  # file code and length of the header [bytes] [1]
_POLYGONS = (0, 5, 15, 25)  # null, Polygon, PolygonZ, PolygonM [1]
_AREAS = (*_POLYGONS[1:], MULTIPATCH)
_CODECS = {"utf-8": "utf-8", "utf8": "utf-8", "65001": "utf-8", "1252": "cp1252",
           "cp1252": "cp1252", "ansi 1252": "cp1252", "windows-1252": "cp1252",
           "88591": "iso-8859-1", "iso-8859-1": "iso-8859-1", "iso88591": "iso-8859-1"}
_ERRORS = (struct.error, ValueError, LookupError, TypeError, AttributeError, AssertionError,
           EOFError, OSError, OverflowError, shapely.errors.GEOSException)


def _multipatch_buildings(path: Path, rows: Iterable[tuple[str, Mapping, Any]],
                          system: str) -> MapFile:
    """Convert multipatches (3D surfaces), rows (name, columns, surfaces), to buildings."""
    known = find_system(path, system)
    project, unit_m = degrees_from(path, plane_of(known)), vertical_unit_m(known)
    objects = []
    for name, columns, surfaces in rows:
        rings = [ring for surface in surfaces for ring in surface]
        if rings:
            corners = np.concatenate(rings)
            corners[:, :2] = project(corners[:, :2])
            corners[:, 2] *= unit_m
            placed = iter(np.split(corners, np.cumsum([len(ring) for ring in rings])[:-1]))
            surfaces = [[next(placed) for _ in surface] for surface in surfaces]
        attributes = {str(key).lower(): f"{value:g}" if isinstance(value, float) else str(value)
                      for key, value in columns.items() if value is not None}
        objects.append(CityObject(name, "Building", attributes, "", [Geometry(_LOD, surfaces)]))
    return city_features(path, objects, ["OGC:CRS84"])


def _multipatch_polygons(shape: Any) -> list[Polygon]:
    """Return a multipatch's polygons: strips and fans as triangles, rings with their holes."""
    found: list[Polygon] = []
    outline = None  # kind of the last ring that may have holes
    for part, kind in zip(_parts(shape, getattr(shape, "z", ())), getattr(shape, "partTypes", ())):
        if kind in (_STRIP, _FAN):
            found += [[part[[0 if kind == _FAN else i, i + 1, i + 2]]]
                      for i in range(len(part) - 2)]
            outline = None
            continue
        ring = part[:-1] if len(part) > 1 and (part[0] == part[-1]).all() else part
        if outline is not None and _FOLLOWS.get(kind) == outline:
            found[-1].append(ring)
        else:
            found.append([ring])
            outline = kind
    return found


def _parts(shape: Any, *others: Any) -> list[np.ndarray]:
    """Return the corners (n, 2) of each part of a shape, with columns for `others`, such as z.

    Raises:
        ValueError: a coordinate is not finite, or a part begins outside the shape.
    """
    starts = list(shape.parts)
    corners = np.column_stack([
        np.array([point[:2] for point in shape.points], dtype=float).reshape(-1, 2),
        *(np.array(values, dtype=float) for values in others)])
    if not np.isfinite(corners).all():
        raise ValueError("a coordinate is not finite")
    if starts != sorted(starts) or starts and not 0 <= starts[0] <= starts[-1] <= len(corners):
        raise ValueError("a part begins outside its shape")
    return np.split(corners, starts[1:])


def read_shapefile(path: Path, crs: str | None = None, wanted: Sequence[str] = ()) -> MapFile:
    """Read the polygons or multipatches of a Shapefile, in any coordinate reference system.

    Args:
        path: `.shp` file with `.dbf` and `.prj` beside it, or `.zip` archive of one or more.
        crs: coordinate reference system of a file without `.prj`; None: refuse it.
        wanted: names of Shapefiles in an archive; empty: those that hold buildings, see
            `choose_layers`.

    Raises:
        BadInput: no such file, one of the three missing, cut off or damaged, or too large.
    """
    layers = (_read_archive(path) if path.suffix.lower() == ".zip"
              else {path.stem: _read_folder(path)})
    chosen: list[str] = list(layers)
    problems: list[Problem] = []
    others: tuple[str, ...] = ()
    if len(layers) > 1:
        areas = {name: files for name, files in layers.items() if _shape_type(files) in _AREAS}
        chosen, problems = choose_layers(
            path, {name: _columns(path, name, files) for name, files in (areas or layers).items()},
            wanted)
        others = tuple(name for name in layers if areas and name not in areas)
    elif wanted:
        raise BadInput(f"{path} is one Shapefile, without layers; leave --layer out")
    parts = {}
    for name in chosen:
        files = layers[name]
        for suffix in (".shp", ".dbf"):
            if suffix not in files:
                raise BadInput(f"{path}: the Shapefile {name} has no {suffix}; keep its .shp, "
                               ".dbf and .prj together")
        if ".prj" not in files and crs is None:
            raise BadInput(f"{path}: the Shapefile {name} has no .prj, which names its coordinate "
                           "reference system; keep it beside the .shp, or declare --crs, such as "
                           "--crs EPSG:25832")
        system = chosen_system(path, _text(files[".prj"]) if ".prj" in files else None, crs)
        assert system is not None
        is_patch = _shape_type(files) == MULTIPATCH
        rows = _rows(path, name, files, _multipatch_polygons if is_patch else _polygons)
        parts[name] = (_multipatch_buildings if is_patch else map_file)(path, rows, system)
    return replace(join_layers(path, parts, problems), layers=others)


def _shape_type(files: Mapping[str, bytes]) -> int:
    """Return the type of a Shapefile's shapes [1]; -1 if the file is too short."""
    head = files[".shp"][32:36]
    return int.from_bytes(head, "little") if len(head) == 4 else -1


def _columns(path: Path, name: str, files: Mapping[str, bytes]) -> list[str]:
    """Return the names of a Shapefile's columns; none without a .dbf."""
    shapefile = _pyshp(path)
    if ".dbf" not in files:
        return []
    try:
        with shapefile.Reader(dbf=io.BytesIO(files[".dbf"]), encodingErrors="replace") as reader:
            return [str(field[0]) for field in reader.fields]
    except (shapefile.ShapefileException, *_ERRORS) as error:
        raise BadInput(f"{path}, {name} is not a readable Shapefile ({error}); export it again"
                       ) from None


def _read_folder(path: Path) -> dict[str, bytes]:
    """Read the files of a Shapefile in a folder: suffix -> content."""
    files = {".shp": read_bytes(path, "Shapefile")}
    size = len(files[".shp"])
    for suffix in _PARTS[1:]:
        for beside in (path.with_suffix(suffix), path.with_suffix(suffix.upper())):
            if beside.exists():
                require_within(path.absolute().parent, beside, str(path))
                files[suffix] = read_bytes(beside, f"{suffix} of a Shapefile")
                size += len(files[suffix])
                FILE_BYTES.check(size, f"{path} with the files beside it")
                break
    return files


def _read_archive(path: Path) -> dict[str, dict[str, bytes]]:
    """Read the Shapefiles in a ZIP archive: name -> suffix -> content."""
    layers: dict[str, dict[str, bytes]] = {}
    names: list[str] = []
    read = 0
    try:
        with open_input(path, "ZIP archive of Shapefiles") as file, \
                zipfile.ZipFile(file) as archive:
            ENTRIES.check(len(archive.infolist()), path)
            names = archive.namelist()
            for info in archive.infolist():
                name = PurePosixPath(info.filename)
                if name.suffix.lower() not in _PARTS or name.parts[0] == "__MACOSX":
                    continue
                FILE_BYTES.check(read + info.file_size, f"{path}, unpacked")
                with archive.open(info) as member:
                    data = member.read(info.file_size + 1)
                read += len(data)
                layers.setdefault(str(name.with_suffix("")), {})[name.suffix.lower()] = data
    except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError, OSError,
            ValueError) as error:
        raise BadInput(f"{path} is not a readable ZIP archive ({error}); pack it again") from None
    found = {name: files for name, files in layers.items() if ".shp" in files}
    if not found:
        raise BadInput(f"{path} holds no .shp file; give an archive of a Shapefile, or unpack it "
                       f"and give what it holds ({listed(names)})")
    return found


def _text(data: bytes) -> str:
    """Decode a .prj or .cpg file."""
    return data.decode("utf-8-sig", "replace").strip("\0 \r\n\t")


def _pyshp(path: Path) -> Any:
    """Return the package pyshp; BadInput if it is not installed."""
    return optional_package(
        "shapefile", f"{path}: Shapefiles are read with the package pyshp, which is not installed; "
                     "install it with `pip install 'radiotwin[gis]'`")


def _rows(path: Path, name: str, files: Mapping[str, bytes], convert: Callable[[Any], Any]
          ) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Yield name, columns and shape (by `convert`) of each row that is not deleted or empty."""
    shapefile = _pyshp(path)
    subject = f"{path}, {name}"
    records = _check_records(subject, files[".shp"])
    codec = _CODECS.get(_text(files.get(".cpg", b"")).lower(), "utf-8")
    try:
        with shapefile.Reader(shp=io.BytesIO(files[".shp"]), dbf=io.BytesIO(files[".dbf"]),
                              encoding=codec, encodingErrors="replace") as reader:
            columns = [field[0].lower() for field in reader.fields if field[0] != "DeletionFlag"]
            COLUMNS.check(len(columns), subject)
            if reader.numRecords != records:
                raise ValueError(f"{records:,} shapes, but {reader.numRecords:,} rows")
            longer = full_names(columns)
            keys = [longer.get(column, column) for column in columns]
            for number, (shape, record) in enumerate(
                    zip(reader.iterShapes(), reader.iterRecords(deleted_as_None=True)), start=1):
                if record is not None and shape is not None:
                    yield f"{name} {number}", dict(zip(keys, record)), convert(shape)
    except (shapefile.ShapefileException, *_ERRORS) as error:
        raise BadInput(f"{subject} is not a readable Shapefile ({error}); export it again"
                       ) from None


def _check_records(subject: str, data: bytes) -> int:
    """Return the number of shapes in a `.shp` file; BadInput if it is damaged or of other types."""
    if len(data) < _HEADER or struct.unpack(">i", data[:4])[0] != _MAGIC:
        raise BadInput(f"{subject} is not a readable Shapefile (its .shp begins otherwise); export "
                       "it again")
    kind, = struct.unpack("<i", data[32:36])
    if kind not in (*_POLYGONS, MULTIPATCH):
        raise BadInput(f"{subject} is a Shapefile of type {kind}, which is none of polygons "
                       "(5, 15 or 25) or multipatches (31); export the outlines of buildings as "
                       "polygons")
    at, records = _HEADER, 0
    while at < len(data):
        length = 2 * struct.unpack(">i", data[at + 4:at + 8])[0] if at + 8 <= len(data) else 0
        records += 1
        if length < 4 or at + 8 + length > len(data):
            raise BadInput(f"{subject}: shape {records} is cut off or damaged; export or fetch the "
                           "Shapefile again")
        at += 8 + length
    FEATURES.check(records, subject)
    VERTICES.check(len(data) / 16, subject)
    return records


def _polygons(shape: Any) -> BaseGeometry | None:
    """Return the polygons of a shape: rings that turn as its largest are outlines, others holes.

    Outlines run clockwise [1], but some writers reverse all rings. A hole goes to the smallest
    outline around it, or is dropped.
    """
    parts = _parts(shape)
    if sum(map(len, parts)) > OUTLINE_CORNERS.limit:  # refused later, if it is in the box
        return shapely.Polygon(np.concatenate(parts))
    rings = [ring for ring in parts if len(ring) > 3]
    turns = np.array([_turn(ring) for ring in rings])
    if turns.max(initial=0.0) > -turns.min(initial=0.0):  # all rings are reversed
        turns = -turns
    outlines = [shapely.Polygon(ring) for ring, turn in zip(rings, turns) if turn <= 0]
    holes = [ring for ring, turn in zip(rings, turns) if turn > 0]
    held: list[list[np.ndarray]] = [[] for _ in outlines]
    around = shapely.STRtree([shapely.box(*outline.bounds) for outline in outlines])
    for ring in holes:
        inside = around.query(shapely.box(*shapely.Polygon(ring).bounds), predicate="within")
        if len(inside):
            smallest = min(inside.tolist(), key=lambda index: abs(outlines[index].area))
            held[smallest].append(ring)
    area = _with_courtyards(shapely.MultiPolygon([(outline.exterior.coords, rings)
                                                  for outline, rings in zip(outlines, held)]))
    return shapely.force_3d(area, 1.0) if any(getattr(shape, "z", ())) else area


def _with_courtyards(area: shapely.MultiPolygon) -> BaseGeometry:
    """Turn polygons inside the largest one into holes: some writers orient all rings alike."""
    parts = sorted(area.geoms, key=lambda part: -part.area)
    if area.is_valid or parts[0].bounds != area.bounds:
        return area
    rings = shapely.get_rings(parts)
    return shapely.Polygon(rings[0], rings[1:])


def _turn(ring: np.ndarray) -> float:
    """Return twice the signed area of a ring, positive if it runs counter-clockwise."""
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
