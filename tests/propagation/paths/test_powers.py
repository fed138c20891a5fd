"""Powers of paths against closed forms, and changes of the map that must not change them."""

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.powers import COMPONENTS
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material
from tests.propagation.links import (
    FREQUENCY_HZ,
    flat,
    friis,
    knife_edge_db,
    one_link,
    powers_of_links,
    sharp_roofs,
)


def stacked(powers):
    return np.array([getattr(powers, name) for name in COMPONENTS])


def test_power_and_directions_of_each_path(city_of, line_of_slab):
    """A wall 10 m away from both ends, 20 m apart, is hit at 45 degrees: straight north, off the wall by north-east, off
    the ground 20 m below; each with its power."""
    powers = path_powers(city_of((10, -200, 12, 200, 50)), [0, 0, 20], [[0, 20.0, 20]], FREQUENCY_HZ, depth=1)
    diagonal, down = np.sqrt(0.5), np.array([1, 2]) / np.sqrt(5)
    kinds = powers.direct[0], powers.reflected_1[0], powers.ground[0]
    reflected = friis(np.hypot(20, 20)) * abs(line_of_slab(np.sqrt(0.5))[0]) ** 2
    assert kinds[:2] == pytest.approx((friis(20), reflected), rel=1e-9)
    expected = [[0, 1, 0], [diagonal, diagonal, 0], [0, down[0], -down[1]]]
    paths = powers.directions
    for power, departure in zip(kinds, expected, strict=True):
        path, = np.flatnonzero(np.isclose(paths.power, power, rtol=1e-6))
        np.testing.assert_allclose(paths.departure[path], departure, atol=1e-6)
        np.testing.assert_allclose(paths.arrival[path], np.array(departure) * [1, -1, 1], atol=1e-6)
    assert paths.power.sum() == pytest.approx(powers.total[0], rel=1e-5) and not paths.link.any()


def test_only_the_ground(line_of_slab):
    got = one_link(flat(), [0, 0, 2], [30, 0, 38])
    assert got["ground"] == pytest.approx(friis(50) * abs(line_of_slab(0.8, thickness_m=np.inf)[1]) ** 2, rel=1e-9)
    assert sum(got.values()) == got["ground"] + got["direct"]


def test_each_wall_and_the_ground_reflect_with_their_own_material(box_mesh, line_of_slab):
    """A thin pane of glass and a wall of metal, 10 m to the east and to the west, over asphalt."""
    pane, metal = box_mesh(10, -200, 12, 200, 50), box_mesh(-12, -200, -10, 200, 50)
    ground = flat()
    mesh = trimesh.util.concatenate([pane, metal, trimesh.Trimesh(ground.vertices, ground.faces)])
    materials = [itu_material("glass", thickness_m=0.03), itu_material("metal"),
                 itu_material("asphalt_concrete", scattering_coefficient=0.6)]
    city = CityMap(mesh.vertices, mesh.faces, materials, np.repeat([0, 1, 2], [12, 12, 2]))
    got = one_link(city, [0, 0, 20], [0, 20, 20], depth=1)
    glass = line_of_slab(np.sqrt(0.5), 6.31, 0.0036 * 2.4**1.3394, 0.03)
    assert got["reflected_1"] == pytest.approx(
        friis(np.hypot(20, 20)) * (abs(glass[0]) ** 2 + 1), rel=1e-3)
    asphalt = line_of_slab(2 / np.sqrt(5), 4.83, 0.0108 * 2.4**1.3969, np.inf)
    assert got["ground"] == pytest.approx(0.64 * friis(np.hypot(20, 40)) * abs(asphalt[1]) ** 2, rel=1e-9)


def test_a_blocked_reflection_and_a_blocked_ground(city_of):
    wall, low = (10, -200, 12, 200, 50), (4, 4, 6, 8, 30)
    got = one_link(city_of(wall, low), [0, 0, 20], [0, 20, 20], depth=1)
    assert got["direct"] > 0 and got["reflected_1"] == 0
    got = one_link(city_of((-2, 9, 2, 11, 5)), [0, 0, 20], [0, 20, 20], depth=1)
    assert got["direct"] > 0 and got["ground"] == 0


