"""Write a coverage prediction as tables, NetCDF, GeoTIFF, KMZ and GeoPackage.

The GeoPackage (OGC 12-128r18, version 1.3) has the area of each class as polygons, and the
transmitters as points. It is built in memory by SQLite: GDAL ignores some errors of a full disk and
writes the time of day, so its bytes would differ from run to run.
"""

import io
import json
import sqlite3
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
import xarray as xr
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from pyproj import CRS

from radiotwin.coverage.areas import class_bounds
from radiotwin.coverage.run import Coverage
from radiotwin.errors import BadInput
from radiotwin.geo import local_crs, to_geographic
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_file
from radiotwin.maps.export.geotiff import (
    GDAL_OPTIONS,
    georeference,
    require_origin,
    require_rasterio,
)
from radiotwin.maps.export.kmz import OPACITY, Overlay, enlarged_png, write_overlays
from radiotwin.scene import Scene

BELOW_COLOUR = "#c9c9c9"
SERVER_COLOURS = "tab20"
GREYS = 14, 15  # colours of that palette not used: buildings are grey
# Title; unit in labels; factor from the raster's unit to that; colour map from bad to good.
_RASTERS: dict[str, tuple[str, str, float, str]] = {
    "received_power_dbm": ("Received power", "dBm", 1.0, "RdYlGn"),
    "sinr_db": ("SINR", "dB", 1.0, "RdYlGn"),
    "snr_db": ("SNR", "dB", 1.0, "RdYlGn"),
    "rate_bps": ("Rate of one user", "Mbit/s", 1e-6, "viridis"),
    "coverage_probability": ("Probability of coverage", "%", 100.0, "RdYlGn")}


@dataclass(frozen=True, eq=False)
class Legend:
    """Classes of a raster, with labels and colours; maps, overlays and vectors share them.

    Attributes:
        title: of the raster.
        lower: (k,) descending lower ends of all classes but the last; empty for best servers.
        labels: one for each class, the best first; the last class is below all lower ends.
        colours: one for each class, `#rrggbb`.
    """

    title: str
    lower: tuple[float, ...]
    labels: tuple[str, ...]
    colours: tuple[str, ...]

    def classes(self, values: np.ndarray) -> np.ndarray:
        """Return the class index of each value (0: the highest class), any shape; -1 for NaN.

        Values of best servers are such indices already.
        """
        if not self.lower:
            return values.astype(np.int32)
        ends = np.asarray(self.lower[::-1], dtype=float)
        found = len(ends) - np.searchsorted(ends, np.nan_to_num(values), side="right")
        return np.where(np.isnan(values), -1, found).astype(np.int32)


def legend_of(name: str, coverage: Coverage) -> Legend:
    """Return a raster's legend: title, and lower ends, labels and colours of its classes."""
    if name == "best_server":
        palette = colormaps[SERVER_COLOURS].colors  # type: ignore[attr-defined]
        both = [*range(0, len(palette), 2), *range(1, len(palette), 2)]  # strong before pale
        order = [each for each in both if each not in GREYS]
        names = [each.name for each in coverage.transmitters]
        colours = [to_hex(palette[order[row % len(order)]]) for row in range(len(names))]
        return Legend("Best server", (), tuple(names), tuple(colours))
    title, unit, factor, colours_name = _RASTERS[name]
    lower = class_bounds(coverage.settings, coverage.dataset.attrs["bandwidth_hz"])[name]
    shown = [f"{each * factor:.4g}".replace("-", "−") for each in lower]
    if name == "coverage_probability":
        title += f", received power ≥ {coverage.settings.threshold_dbm:g} dBm".replace("-", "−")
    shades = colormaps[colours_name](np.linspace(0.95, 0.05, len(lower)))
    return Legend(title, lower, (*(f"≥ {each} {unit}" for each in shown), f"< {shown[-1]} {unit}"),
                  (*map(to_hex, shades), BELOW_COLOUR))


def drawn_rasters(coverage: Coverage) -> Sequence[str]:
    """Return the names of the rasters to draw, in order."""
    return [name for name in ("received_power_dbm", "best_server", "sinr_db", "rate_bps",
                              "coverage_probability") if name in coverage.dataset]


def file_stem(name: str) -> str:
    """Return the name of a raster's files without suffix, such as `received_power`."""
    for ending in ("_dbm", "_db", "_bps"):
        name = name.removesuffix(ending)
    return name


