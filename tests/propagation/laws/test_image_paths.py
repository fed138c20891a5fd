"""The channel that follows paths, fitted to links that say little."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.image_paths import DIFFUSE_DEFAULT, ImagePaths
from radiotwin.scene.citymap import CityMap


def test_where_all_links_without_line_of_sight_are_blank_the_diffuse_power_is_as_weak_as_it_may_be():
    """40 receivers behind a wall 60 m high, none of which hears anything."""
    wall = trimesh.creation.box(bounds=[[45, -300, 0], [55, 300, 60]])
    city = CityMap(wall.vertices, wall.faces)
    receiver_m = np.column_stack([np.full(40, 150.0), np.linspace(-80, 80, 40), np.full(40, 10.0)])
    device_m = np.tile([0.0, 0, 10], (40, 1))
    los = city.line_of_sight(device_m, receiver_m)
    assert not los.any()
    links = LinkGeometry(device_m, receiver_m, los, np.zeros(40, int), city, 2.4e9)
    fitted = ImagePaths(diffuse=(-80.0, 2.0)).fit_diffuse(links, np.full(40, np.nan), -100.0)
    assert fitted.diffuse == DIFFUSE_DEFAULT


@pytest.mark.seconds
@pytest.mark.parametrize("frequency_hz", [0.9e9, 28e9])
def test_diffuse_power_stays_below_that_of_free_space(frequency_hz):
    """Levels behind a wall fall with distance only: how deep a receiver is in its shadow does not matter."""
    wall = trimesh.creation.box(bounds=[[45, -400, 0], [55, 400, 60]])
    city = CityMap(wall.vertices, wall.faces)
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(80, 200, 200), rng.uniform(-80, 80, 200), rng.uniform(2, 150, 200)])
    device_m = np.tile([0.0, 0, 10], (200, 1))
    links = LinkGeometry(device_m, receiver_m, city.line_of_sight(device_m, receiver_m), np.zeros(200, int), city,
                         frequency_hz)
    distance_m = np.linalg.norm(receiver_m - device_m, axis=1)
    level_db = -40.0 - 22 * np.log10(distance_m) + rng.normal(0, 1, 200)  # the transmitted power is not known
    gain_db, _ = ImagePaths().fit_diffuse(links, level_db, -200.0).diffuse
    wavelength_m = 299_792_458 / frequency_hz
    assert gain_db <= 20 * np.log10(wavelength_m / (4 * np.pi * 100)) - 6 + 0.01


def test_links_whose_lines_of_sight_are_other_than_the_maps_lose_or_gain_the_direct_path_only():
    """Beside a wall that reflects, and behind one that hides."""
    walls = [trimesh.creation.box(bounds=bounds) for bounds in
             ([[-20, 20, 0], [220, 25, 30]], [[95, -30, 0], [100, -15, 30]])]
    mesh = trimesh.util.concatenate(walls)
    city = CityMap(mesh.vertices, mesh.faces)
    device_m = np.tile([0.0, 0, 10], (2, 1))
    receiver_m = np.array([[150.0, 5, 12], [160.0, -30, 12]])
    los = city.line_of_sight(device_m, receiver_m)
    assert los.tolist() == [True, False]
    links = LinkGeometry(device_m, receiver_m, los, np.zeros(2, int), city, 2.4e9)
    channel = ImagePaths(ErrorsOnly(), diffuse=(-140.0, 3.0))
    gain = 10 ** (channel.predict(links)[0] / 10)
    other = 10 ** (channel.predict(replace(links, los=~los))[0] / 10)
    straight = (299_792_458 / 2.4e9 / (4 * np.pi * np.linalg.norm(receiver_m - device_m, axis=1))) ** 2
    assert gain[0] - other[0] == pytest.approx(straight[0], rel=1e-6)
    assert other[1] - gain[1] == pytest.approx(straight[1], rel=1e-3)
    assert other[0] > 0.1 * straight[0]  # the wall's reflection is left


class ErrorsOnly:
    """A law that nothing is asked of but the size of errors."""

    def predict(self, links):
        return np.zeros(len(links.los)), np.full(len(links.los), 7.0)
