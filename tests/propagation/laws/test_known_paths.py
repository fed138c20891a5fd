"""Paths that are followed once, and what a box in their way blocks: against another intersection of box and line."""

import numpy as np
import pytest
import trimesh

from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.followed_paths import KnownPaths, UprightBox, interaction_gains
from radiotwin.scene.citymap import CityMap

RECEIVERS = 30


@pytest.fixture
def geometry():
    """Two devices between two walls, and receivers of which one wall hides some."""
    walls = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in
                                      ([[-50, 60, 0], [250, 65, 40]], [[90, -30, 0], [95, 10, 30]])])
    city, rng = CityMap(walls.vertices, walls.faces), np.random.default_rng(0)
    device = np.arange(RECEIVERS) % 2
    device_m = np.array([[0.0, 0, 10], [20, -20, 5]])[device]
    receiver_m = rng.uniform([110, -40, 5], [200, 50, 25], (RECEIVERS, 3))
    return LinkGeometry(device_m, receiver_m, city.line_of_sight(device_m, receiver_m), device, city, 2.4e9)


def goes_through(points_m, box):
    """Whether a line through (m, 3) points meets a box, by the box as a mesh; and by a little more or less of it."""
    found = []
    for margin_m in (-0.05, 0.05):
        sides_m = 2 * np.array(box.half_m) + margin_m
        pose = trimesh.transformations.rotation_matrix(box.turn_rad, (0, 0, 1))
        pose[:3, 3] = *box.centre_m, box.top_m / 2
        mesh = trimesh.creation.box((*sides_m, box.top_m + margin_m), pose)
        legs_m = np.diff(points_m, axis=0)
        length_m = np.linalg.norm(legs_m, axis=1)
        where_m, ray, _ = mesh.ray.intersects_location(points_m[:-1], legs_m)
        away_m = np.linalg.norm(where_m - points_m[ray], axis=1)
        found.append(bool((away_m <= length_m[ray]).any() or mesh.contains(points_m).any()))
    return found


def test_without_a_box_all_power_is_there(geometry):
    """As followed link by link; the power over two edges alone, where nothing else arrives, is left out."""
    known, gains = KnownPaths(geometry, geometry.city), interaction_gains(geometry)
    far = UprightBox((5000.0, 5000.0), (10.0, 10.0), 0.3, 20.0)
    for rows in (np.arange(7), np.arange(RECEIVERS)):  # some at first, then the others
        power = known.powers_with_box(far, rows)
        np.testing.assert_array_equal(power.others_past, power.others)
        np.testing.assert_allclose(power.direct, gains[rows, 0], rtol=1e-12)
        share = power.others / gains[rows, 1:].sum(axis=1)
        assert (share > 0.97).all() and (share < 1 + 1e-9).all()  # the weakest are not kept
    assert 0 < geometry.los.sum() < RECEIVERS


def test_a_box_blocks_the_paths_that_go_through_it(geometry):
    known, rng = KnownPaths(geometry, geometry.city), np.random.default_rng(1)
    known.powers_with_box(UprightBox((0.0, 0.0), (1.0, 1.0), 0.0, 1.0), np.arange(RECEIVERS))
    link, power, points_m, count = known._paths
    some, blocked = rng.choice(len(link), 20, replace=False), 0
    for _ in range(8):
        box = UprightBox(tuple(rng.uniform([20, -30], [120, 55])), tuple(rng.uniform(2, 15, 2)),
                         rng.uniform(-1.5, 1.5), rng.uniform(5, 35))
        lost = known.powers_with_box(box, np.arange(RECEIVERS))
        of_link = np.zeros(RECEIVERS)
        for path in some:
            less, more = goes_through(points_m[path, :count[path]].astype(float), box)
            if less != more:  # it grazes the box
                continue
            alone = KnownPaths(geometry, geometry.city)
            alone._paths = tuple(each[path:path + 1] for each in known._paths)
            alone._is_followed[:] = True
            past = alone.powers_with_box(box, np.array([link[path]])).others_past
            assert past == pytest.approx(0.0 if less else power[path])
            blocked += less
            of_link[link[path]] += power[path] * less
        assert (lost.others - lost.others_past >= 0.999 * of_link - 1e-9 * lost.others).all()
    assert 20 < blocked < 8 * 20 - 20
