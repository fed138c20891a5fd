"""The grid of a coverage map, and covered shares of the extent and of polygons.

A receiver is in the middle of each cell, at a height above the ground.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import xarray as xr
from scipy.special import ndtri
from shapely.geometry.base import BaseGeometry

from radiotwin.coverage.radio import CoverageSettings, location_probability
from radiotwin.coverage.transmitters import Transmitter
from radiotwin.errors import BadInput
from radiotwin.geo import to_local
from radiotwin.io.budgets import COVERAGE_CELLS
from radiotwin.maps.export.geotiff import require_origin
from radiotwin.scene import Scene
from radiotwin.scene.citymap import GROUND_M, CityMap
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.readers.gis_files import read_geojson
from radiotwin.scene.surfaces import Surfaces

BLOCK_CELLS = 100_000  # cells predicted at a time: bounds memory
SINR_CLASSES_DB = (20.0, 13.0, 0.0, -5.0)  # excellent, good, fair, poor, as in drive-test reports
RATE_CLASSES = (0.9, 0.5, 0.25, 0.1)  # lower ends, as shares of the maximum rate
PROBABILITY_CLASSES = (0.95, 0.9, 0.75, 0.5)


@dataclass(frozen=True, eq=False)
class CoverageGrid:
    """Grid of square cells, with a receiver in the middle of each.

    Attributes:
        x_m: (nx,) middles of the cells, ascending [m].
        y_m: (ny,) likewise [m].
        step_m: side of a cell [m].
        height_m: of the receivers [m].
        above_ground: whether the height counts from the ground, else from the datum.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    step_m: float
    height_m: float
    above_ground: bool = True

    @classmethod
    def over(cls, bounds_m: tuple[float, float, float, float], step_m: float,
             height_m: float) -> "CoverageGrid":
        """Fill an area (x_min, x_max, y_min, y_max) [m] with cells from its south-west corner.

        Receivers are at `height_m` above the ground [m]. A strip in the north or east that
        is narrower than a cell is left out. BadInput if no cell fits, or there are too many.
        """
        x_min, x_max, y_min, y_max = bounds_m
        nx, ny = (np.floor((high - low) / step_m + 1e-9)
                  for low, high in ((x_min, x_max), (y_min, y_max)))
        COVERAGE_CELLS.check(nx * ny, f"cells of {step_m:g} m over {x_max - x_min:g} x "
                                      f"{y_max - y_min:g} m")
        if not (nx and ny):
            raise BadInput(f"no cell of {step_m:g} m fits into an area of {x_max - x_min:g} x "
                           f"{y_max - y_min:g} m; choose a smaller step")
        return cls(x_min + step_m * (np.arange(nx) + 0.5), y_min + step_m * (np.arange(ny) + 0.5),
                   step_m, height_m)

    @classmethod
    def of_map(cls, lattice: Lattice, level: int) -> "CoverageGrid":
        """Return cells centred on the positions of a radio map, at the altitude of index `level`.

        BadInput if the positions are not evenly spaced, or too many.
        """
        step_m = lattice.step_m
        if not step_m or any(not np.allclose(np.diff(axis), step_m, rtol=0, atol=1e-6 * step_m)
                             for axis in (lattice.x_m, lattice.y_m)):
            raise BadInput("the radio map's positions are not equally far apart, so that shares of "
                           "an area cannot be told; make a map with one step")
        COVERAGE_CELLS.check(len(lattice.x_m) * len(lattice.y_m), "the radio map's positions")
        return cls(lattice.x_m, lattice.y_m, step_m, float(lattice.z_m[level]),
                   lattice.ground_m is not None)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along y and x."""
        return len(self.y_m), len(self.x_m)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Outer borders of the cells (x_min, x_max, y_min, y_max) [m]."""
        half_m = self.step_m / 2
        return (float(self.x_m[0] - half_m), float(self.x_m[-1] + half_m),
                float(self.y_m[0] - half_m), float(self.y_m[-1] + half_m))

    def blocks(self) -> Iterator[slice]:
        """Yield slices of rows: as many as `BLOCK_CELLS` cells allow, at least one."""
        rows = max(1, BLOCK_CELLS // len(self.x_m))
        for start in range(0, len(self.y_m), rows):
            yield slice(start, min(start + rows, len(self.y_m)))

    def receivers_m(self, rows: slice, city: CityMap) -> np.ndarray:
        """Return positions (n, 3) [m] of the receivers in a slice of rows, see `at_height`."""
        x, y = (each.ravel() for each in np.meshgrid(self.x_m, self.y_m[rows]))
        return self.at_height(x, y, city)

    def at_height(self, x_m: np.ndarray, y_m: np.ndarray, city: CityMap) -> np.ndarray:
        """Return positions (n, 3) [m] at the receivers' height above a map's ground, or the datum.

        See `with_ground_as_terrain`.
        """
        bottom_m = city.ground_height_m(x_m, y_m) if self.above_ground else 0.0
        return np.column_stack([x_m, y_m, np.broadcast_to(bottom_m + self.height_m, x_m.shape)])


@lru_cache(maxsize=2)  # a map is large
def with_ground_as_terrain(city: CityMap) -> CityMap:
    """Return a 3D map whose ground triangles are terrain, so that heights count from the ground.

    It is the same map if it has terrain already, or if the ground is flat at z = 0.
    """
    if city.terrain is not None:
        return city
    ground = Surfaces([(city.vertices, city.faces)]).ground_faces()
    corners_m = city.vertices[city.faces[ground]]
    if not ground.any() or np.abs(corners_m[..., 2]).max() <= GROUND_M:
        return city
    return CityMap(city.vertices, city.faces, city.materials, city.material, city.vegetation,
                   ground, city.height_sd_m)


@dataclass(frozen=True, eq=False)
class Area:
    """A polygon to report the covered share of.

    Attributes:
        name: shown in tables.
        outline: polygon or multipolygon in the scene's frame [m].
    """

    name: str
    outline: BaseGeometry


def read_areas(path: Path | str, scene: Scene) -> list[Area]:
    """Read the polygons of a GeoJSON file.

    Args:
        path: `.geojson`, longitude and latitude unless it declares another system.
        scene: whose origin places them in the local frame.

    Raises:
        BadInput: no polygon, a scene without an origin, or a file that cannot be read.
    """
    path = Path(path)
    origin = require_origin(scene, f"{path}: its longitudes and latitudes need")
    features = read_geojson(path).features
    if not features:
        raise BadInput(f"{path} holds no polygon; draw the area as a polygon and export it as "
                       "GeoJSON")

    def project(points: np.ndarray) -> np.ndarray:
        placed_m = np.column_stack(to_local(origin, *points.T))
        if not (np.abs(points) <= (180, 90)).all() or not np.isfinite(placed_m).all():
            raise BadInput(f"{path}: an area has corners that are no longitude and latitude in "
                           "degrees; export it in EPSG:4326")
        return placed_m

    return [Area(each.tags.get("name", each.name),
                 shapely.make_valid(shapely.transform(each.area, project))) for each in features]


def class_bounds(settings: CoverageSettings, bandwidth_hz: float) -> dict[str, tuple[float, ...]]:
    """Return the lower ends of the classes of each raster, in its unit, descending."""
    top_bps = bandwidth_hz * settings.rate.max_bps_hz
    return {"received_power_dbm": settings.classes_dbm, "snr_db": SINR_CLASSES_DB,
            "sinr_db": SINR_CLASSES_DB, "rate_bps": tuple(top_bps * each for each in RATE_CLASSES),
            "coverage_probability": PROBABILITY_CLASSES}


def area_records(dataset: xr.Dataset, grid: CoverageGrid, transmitters: Sequence[Transmitter],
                 settings: CoverageSettings, classes: dict[str, tuple[float, ...]],
                 areas: Sequence[Area]) -> list[dict[str, Any]]:
    """Compute covered shares: a record of the whole extent, then one of each polygon.

    A cell belongs to an area if its middle does. Cells inside buildings do not count, unless there
    is an indoor loss. A cell where nothing is detected is below every threshold. `dataset` is as of
    `Coverage`, `classes` of `class_bounds`. BadInput if no cell of a polygon is predicted.
    """
    indoor = dataset["indoor"].values
    counted = np.ones_like(indoor) if settings.indoor_loss_db is not None else ~indoor
    if not counted.any():
        raise BadInput("every cell is inside a building; give --indoor-loss-db to predict there")
    records = [_area_record("extent", dataset, counted, grid, transmitters, settings, classes)]
    for area in areas:
        inside = cells_in(area.outline, grid)
        if not (inside & counted).any():
            reason = "all of its cells are inside buildings" if inside.any() else (
                "no cell's middle lies in it: it is outside the extent, or smaller than a cell")
            raise BadInput(f"area {area.name!r}: {reason}")
        record = _area_record(area.name, dataset, inside & counted, grid, transmitters, settings,
                              classes)
        records.append(record | {"outline_m2": float(area.outline.area),
                                 "cells_left_out_indoors": int((inside & ~counted).sum())})
    return records


def cells_in(outline: BaseGeometry, grid: CoverageGrid) -> np.ndarray:
    """Return a mask (ny, nx) of the cells whose middle is inside an outline."""
    shapely.prepare(outline)
    found = np.zeros(grid.shape, dtype=bool)
    for rows in grid.blocks():
        x, y = np.meshgrid(grid.x_m, grid.y_m[rows])
        found[rows] = shapely.contains_xy(outline, x, y)
    return found


def _area_record(name: str, dataset: xr.Dataset, mask: np.ndarray, grid: CoverageGrid,
                 transmitters: Sequence[Transmitter], settings: CoverageSettings,
                 classes: dict[str, tuple[float, ...]]) -> dict[str, Any]:
    """Compute the shares of one area, given its mask of cells (ny, nx); see `area_records`."""
    cell_m2, n = grid.step_m**2, int(mask.sum())
    power_dbm = dataset["received_power_dbm"].values[mask]
    sd_db = (dataset["received_power_sd_db"].values[mask].astype(float)
             if "received_power_sd_db" in dataset else None)
    thresholds = sorted({*settings.classes_dbm, settings.threshold_dbm}, reverse=True)
    record: dict[str, Any] = {
        "area": name, "cells": n, "area_m2": n * cell_m2, "step_m": grid.step_m,
        "received_power_dbm": [_covered_shares(power_dbm, sd_db, level_dbm, settings.reliability)
                               for level_dbm in thresholds]}
    for key in ("snr_db", "sinr_db", "rate_bps"):
        values = dataset[key].values[mask]
        record[key] = [{"threshold": level, "share": float((values >= level).mean())}
                       for level in classes[key]]
    record["mean_rate_bps"] = float(dataset["rate_bps"].values[mask].mean(dtype=float))
    servers = np.bincount(dataset["best_server"].values[mask] + 1,
                          minlength=len(transmitters) + 1)
    record["best_server"] = {each.name: float(count / n)
                             for each, count in zip(transmitters, servers[1:])}
    record["not_detected"] = float(servers[0] / n)
    return record


def _covered_shares(power_dbm: np.ndarray, sd_db: np.ndarray | None, threshold_dbm: float,
                    reliability: float) -> dict[str, float]:
    """Compute which share of cells reaches a threshold [dBm].

    `share` counts cells whose median power does, `share_reliable` those whose location probability
    is at least the reliability; `mean_probability` is its mean. Both leave out cells of unknown
    standard deviation, and are missing if that leaves none.
    """
    found = {"threshold": threshold_dbm, "share": float((power_dbm >= threshold_dbm).mean())}
    if sd_db is None:
        return found
    known = np.isnan(power_dbm) | np.isfinite(sd_db)
    if known.any():
        power_dbm, sd_db = power_dbm[known], sd_db[known]
        margin_db = float(ndtri(reliability)) * sd_db
        found["share_reliable"] = float((power_dbm - margin_db >= threshold_dbm).mean())
        found["mean_probability"] = float(np.nanmean(
            location_probability(power_dbm, sd_db, threshold_dbm)))
    return found
