"""Maps with errors of a known size."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap, building_of_vertex, perturbed_map
from radiotwin.scene.materials import Material

SIDE = 12  # houses along each side of the town


@pytest.fixture(scope="module")
def town():
    """144 houses of 20 x 30 x 15 m on a ground."""
    boxes = [trimesh.creation.box(bounds=[[60 * i, 60 * j, 0], [60 * i + 20, 60 * j + 30, 15]])
             for i in range(SIDE) for j in range(SIDE)]
    ground = trimesh.Trimesh([[-50, -50, 0], [800, -50, 0], [800, 800, 0], [-50, 800, 0]], [[0, 1, 2], [0, 2, 3]])
    mesh = trimesh.util.concatenate([*boxes, ground])
    material = np.repeat([1, 0], [len(mesh.faces) - 2, 2])
    return CityMap(mesh.vertices, mesh.faces, (Material("concrete", "concrete"), Material("brick", "brick")), material)


def test_houses_that_share_a_wall_are_one():
    boxes = [trimesh.creation.box(bounds=[[20 * i, 0, 0], [20 * i + 20, 30, 15]]) for i in range(3)]
    mesh = trimesh.util.concatenate(boxes)
    assert set(building_of_vertex(CityMap(mesh.vertices, mesh.faces))) == {0}


def test_walls_and_roofs_are_off_by_what_was_asked_for_each_by_itself(town):
    wrong = perturbed_map(town, 1.5, 3.0, 4)
    change = (wrong.vertices - town.vertices)[:-4].reshape(SIDE**2, 8, 3)
    corners = town.vertices[:-4].reshape(SIDE**2, 8, 3)
    low, high = corners[:, :, 0] == corners[:, :, 0].min(axis=1)[:, None], corners[:, :, 2] > 0
    west = np.array([each[rows, 0] for each, rows in zip(change, low)])
    east = np.array([each[~rows, 0] for each, rows in zip(change, low)])
    assert np.ptp(west, axis=1).max() < 1e-9, "a wall stays a wall"
    assert np.std(west[:, 0]) == pytest.approx(1.5, rel=0.2) and np.std(east[:, 0]) == pytest.approx(1.5, rel=0.2)
    assert abs(np.corrcoef(west[:, 0], east[:, 0])[0, 1]) < 0.3
    roof = np.array([each[rows, 2] for each, rows in zip(change, high)])
    assert np.ptp(roof, axis=1).max() < 1e-9 and np.std(roof[:, 0]) == pytest.approx(3.0, rel=0.2)
    assert (change[~high][:, 2] == 0).all(), "it stands on the ground"
    assert (wrong.vertices[-4:] == town.vertices[-4:]).all()


def test_materials_stay_and_no_house_gets_a_cellar(town):
    wrong = perturbed_map(town, 0.0, 40.0, 1)
    assert wrong.materials == town.materials and (wrong.material == town.material).all()
    tops = wrong.vertices[:-4, 2].reshape(SIDE**2, 8).max(axis=1)
    assert tops.min() == pytest.approx(0.2 * 15)
    assert (wrong.vertices[:, :2] == town.vertices[:, :2]).all()


def test_a_seed_moves_walls_the_same_way_whatever_the_size(town):
    small, large = (perturbed_map(town, size, 0.0, 7).vertices - town.vertices for size in (1.0, 4.0))
    np.testing.assert_allclose(large, 4 * small, atol=1e-9)
    other = perturbed_map(town, 1.0, 0.0, 8).vertices - town.vertices
    assert not np.allclose(other, small)