LEGEND_ROWS = 24  # at most so many servers in a legend
RASTERS = ("received_power_dbm", "received_power_sd_db", "best_server", "snr_db", "sinr_db",
           "rate_bps", "coverage_probability")


def _write_geopackage(coverage: Coverage, scene: Scene, path: Path) -> None:
    """Write a layer of a multipolygon per class for each drawn raster, and transmitters' points."""
    require_rasterio(path)
    from rasterio import features

    grid, origin = coverage.grid, scene.config.origin
    transform = georeference(grid.x_m, grid.y_m, grid.step_m, origin)["transform"]

    def project(points: np.ndarray) -> np.ndarray:
        return points if origin is None else np.column_stack(to_geographic(origin, *points.T))

    layers = []
    for name in drawn_rasters(coverage):
        legend = legend_of(name, coverage)
        classes = legend.classes(coverage.dataset[name].values)[::-1]
        parts: dict[int, list] = {}
        for outline, number in features.shapes(classes, mask=classes >= 0, connectivity=4,
                                               transform=transform):
            parts.setdefault(int(number), []).append(shapely.geometry.shape(outline))
        numbers = sorted(parts)
        areas = [shapely.multipolygons(parts[number]) for number in numbers]
        lower = np.array([legend.lower[number] if number < len(legend.lower) else np.nan
                          for number in numbers])
        columns = {"class": np.array([legend.labels[number] for number in numbers], object),
                   "colour": np.array([legend.colours[number] for number in numbers], object),
                   "minimum": lower, "area_m2": shapely.area(areas)}
        layers.append(Layer(file_stem(name), "MULTIPOLYGON", shapely.transform(areas, project),
                            columns))
    located = [each for each in coverage.transmitters if np.isfinite(each.position_m).all()]
    power_dbm = {each["device"]: each["tx_power_dbm"] for each in coverage.summary["transmitters"]}
    position_m = np.array([each.position_m for each in located]).reshape(-1, 3)
    columns = {"device": np.array([each.name for each in located], object),
               "z_m": position_m[:, 2],
               "tx_power_dbm": np.array([power_dbm[each.name] for each in located], float)}
    layers.append(Layer("transmitters", "POINT",
                        np.asarray(shapely.points(project(position_m[:, :2]))), columns))
    with atomic_file(path) as file:
        file.write(geopackage(layers, origin is not None))


def write_tables(coverage: Coverage, folder: Path) -> None:
    """Write the summary as `coverage.json`, and covered shares as rows of `coverage.csv`."""
    with atomic_file(folder / "coverage.json") as file:
        file.write(json.dumps(coverage.summary, indent=1, allow_nan=False,
                              ensure_ascii=False).encode())
    with atomic_file(folder / "coverage.csv") as file:
        write_csv(_share_table(coverage), file)


def _share_table(coverage: Coverage) -> pd.DataFrame:
    """Return a row for each area, quantity and threshold: covered share and square metres."""
    rows = []
    for area in coverage.summary["areas"]:
        for quantity in ("received_power_dbm", "snr_db", "sinr_db", "rate_bps"):
            rows += [{"area": area["area"], "quantity": quantity, **each,
                      "area_m2": each["share"] * area["area_m2"]} for each in area[quantity]]
        rows += [{"area": area["area"], "quantity": "best_server", "device": name, "share": share,
                  "area_m2": share * area["area_m2"]}
                 for name, share in area["best_server"].items()]
    columns = ["area", "quantity", "device", "threshold", "share", "share_reliable",
               "mean_probability", "area_m2"]
    return pd.DataFrame(rows).reindex(columns=columns)


def _write_netcdf(coverage: Coverage, scene: Scene, path: Path) -> None:
    """Write all rasters as NetCDF-4 after the CF conventions, for `xarray.open_dataset`."""
    dataset, origin = coverage.dataset.copy(), scene.config.origin
    dataset["indoor"] = dataset["indoor"].astype(np.int8)
    dataset.attrs["Conventions"] = "CF-1.11"
    if origin is not None:
        for name in dataset.data_vars:
            dataset[name].attrs["grid_mapping"] = "crs"
        dataset["crs"] = xr.Variable((), np.int32(0), CRS(local_crs(origin)).to_cf())
    rasters = [name for name in (*RASTERS, "indoor") if name in dataset]
    data = io.BytesIO()
    dataset.to_netcdf(data, engine="h5netcdf", encoding={
        **{name: {"compression": "gzip", "compression_opts": 4} for name in rasters},
        **{axis: {"_FillValue": None} for axis in "xy"}})
    with atomic_file(path) as file:
        file.write(data.getbuffer())