def test_over_a_sharp_roof_as_over_a_knife_edge():
    """ITU-R P.526-15, whose screen has no thickness and no material: within 3 dB, deep in the shadow."""
    for z_m in (2.0, 22.0):
        got = one_link(sharp_roofs((0, 30), half_m=4.0), [-100, 0, 1.5], [100, 0, z_m])
        loss_db = knife_edge_db(30 - (1.5 + z_m) / 2, 100, 100)
        assert got["direct"] == 0
        assert 10 * np.log10(got["diffracted"] / friis(np.hypot(200, z_m - 1.5))) == pytest.approx(-loss_db, abs=3)


def test_over_the_shadow_boundary(city_of):
    """Diffracted power goes on without a step, at a quarter of free space; the direct ray then adds four times it."""
    city = city_of((100, -800, 150, 800, 30))
    height_m = 1.5 + 2 * 28.5 + np.array([-0.5, -0.02, 0.02, 0.5])
    receiver_m = np.column_stack([np.full(4, 200.0), np.zeros(4), height_m])
    powers = path_powers(city, [0, 0, 1.5], receiver_m, FREQUENCY_HZ, depth=1)
    over_free = powers.diffracted / friis(np.linalg.norm(receiver_m - [0, 0, 1.5], axis=1))
    assert (powers.direct > 0).tolist() == [False, False, True, True]
    assert np.allclose(10 * np.log10(over_free[1:3]), -6, atol=0.5)
    assert (np.abs(np.diff(10 * np.log10(over_free))) < 3).all()
    assert 10 * np.log10(powers.total[2] / powers.total[1]) == pytest.approx(7, abs=0.5)


@pytest.fixture(scope="module")
def links():
    rng = np.random.default_rng(0)
    device_m = np.array([[5.0, -3.0, 1.5], [57.9, -25.0, 2.0]])
    receiver_m = rng.uniform([-60, -60, 35], [110, 60, 60], (60, 3))
    return device_m, receiver_m, np.arange(60) % 2


@pytest.fixture(scope="module")
def there(town, links):
    return powers_of_links(town(), *links)


def test_only_the_weakest_directions_are_left_out(there):
    """Those of a link carry less than a hundred-thousandth of its power together."""
    kept = np.bincount(there.directions.link, there.directions.power, len(there.total))
    reached = there.total > 0
    assert (np.abs(kept / there.total - 1)[reached] < 1.1e-5).all() and not kept[~reached].any()
    assert (np.diff(there.directions.link) >= 0).all()


def test_a_turned_city(town, turn, links, there):
    device_m, receiver_m, device = links
    turned = powers_of_links(town(0.5), turn(device_m, 0.5), turn(receiver_m, 0.5), device).total
    # no link is reached by two edges only, or along terrain
    assert (stacked(there).sum(axis=1) > 0).sum() == len(COMPONENTS) - 2
    assert np.allclose(10 * np.log10(there.total), 10 * np.log10(turned), atol=0.3)
    assert np.median(np.abs(there.total / turned - 1)) < 1e-6


def test_powers_are_reciprocal(town, links):
    """Two interactions at most: longer paths may have more reflections before an edge than after it."""
    device_m, receiver_m, device = links
    there = powers_of_links(town(0.3), device_m, receiver_m, device, depth=2)
    few = np.arange(8)
    back = powers_of_links(town(0.3), receiver_m[few], device_m[device[few]], few, depth=2)
    assert np.allclose(stacked(there)[:, few], stacked(back), rtol=1e-6, atol=1e-16)
    forth, back_again = there.directions.of_links(few), back.directions
    sums = [[np.bincount(paths.link, paths.power * way[:, axis], len(few)) for axis in range(3)]
            for paths, way in ((forth, forth.departure), (back_again, back_again.arrival))]
    assert np.allclose(*sums, rtol=1e-4, atol=1e-14)


