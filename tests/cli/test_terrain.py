"""A map and a GeoTIFF through the real command line: scene, survey, twin and map over hills."""

import tomllib

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scene.readers.conftest import Map
from tests.terrains import write_dem

pytest.importorskip("rasterio")


def hills(x_m, y_m):
    return 500 + 25 * np.sin(x_m / 70) * np.cos(y_m / 90)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run):
    folder = tmp_path_factory.mktemp("hills")
    drawn = Map()
    for x_m in range(-120, 121, 60):
        drawn.box(x_m, -x_m / 2, x_m + 25, -x_m / 2 + 20, height=str(10 + abs(x_m) // 20))
    drawn.write(folder / "a.osm")
    write_dem(folder / "dem.tif", hills, half_m=500)
    done = run("build-scene a.osm --terrain dem.tif --origin 10,20 --devices 4 --uavs 2 -o scene", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "lattice altitudes" in done.stdout and "above the ground" in done.stdout and "EGM96 height" in done.stdout
    return folder


def test_from_the_raster_to_the_map_of_a_twin(run, folder):
    steps = ["survey scene --truth segmented --flights 3 -o survey/measurements.csv",
             "fit survey/measurements.csv --scene scene --model log_distance -o twin", "map twin --scene scene -o map.nc",
             "map twin --scene scene -o map.csv"]
    for step in steps:
        done = run(step, cwd=folder)
        assert done.returncode == 0, (step, done.stderr)
    config = tomllib.loads((folder / "scene" / "scene.toml").read_text())
    datum_m, altitudes_m = config["terrain"]["datum_m"], config["lattice"]["altitudes_m"]
    flown = pd.read_csv(folder / "survey" / "measurements.csv")
    above_m = flown["receiver_z_m"] + datum_m - hills(flown["receiver_x_m"], flown["receiver_y_m"])
    flights = above_m.to_numpy()[:, None] - np.array(altitudes_m[:2])
    assert np.abs(flights).min(axis=1).max() < 0.8  # the triangles' tolerance, and bilinear pixels of 10 m
    assert flown["receiver_z_m"].std() > 5  # they climb with the hills
    with xr.open_dataset(folder / "map.nc") as opened:
        assert opened["z"].values.tolist() == altitudes_m and opened["z"].attrs["long_name"] == "height above the ground"
        x_m, y_m = np.meshgrid(opened["x"], opened["y"])
        assert opened["ground_m"].values + datum_m == pytest.approx(hills(x_m, y_m), abs=0.8)
    table = pd.read_csv(folder / "map.csv")
    assert (table["z_m"] - table["above_ground_m"]).to_numpy() + datum_m == pytest.approx(
        hills(table["x_m"], table["y_m"]).to_numpy(), abs=0.8)


def test_paths_over_the_terrain_say_what_they_lack_and_cells_cannot_follow_it(run, folder):
    done = run("trace scene --solver map", cwd=folder)
    assert done.returncode == 2 and "horizontal cells, and the lattice follows the ground" in done.stderr
    (folder / "points.csv").write_text("x_m,y_m,above_ground_m\n0,10,60\n")
    done = run("paths scene --points points.csv --devices device01 -o paths.nc", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "diffract where it folds by more than 6 degrees" in done.stdout.replace("\n", " ")