def _write_geotiffs(coverage: Coverage, scene: Scene, folder: Path) -> None:
    """Write each raster as a GeoTIFF of one band, north up; no data is NaN, or server -1."""
    rasterio = require_rasterio(folder / "received_power.tif")
    grid = coverage.grid
    tags = {name: str(value) for name, value in coverage.dataset.attrs.items()}
    tags |= {f"server_{row}": each.name for row, each in enumerate(coverage.transmitters)}
    for name in RASTERS:
        if name not in coverage.dataset:
            continue
        variable = coverage.dataset[name]
        is_server = name == "best_server"
        with rasterio.Env(**GDAL_OPTIONS), rasterio.MemoryFile(ext=".tif") as memory:
            with memory.open(
                    driver="GTiff", dtype=variable.dtype, count=1, height=grid.shape[0],
                    width=grid.shape[1], nodata=-1 if is_server else np.nan, compress="deflate",
                    **georeference(grid.x_m, grid.y_m, grid.step_m, scene.config.origin)) as file:
                file.write(variable.values[::-1], 1)
                file.update_tags(**tags)
                file.units = [variable.attrs.get("units", "")]
                file.set_band_description(1, variable.attrs["long_name"])
            with atomic_file(folder / f"{file_stem(name)}.tif") as out:
                out.write(memory.getbuffer())


def _write_kmz(coverage: Coverage, scene: Scene, path: Path) -> None:
    """Write each drawn raster as an overlay in the colours of its classes, for Google Earth."""
    legends = {name: legend_of(name, coverage) for name in drawn_rasters(coverage)}

    def draw(name: str, legend: Legend) -> bytes:
        classes = legend.classes(coverage.dataset[name].values)
        colours = (to_rgba_array(legend.colours) * 255).astype(np.uint8)
        pixels = colours[np.maximum(classes, 0)]
        pixels[..., 3] = np.where(classes >= 0, OPACITY, 0)
        return enlarged_png(pixels)

    overlays = [Overlay("coverage", legend.title, not row, partial(draw, name, legend))
                for row, (name, legend) in enumerate(legends.items())]
    marks = {each.name: (float(each.position_m[0]), float(each.position_m[1]))
             for each in coverage.transmitters if np.isfinite(each.position_m).all()}
    write_overlays(path, scene, coverage.grid.bounds_m, overlays, marks,
                   _legend_png([*legends.values()]))


def _legend_png(legends: list[Legend]) -> bytes:
    """Draw all legends below each other, of up to `LEGEND_ROWS` labels each; return the PNG."""
    rows = [min(len(each.labels), LEGEND_ROWS) + 1.6 for each in legends]
    figure = Figure(figsize=(2.3, 0.2 * sum(rows) + 0.1), facecolor="white")
    FigureCanvasAgg(figure)
    top = 1.0
    for each, height in zip(legends, rows):
        patches = [Patch(color=colour, label=label.replace("$", r"\$"))
                   for label, colour in zip(each.labels[:LEGEND_ROWS], each.colours)]
        figure.legend(handles=patches, title=each.title.replace(", ", ",\n"), loc="upper left",
                      bbox_to_anchor=(0.0, top), frameon=False, fontsize=8, title_fontsize=8,
                      alignment="left")
        top -= height / sum(rows)
    data = io.BytesIO()
    figure.savefig(data, dpi=90, format="png")
    return data.getvalue()


def available_formats(scene: Scene, wanted: list[str] | None) -> tuple[list[str], list[str]]:
    """Return the formats that can be written for a scene, and the reasons why others cannot.

    `wanted` None stands for all formats. BadInput if a wanted one is unknown or cannot be written.
    """
    for name in wanted or ():
        if name not in FORMATS:
            raise BadInput(f"unknown format {name!r}; allowed are {', '.join(FORMATS)}")
    usable, notes = [], []
    for name in wanted or FORMATS:
        try:
            FORMATS[name](scene)
            usable.append(name)
        except BadInput as error:
            if wanted:
                raise
            notes.append(str(error))
    return usable, notes


