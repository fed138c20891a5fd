"""The effects' ground where it is not flat: bounces off slopes, boxes on them, terrain that is no building."""

import numpy as np
import pytest

from radiotwin.effects.boxes import Box
from radiotwin.effects.catalogue.ground_reflection import bounces_on_terrain, two_ray_db
from radiotwin.effects.catalogue.interference import Interference
from radiotwin.effects.catalogue.missing_obstacle import _with_box
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle, only_blocker
from tests.effects.conftest import with_params
from tests.terrains import incline, ridge, terrain_map


@pytest.mark.parametrize("slope", [(0.25, 0.0), (-0.1, 0.2)])
def test_a_bounce_off_an_inclined_plane(slope):
    """Closed form: lengths of the direct ray and of that from the image across the tilted plane."""
    height = incline(*slope)
    city = terrain_map(height)
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    rng = np.random.default_rng(0)
    ends = []
    for above_m in (3.0, 40.0):
        x_m, y_m = rng.uniform(-150, 150, (2, 20))
        ends.append(np.column_stack([x_m, y_m, height(x_m, y_m) + above_m]))
    image_m = ends[0] - 2 * ((ends[0] - [0, 0, height(0, 0)]) @ normal)[:, None] * normal
    clear, device_m, receiver_m = bounces_on_terrain(city, *ends, np.ones(20, dtype=bool))
    assert clear.all()
    assert np.linalg.norm(receiver_m - device_m, axis=1) == pytest.approx(
        np.linalg.norm(ends[1] - ends[0], axis=1), abs=1e-3)
    assert np.linalg.norm(receiver_m - device_m * [1, 1, -1], axis=1) == pytest.approx(
        np.linalg.norm(ends[1] - image_m, axis=1), abs=5e-3)
    fringes_db = two_ray_db(device_m, receiver_m, 150e6, 1.0, 0.0, 0.0)
    assert np.ptp(fringes_db) > 3  # and both rays interfere


def test_a_bounce_behind_a_ridge_is_none():
    city = terrain_map(ridge(40.0))
    a_m, b_m = np.array([[-200.0, 0, 13], [-200, 0, 13]]), np.array([[200.0, 0, 200], [200, 0, 60]])
    los = city.line_of_sight(a_m, b_m)
    assert los.tolist() == [True, False]
    assert bounces_on_terrain(city, a_m, b_m, los)[0].tolist()[1] is False


def test_a_box_stands_on_the_slope():
    city = terrain_map(incline(0.3, 0.0))
    with_box = _with_box(city, Box(50.0, 0.0, 20.0, 10.0, 30.0, 0.0))
    assert with_box.height_at(np.array([50.0, 42.0]), np.zeros(2)) == pytest.approx([145, 145], abs=0.02)
    assert with_box.ground_height_m(50.0, 0.0) == pytest.approx(115, abs=0.02)
    below_m = np.array([[41.0, 0.0, 112.5]])  # between the slope and the level of the box's middle: no gap
    assert with_box.inside(below_m).all()


def test_terrain_is_not_a_building_to_remove(make_links, view):
    links = make_links([-200, 0, 13], [[200, y, 30] for y in range(-20, 21, 2)], city=terrain_map(ridge(40.0)))
    assert not links.los.any() and (only_blocker(links) == -1).all()

    def level_at(of, exact=False):
        return np.where(of.los, 0.0, -20.0)

    as_if_nothing_were_there = make_links([-200, 0, 13], links.receiver_m, city=links.city, level_db=np.zeros(len(links)))
    assert RemovedObstacle().propose(view(as_if_nothing_were_there, level_at(links), 3.0, level_at)) == []


def test_an_emitter_stands_on_the_ground(make_links):
    """The channel is asked for a device 1.5 m above a hill's top."""
    links, asked_m = make_links([-200, 0, 13], [[0.0, 0, 151.5]], city=terrain_map(ridge(40.0))), []

    def level_at(moved):
        asked_m.append(moved.device_m)
        return np.zeros(len(moved))

    with_params(Interference, place_m=(0.0, 0.0), level_db=0.0, within_m=(-9, -9, 9, 9), through_channel=True).term(links, level_at)
    np.testing.assert_allclose(asked_m, [[[0.0, 0.0, float(links.city.ground_height_m(0.0, 0.0)) + 1.5]]])