def test_chunks_change_nothing(town, links, there, monkeypatch):
    monkeypatch.setattr("radiotwin.propagation.paths.powers.PATH_CHUNK", 97)
    assert np.array_equal(stacked(there), stacked(powers_of_links(town(), *links)))
    assert path_powers(town(), np.ones(3), np.empty((0, 3)), FREQUENCY_HZ).total.shape == (0,)


def test_a_tenth_of_the_rays_finds_nearly_all_power(town, links, there):
    few = powers_of_links(town(), *links, rays=10_000)
    assert (few.total <= there.total * (1 + 1e-9)).all()
    reached = there.total > 0
    lacking_db = 10 * np.log10(there.total[reached] / np.maximum(few.total[reached], 1e-30))
    assert np.quantile(lacking_db, 0.9) < 0.1 and lacking_db.max() < 3.0


def test_subdivided_walls_change_nothing(box_mesh, city_of, links):
    mesh = trimesh.util.concatenate([box_mesh(20, 5, 60, 30, 25), box_mesh(15, -40, 55, -12, 30)])
    whole, cut = (stacked(powers_of_links(city_of(each), *links)) for each in (mesh, mesh.subdivide().subdivide()))
    assert np.allclose(whole, cut, rtol=1e-6, atol=1e-16)


def test_more_interactions_only_add(town, links, there):
    totals = [powers_of_links(town(), *links, depth=depth).total for depth in (1, 2)] + [there.total]
    assert (totals[0] <= totals[1] * (1 + 1e-9)).all() and (totals[1] <= totals[2] * (1 + 1e-9)).all()


def test_solids_that_touch_are_as_one(box_mesh, city_of):
    """An edge inside a shared wall, such as that of the lower roof, carries no power."""
    parts = [box_mesh(0, 0, 20, 30, 20), box_mesh(20, 5, 40, 25, 12)]
    device_m, receiver_m = np.array([50.0, 11.0, 1.5]), np.random.default_rng(2).uniform(
        [-40, -30, 5], [0, 60, 40], (40, 3))
    receiver_m = receiver_m[~city_of(*parts).inside(receiver_m)]
    apart, joined = (path_powers(city, device_m, receiver_m, FREQUENCY_HZ) for city in
                     (city_of(*parts), city_of(trimesh.boolean.union(parts, engine="manifold"))))
    assert np.allclose(stacked(apart), stacked(joined), rtol=1e-6, atol=1e-16)


@pytest.mark.parametrize("change, message", [
    ({"device_m": np.full(3, np.inf)}, "device_m"), ({"receiver_m": np.full((2, 3), np.nan)}, "receiver_m"),
    ({"frequency_hz": 0.0}, "frequency"), ({"depth": 7}, "depth"),
])
def test_bad_input(city_of, change, message):
    good = {"device_m": np.ones(3), "receiver_m": np.full((2, 3), 40.0), "frequency_hz": FREQUENCY_HZ}
    with pytest.raises(BadInput, match=message):
        path_powers(city_of((0, 10, 10, 20, 5)), **{**good, **change})


def test_what_matters_at_a_place_gives_the_powers_there_and_a_few_metres_away(town, links):
    device_m, receiver_m, device = links
    city, far_m = town(), receiver_m[device == device[0]]
    there = path_powers(city, device_m[device[0]], far_m, FREQUENCY_HZ)
    for away_m, most_db in ((0.0, 0.2), (1.5, 1.0)):
        near_m = device_m[device[0]] + [away_m, 0, 0]
        asked = path_powers(city, near_m, far_m, FREQUENCY_HZ, candidates=there.strongest)
        error_db = 10 * np.log10(asked.total / path_powers(city, near_m, far_m, FREQUENCY_HZ).total)
        assert np.quantile(np.abs(error_db), 0.9) < most_db and (error_db < 1e-9).all()
