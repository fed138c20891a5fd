"""Terrain in the ray tracer: a ridge's shadow, and reasons of points below the ground."""

import warnings

import numpy as np
import pytest

from radiotwin.io.forms import Origin
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.trace import SolverSettings
from radiotwin.trace.run import read_points, trace_points, warn_of_terrain
from tests.scene.readers.conftest import Map
from tests.terrains import ridge, write_dem

SETTINGS = SolverSettings(samples_per_src=20_000, batch_receivers=16, max_num_paths_per_src=20_000)
pytest.importorskip("rasterio")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A device 150 m west of a ridge of 60 m along x = 0, or of none, and a hut behind it."""
    folder, built = tmp_path_factory.mktemp("ridge"), []
    drawn = Map().box(240, -90, 250, -80, height="4").box(-240, 80, -230, 90, height="4").write(folder / "a.osm")
    for name, crest_m in (("ridge", 60.0), ("plain", 0.0)):
        dem = write_dem(folder / f"{name}.tif", ridge(crest_m), half_m=600, pixel_m=5)
        build_scene_from_map(drawn, folder / name,
                             BuildOptions(terrain=dem, origin=Origin(latitude_deg=10, longitude_deg=20), uavs=0))
        with (folder / name / "scene.toml").open("a") as file:
            file.write('\n[[devices]]\ndevice = "d"\nx_m = -150.0\ny_m = 0.0\nabove_ground_m = 5.0\n')
        built.append(Scene.load(folder / name))
    return built


def points(folder, scene, rows):
    path = folder / "points.csv"
    path.write_text("x_m,y_m,above_ground_m\n" + "".join(f"{x},{y},{z}\n" for x, y, z in rows))
    return read_points(path, None, scene.city)


def test_points_above_the_ground(scenes, tmp_path):
    found_m = points(tmp_path, scenes[0], [(-150, 0, 2), (0, 10, 3), (25, 0, 4)])
    datum_m = scenes[0].config.terrain.datum_m
    assert found_m[:, 2] + datum_m == pytest.approx([12, 70, 44], abs=0.6)  # pixels of 5 m cut the crest


def test_what_terrain_hides_and_what_is_far_is_told(scenes):
    """Two points behind the ridge, one of them without a path; one beyond 5 km."""
    points_m = np.array([[150.0, 0, 3], [150.0, 40, 3], [-60.0, 20, 3], [6000.0, 0, 500]])
    device_m, no_path = scenes[0].device_m, np.array([[True, False, False, False]])
    with pytest.warns(UserWarning) as found:
        warn_of_terrain(scenes[0].city, device_m, points_m, no_path)
    assert len(found) == 2 and all("25%" in str(each.message) for each in found)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_terrain(scenes[1].city, device_m, points_m[:3], no_path[:, :3])


@pytest.mark.llvm
def test_the_ridge_shades_what_is_behind_it(scenes, tmp_path):
    behind = [(150, y, 3) for y in (-40, 0, 40)]
    gains = []
    for scene in scenes:
        at_m = np.vstack([points(tmp_path, scene, [*behind, (-60, 20, 3)]), [[0, 0, 3.0]]])
        table = trace_points(scene, at_m, SETTINGS)
        gains.append(table["gain_db"].to_numpy())
        los = table["los"].to_numpy()
        assert los[:4].tolist() == ([False] * 3 + [True] if scene is scenes[0] else [True] * 4)
        assert (table["reason"].iloc[4] == "below the ground") == (scene is scenes[0])
    hill_db, plain_db = gains
    # A knife edge 57 m above lines of 300 m: ν = 57 sqrt(2 / 0.125 · 2 / 150) = 26, a loss of 41 dB
    shade_db = np.nan_to_num(hill_db[:3], nan=-200.0) - plain_db[:3]
    assert (shade_db < -25).all()
    assert hill_db[3] == pytest.approx(plain_db[3], abs=3)