def write_formats(coverage: Coverage, scene: Scene, folder: Path, formats: list[str]) -> None:
    """Write rasters and vectors in some `FORMATS` to a folder; `radiotwin.report` writes `png`."""
    if "nc" in formats:
        _write_netcdf(coverage, scene, folder / "coverage.nc")
    if "tif" in formats:
        _write_geotiffs(coverage, scene, folder)
    if "gpkg" in formats:
        _write_geopackage(coverage, scene, folder / "coverage.gpkg")
    if "kmz" in formats:
        _write_kmz(coverage, scene, folder / "coverage.kmz")


FORMATS: dict[str, Callable[[Scene], object]] = {
    "nc": lambda scene: None, "tif": lambda scene: require_rasterio(Path("received_power.tif")),
    "gpkg": lambda scene: require_rasterio(Path("coverage.gpkg")),
    "kmz": lambda scene: require_origin(scene, "coverage.kmz: Google Earth needs"),
    "png": lambda scene: None}
"""Formats by name, each with a check that raises BadInput if a scene cannot be written so."""
FILES = frozenset({
    "coverage.json", "coverage.csv", "coverage.nc", "coverage.gpkg", "coverage.kmz",
    *(f"{file_stem(name)}{suffix}" for name in RASTERS for suffix in (".tif", ".png"))})
"""Names of all files that `coverage` writes to its folder."""

_APPLICATION, _VERSION = 0x47504B47, 10300  # "GPKG" (requirement 2)
_CARTESIAN, _DEGREES = -1, 4326
_CHANGED = "1970-01-01T00:00:00.000Z"  # of every layer
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
 organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
 description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
 identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT
 (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
 srs_id INTEGER, CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES
 gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
 geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
 CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
 CONSTRAINT uk_gc_table_name UNIQUE (table_name),
 CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
 CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""  # annex C


@dataclass(frozen=True)
class Layer:
    """A layer of a GeoPackage: n features of one geometry type.

    Attributes:
        name: of the layer.
        kind: geometry type, such as MULTIPOLYGON.
        shapes: (n,) shapely geometries, in longitude and latitude [degrees] or in metres.
        columns: attributes (n,) by name, texts or numbers; NaN is null.
    """

    name: str
    kind: str
    shapes: np.ndarray
    columns: Mapping[str, np.ndarray]


def geopackage(layers: Iterable[Layer], in_degrees: bool) -> bytes:
    """Return the bytes of a GeoPackage; equal layers give equal bytes.

    Names of layers and columns must be SQL identifiers. Coordinates are WGS84 degrees if
    `in_degrees`, else metres of a local frame.
    """
    system = _DEGREES if in_degrees else _CARTESIAN
    with closing(sqlite3.connect(":memory:")) as database:
        database.executescript(
            f"PRAGMA application_id={_APPLICATION}; PRAGMA user_version={_VERSION}; {_TABLES}")
        database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", [
            ("Undefined Cartesian SRS", _CARTESIAN, "NONE", -1, "undefined", None),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            ("WGS 84 geodetic", _DEGREES, "EPSG", 4326,
             CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), "longitude and latitude")])
        for layer in layers:
            kinds = ["TEXT" if values.dtype == object else "REAL"
                     for values in layer.columns.values()]
            columns = "".join(f', "{name}" {kind}' for name, kind in zip(layer.columns, kinds))
            bounds = shapely.total_bounds(layer.shapes).tolist()  # NaN, so null, without a shape
            database.execute(f'CREATE TABLE "{layer.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT '
                             f"NOT NULL, geom {layer.kind}{columns})")
            database.execute("INSERT INTO gpkg_contents VALUES (?,'features',?,'',?,?,?,?,?,?)",
                             (layer.name, layer.name, _CHANGED, *bounds, system))
            database.execute("INSERT INTO gpkg_geometry_columns VALUES (?,'geom',?,?,0,0)",
                             (layer.name, layer.kind, system))
            database.executemany(
                f'INSERT INTO "{layer.name}" VALUES (NULL,?{",?" * len(kinds)})',
                zip(_blobs(layer.shapes, system), *(v.tolist() for v in layer.columns.values())))
        database.commit()
        return database.serialize()


def _blobs(shapes: np.ndarray, system: int) -> list[bytes]:
    """Encode geometries as GeoPackage blobs (clause 2.1.3): header with bounds, then WKB."""
    bounds = shapely.bounds(shapes)[:, [0, 2, 1, 3]]
    return [struct.pack("<2sBBi4d", b"GP", 0, 0b11, system, *box) + body
            for box, body in zip(bounds, shapely.to_wkb(shapes, byte_order=1))]
