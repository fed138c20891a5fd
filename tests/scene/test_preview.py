import matplotlib.image
import numpy as np
import pytest

from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions, build_scene
from radiotwin.scene.plot import draw_preview, height_grid


@pytest.fixture
def scene(town, tmp_path):
    build_scene(town.write(), tmp_path / "scene", BuildOptions(devices=5))
    return Scene.load(tmp_path / "scene")


def test_height_grid_lies_where_the_houses_are(scene):
    height_m, (x_min, _, y_min, _) = height_grid(scene, cells=200)
    cell_m = (scene.config.extent.x_max_m - x_min) / 200
    row, column = int((60 - y_min) / cell_m), int((-60 - x_min) / cell_m)  # within house6: x -70..-50, y 50..70
    assert height_m[row, column] == pytest.approx(20.0, abs=1e-3)
    assert (height_m > 1).mean() == pytest.approx(9 * 400 / 160**2, abs=0.01)


@pytest.mark.seconds
def test_picture_shows_heights_devices_and_starts(scene, tmp_path):
    draw_preview(scene, tmp_path / "a.png")
    picture = matplotlib.image.imread(tmp_path / "a.png")[..., :3]
    assert picture.shape[0] > 600 and picture.shape[1] > 600
    for colour in ("#d1495b", "#f08a00"):  # anchors, unknown devices
        wanted = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        assert (np.abs(picture - wanted).max(axis=2) < 0.03).sum() > 100
    assert len(np.unique((picture * 255).astype(int).reshape(-1, 3), axis=0)) > 50


def test_a_strip_of_a_town_has_a_picture(scene, tmp_path):
    extent = scene.config.extent.model_copy(update={"x_min_m": -800.0, "x_max_m": 800.0, "y_min_m": 0.0, "y_max_m": 1.0})
    thin = Scene(scene.folder, scene.config.model_copy(update={"extent": extent, "devices": [], "uavs": []}))
    assert height_grid(thin)[0].shape == (2, 1000)
    draw_preview(thin, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000
