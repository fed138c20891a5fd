"""The probability to be inside: a normal distribution across a wall, by its own formula."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

from radiotwin.links.checks import chance_inside, check_positions
from radiotwin.scene.citymap import CityMap


@pytest.fixture(scope="module")
def block():
    """A building of 60 m by 40 m and 20 m high about the origin."""
    box = trimesh.creation.box(extents=(60, 40, 20))
    box.apply_translation((0, 0, 10))
    return CityMap(box.vertices, box.faces)


@pytest.mark.parametrize("sd_m", [1.0, 4.0])
def test_across_a_wall_and_a_corner(block, sd_m):
    x, y = (each.ravel() for each in np.meshgrid([-10.0, 0.0, 27.0, 29.0, 31.0, 35.0, 60.0], [0.0, 18.0, 21.0, 40.0]))
    expected = np.prod([norm.cdf(half - each, scale=sd_m) - norm.cdf(-half - each, scale=sd_m)
                        for each, half in ((x, 30.0), (y, 20.0))], axis=0)
    found = chance_inside(block, np.column_stack([x, y, np.full(len(x), 1.5)]), sd_m)
    np.testing.assert_allclose(found, expected, atol=0.12)
    assert np.abs(found - expected).mean() < 0.03


def test_above_the_roof_nobody_is_inside(block):
    assert chance_inside(block, np.array([[0.0, 0.0, 25.0], [0.0, 0.0, 19.0]])).tolist() == [0.0, 1.0]


def test_the_note_says_how_many_surely_are(block):
    ground = trimesh.creation.box(extents=(400, 400, 0.2))
    city = CityMap(*trimesh.util.append_faces([ground.vertices, block.vertices], [ground.faces, block.faces]))
    receiver_m = np.array([[0.0, 0, 1.5], [29.0, 0, 1.5], [0.0, 19.0, 1.5], [60.0, 0, 1.5], [0.0, 90, 1.5]])
    (note,) = check_positions(receiver_m, np.array([[100.0, 100.0, 10.0]]), SimpleNamespace(city=city, config=SimpleNamespace(origin=None)))
    assert note.startswith("3 of 5 links have their receiver inside a building (1 of them surely, with positions off by 4 m)")
