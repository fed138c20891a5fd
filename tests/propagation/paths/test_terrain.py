"""Paths over a terrain: off its slopes as off tilted mirrors, over its crests as over wedges, and through it never."""

import numpy as np
import pytest
import trimesh

from radiotwin.propagation.paths.listing import NO_INTERACTION, TERRAIN, follow_rays
from radiotwin.propagation.paths.powers import path_powers
from radiotwin.scene.citymap import CityMap
from tests.propagation.links import FREQUENCY_HZ, friis, knife_edge_db, one_link
from tests.terrains import incline, ridge, terrain_map


def upright(ray):
    """Vertical polarisation of a ray."""
    return (np.array([0, 0, 1]) - ray[2] * ray) / np.hypot(ray[0], ray[1])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.2, 0.0), (-0.15, 0.3)])
def test_an_inclined_plane_reflects_as_a_tilted_mirror(slope, line_of_slab):
    """The image of the device across the plane; the coefficient of a half space at the angle to that plane."""
    height = incline(*slope)
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    device_m = np.array([-40.0, 10.0, height(-40, 10) + 8])
    receiver_m = np.array([60.0, -20.0, height(60, -20) + 40])
    above_m = (device_m - [0, 0, height(0, 0)]) @ normal, (receiver_m - [0, 0, height(0, 0)]) @ normal
    image_m = device_m - 2 * above_m[0] * normal
    length_m = np.linalg.norm(receiver_m - image_m)
    te, tm = line_of_slab((above_m[0] + above_m[1]) / length_m, thickness_m=np.inf)
    away = (receiver_m - image_m) / length_m
    towards = away - 2 * (away @ normal) * normal
    across = np.cross(towards, normal) / np.linalg.norm(np.cross(towards, normal))
    field = te * (upright(towards) @ across) * across \
        + tm * (upright(towards) @ np.cross(across, towards)) * np.cross(across, away)
    got = one_link(terrain_map(height), device_m, receiver_m, depth=1)
    assert got["ground"] == pytest.approx(friis(length_m) * abs(field @ upright(away)) ** 2, rel=1e-3)
    assert got["direct"] == pytest.approx(friis(np.linalg.norm(receiver_m - device_m)), rel=1e-9)
    assert sum(got.values()) == pytest.approx(got["ground"] + got["direct"], rel=1e-12)


def test_no_plane_at_the_datum_reflects_below_a_terrain():
    """A terrain 100 m above z = 0 that ends at x = 20 m: beyond it there is nothing to reflect."""
    half = CityMap([[-500, -500, 100], [20, -500, 100], [20, 500, 100], [-500, 500, 100]], [[0, 1, 2], [0, 2, 3]],
                   terrain=np.ones(2, dtype=bool))
    assert one_link(half, [30, 0, 110], [60, 0, 110])["ground"] == 0
    assert one_link(half, [-60, 0, 110], [-30, 0, 110])["ground"] > 0


def test_over_a_crest_as_over_a_knife_edge():
    """ITU-R P.526-15, eq. 31: within 4 dB of a ridge of 55 m with flanks of 70 degrees, deep in its shadow."""
    city = terrain_map(ridge(55.0, half_width_m=20.0), step_m=5.0)
    for z_m in (22.0, 32.0):
        got = one_link(city, [-150, 0, 12], [150, 0, z_m])
        loss_db = knife_edge_db(65 - (12 + z_m) / 2, 150, 150)
        assert got["direct"] == 0
        assert 10 * np.log10(got["diffracted"] / friis(np.hypot(300, z_m - 12))) == pytest.approx(-loss_db, abs=4)


def test_a_wall_behind_a_ridge_does_not_reflect():
    wall = trimesh.creation.box(bounds=[[100, -150, 5], [110, 150, 40]])
    hidden, seen = (one_link(terrain_map(ridge(crest_m), half_m=300.0, building=wall), [-120, -30, 30], [-120, 30, 30],
                             depth=1)["reflected_1"] for crest_m in (60.0, 0.0))
    assert hidden == 0 < seen


def test_behind_a_rounded_hill_one_path_goes_along_it():
    """A crest radius of 500 m, which no fold of the triangles stands for: the list and the powers agree, by way of the crest."""
    city = terrain_map(lambda x, y: 10 + 20 * np.exp(-(x**2) / 2 / 500 / 20) + 0 * y, half_m=500.0, tolerance_m=0.1)
    device_m, receiver_m = np.array([-300.0, 0, 20]), np.array([[300.0, 50, 12], [-200.0, 50, 30]])
    (rays, _), = follow_rays(city, device_m, receiver_m, FREQUENCY_HZ)
    powers = path_powers(city, device_m, receiver_m, FREQUENCY_HZ)
    behind = np.flatnonzero(rays.receiver == 0)
    assert rays.kinds[behind].tolist() == [[TERRAIN, *[NO_INTERACTION] * (rays.kinds.shape[1] - 1)]]
    assert abs(rays.amplitude[behind[0]]) ** 2 == pytest.approx(powers.diffracted_terrain[0], rel=1e-9)
    assert rays.points_m[behind[0], 0] == pytest.approx([7.6, 25.6, 30.5], abs=1) and rays.departure[behind[0], 2] > 0
    assert powers.diffracted_terrain[1] == 0 and len(rays.receiver) - len(behind) >= 2
    assert powers.total[0] == powers.diffracted_terrain[0]


def test_beyond_5_km_one_path_goes_around_the_earth():
    """Friis' equation less the first terms of P.526-15, Sec. 3.1: 31.0 dB at 20 km; nothing at 6 km, 100 m high."""
    city = CityMap([[-9e4, -9e4, 0], [9e4, -9e4, 0], [0, 9e4, 0]], [[0, 1, 2]])
    device_m, receiver_m = np.array([0.0, 0, 10]), np.array([[20e3, 0, 1.5], [6e3, 0, 100]])
    powers = path_powers(city, device_m, receiver_m, FREQUENCY_HZ)
    distance_m = np.linalg.norm(receiver_m - device_m, axis=1)
    assert 10 * np.log10(powers.total / friis(distance_m)) == pytest.approx([-31.0, 0.0], abs=0.1)
    assert (powers.direct > 0).tolist() == [False, True] and (powers.ground == 0).all()
    (rays, _), = follow_rays(city, device_m, receiver_m, FREQUENCY_HZ)
    assert rays.kinds[:, 0].tolist() == [TERRAIN, NO_INTERACTION]
    assert np.abs(rays.amplitude) ** 2 == pytest.approx(powers.total, rel=1e-9)
