"""Coverage as vectors: a GeoPackage with the areas of each class, and the transmitters."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from radiotwin.coverage.legends import drawn_rasters, file_stem, legend_of
from radiotwin.coverage.run import Coverage
from radiotwin.errors import BadInput
from radiotwin.export.geotiff import georeference
from radiotwin.files import atomic_path
from radiotwin.geodesy import to_geographic
from radiotwin.scene import Scene

DEGREES = "EPSG:4326"


def require_vectors(path: Path) -> Any:
    """Return the packages rasterio's features and pyogrio.

    Args:
        path: of the GeoPackage, for the message.

    Raises:
        BadInput: one is not installed.
    """
    try:
        import pyogrio
        from rasterio import features
    except ImportError as error:
        raise BadInput(f"{path}: GeoPackages are written with the packages rasterio and pyogrio, "
                       f"and {error.name} is not installed; install both with `pip install "
                       "'radiotwin[gis]'`") from None
    return features, pyogrio


def write_geopackage(coverage: Coverage, scene: Scene, path: Path) -> None:
    """Write a layer for each raster, with a multipolygon for each class, and one of transmitters.

    Coordinates are WGS84 degrees; local metres, without a system, where the scene has no origin.

    Args:
        coverage: of the network.
        scene: whose origin places it on the globe.
        path: of the .gpkg file.

    Raises:
        BadInput: a package is not installed.
    """
    features, pyogrio = require_vectors(path)
    grid, origin = coverage.grid, scene.config.origin
    transform = georeference(grid.x_m, grid.y_m, grid.step_m, origin)["transform"]

    def project(points: np.ndarray) -> np.ndarray:
        return points if origin is None else np.column_stack(to_geographic(origin, *points.T))

    with atomic_path(path) as temporary:
        temporary.unlink()
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
            _write(pyogrio, temporary, file_stem(name), shapely.transform(areas, project),
                   "MultiPolygon", columns, origin is not None)
        placed = [each for each in coverage.transmitters if np.isfinite(each.position_m).all()]
        power_dbm = {each["device"]: each["tx_power_dbm"]
                     for each in coverage.summary["transmitters"]}
        position_m = np.array([each.position_m for each in placed]).reshape(-1, 3)
        columns = {"device": np.array([each.name for each in placed], object),
                   "z_m": position_m[:, 2],
                   "tx_power_dbm": np.array([power_dbm[each.name] for each in placed], float)}
        _write(pyogrio, temporary, "transmitters",
               np.asarray(shapely.points(project(position_m[:, :2]))), "Point", columns,
               origin is not None)


def _write(pyogrio: Any, path: Path, layer: str, shapes: np.ndarray, kind: str,
           columns: dict[str, np.ndarray], is_placed: bool) -> None:
    """Add a layer to a GeoPackage."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)
        pyogrio.raw.write(path, shapely.to_wkb(shapes), list(columns.values()), list(columns),
                          layer=layer, driver="GPKG", geometry_type=kind, append=path.exists(),
                          crs=DEGREES if is_placed else None)
