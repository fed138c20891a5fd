"""Terrain that tests of several packages share: GeoTIFFs and 3D maps whose heights are plain formulas."""

import numpy as np

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.readers.terrain import HeightGrid, approximate

LAT_M, LON_M = 110_608, 109_640  # metres in a degree at latitude 10°, as the maps of tests/scene/readers have them


def write_dem(path, height, crs="EPSG:4326+5773", half_m=800.0, pixel_m=10.0, dtype="float32", **more):
    """Write a GeoTIFF about latitude 10°, longitude 20° with height(x east, y north) [m] at the middle of each pixel."""
    import rasterio

    count = int(2 * half_m / pixel_m)
    x_m = (np.arange(count) + 0.5) * pixel_m - half_m
    values = np.asarray(height(*np.meshgrid(x_m, -x_m)), dtype=dtype)
    transform = rasterio.Affine(pixel_m / LON_M, 0, 20 - half_m / LON_M, 0, -pixel_m / LAT_M, 10 + half_m / LAT_M)
    profile = {"driver": "GTiff", "width": count, "height": count, "count": 1, "dtype": dtype, "crs": crs,
               "transform": transform} | more
    with rasterio.open(path, "w", **profile) as file:
        for band in range(1, profile["count"] + 1):
            file.write(values, band)
    return path


def terrain_map(height, half_m=500.0, step_m=10.0, tolerance_m=0.01, building=None):
    """Return a map of a terrain of height(x, y) [m], and of a building (a mesh) if there is one."""
    axis_m = np.arange(-half_m, half_m + step_m / 2, step_m)
    mesh = approximate(HeightGrid(axis_m, axis_m, height(*np.meshgrid(axis_m, axis_m))), tolerance_m, 100_000)
    vertices, faces, terrain = mesh.vertices, mesh.faces, np.ones(len(mesh.faces), dtype=bool)
    if building is not None:
        faces = np.vstack([faces, np.asarray(building.faces) + len(vertices)])
        vertices = np.vstack([vertices, building.vertices])
        terrain = np.arange(len(faces)) < len(terrain)
    return CityMap(vertices, faces, terrain=terrain)


def ridge(crest_m, half_width_m=50.0, base_m=10.0):
    """Return the heights of a straight ridge along x = 0 on a plain, a triangle in section."""
    def height(x_m, y_m):
        return base_m + crest_m * np.maximum(1 - np.abs(x_m) / half_width_m, 0.0) + 0.0 * y_m
    return height


def incline(slope_x, slope_y, level_m=100.0):
    """Return the heights of an inclined plane."""
    def height(x_m, y_m):
        return level_m + slope_x * x_m + slope_y * y_m
    return height
