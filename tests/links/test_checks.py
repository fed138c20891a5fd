"""Notes on levels, heights and positions that are probably not what they seem to be."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import trimesh
from scipy.stats import norm

from radiotwin.io.forms import Origin
from radiotwin.links import prepare_links
from radiotwin.links.checks import ceiling_notes, chance_inside, check_positions, height_notes
from radiotwin.links.measurements import Measurements
from radiotwin.scene.citymap import CityMap
from tests.terrains import terrain_map


def readings(seed, step_db, highest_db=np.inf, n=900):
    rng = np.random.default_rng(seed)
    receiver = rng.integers(0, 2, n)
    level_db = rng.normal(-85, 10, n)
    level_db = np.where(receiver == 1, np.minimum(level_db, highest_db), level_db)
    level_db[rng.random(n) < 0.1] = np.nan
    return receiver, np.round(level_db / step_db) * step_db


@pytest.mark.parametrize("step_db", [0.01, 1.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_receiver_that_reads_no_more_than_some_level_is_told(seed, step_db):
    receiver, level_db = readings(seed, step_db, highest_db=-90.0)
    (note,) = ceiling_notes(receiver, ["good", "deaf"], level_db)
    share = (level_db[receiver == 1] == -90).sum() / np.isfinite(level_db[receiver == 1]).sum()
    assert f"of receiver deaf ({share:.0%} at -90): nothing higher is read" in note


@pytest.mark.parametrize("step_db", [0.01, 1.0, 3.0, 10.0])
def test_a_tail_is_no_ceiling(step_db):
    for seed in range(20):
        receiver, level_db = readings(seed, step_db)
        assert ceiling_notes(receiver, ["a", "b"], level_db) == []


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


FLIGHT_M = np.column_stack([np.linspace(-100, 100, 50), np.zeros(50), np.linspace(30, 80, 50)])


def scene(altitude_m=0.0, ground_m=0.0):
    city = SimpleNamespace(ground_height_m=lambda x_m, y_m: np.full(np.shape(x_m), ground_m))
    return SimpleNamespace(city=city, config=SimpleNamespace(
        origin=Origin(latitude_deg=48, longitude_deg=11, altitude_m=altitude_m)))


def raised(by_m):
    return FLIGHT_M + [0, 0, by_m]


@pytest.mark.parametrize(("world", "points_m", "parts"), [
    (scene(520), raised(-520), ["30 to 80 m would be plausible", "import them as height, not as altitude"]),
    (scene(0, 90), FLIGHT_M, ["30 to 80 m would be plausible", "z counts from its datum"]),
    (scene(520), raised(-900), ["below the ground, by up to 870 m", "the ellipsoid"]),
    (scene(520), raised(520), ["m and more above the ground", "altitudes above the sea"])])
def test_another_zero_is_named(world, points_m, parts):
    (note,) = height_notes(points_m, world)
    assert all(part in note for part in parts), note


@pytest.mark.parametrize("points_m", [FLIGHT_M, FLIGHT_M * [1, 1, np.nan], raised(100), np.vstack([FLIGHT_M, raised(-60)[:10]])])
def test_plausible_or_unknown_heights_are_not_mentioned(points_m):
    assert height_notes(points_m, scene(520)) == []


def test_a_device_whose_height_is_not_given_is_held_above_the_ground():
    city = terrain_map(lambda x_m, y_m: np.where(x_m > 300.0, 160.0, 100.0) + 0 * y_m)
    world = SimpleNamespace(city=city, device_antennas=[], uav_antenna=None, config=SimpleNamespace(origin=None, devices=[], gain_limit_db=-150.0,
                                                              radio=SimpleNamespace(frequency_hz=2e9, sensitivity_dbm=-120.0)))
    rng, count = np.random.default_rng(0), 200
    receiver_m = np.column_stack([rng.uniform(-400, 400, (count, 2)), np.full(count, 190.0)])
    names = np.array(["anchor", "phone"])[rng.integers(0, 2, count)]
    table = pd.DataFrame({"flight": "f0", "receiver": "r", "device": names, "gain_db": rng.uniform(-120, -80, count)}
                         | {f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")})
    devices = pd.DataFrame({"device": ["anchor", "phone"], "x_m": [350.0, np.nan], "y_m": [0.0, np.nan], "z_m": np.nan,
                            "role": ["anchor", "unknown"]})
    links = prepare_links(Measurements(table, devices), world)
    assert dict(zip(links.device_names, links.device_m[:, 2])) == pytest.approx({"anchor": 161.5, "phone": 101.5})
    assert any("taken for 1.5 m above the ground" in note for note in links.notes)


@pytest.mark.parametrize(("z_m", "receiver_z_m", "told"), [(530.0, 1.5, True), (530.0, 501.5, False), (30.0, 1.5, False)])
def test_sites_at_altitudes_above_the_sea_are_told(z_m, receiver_z_m, told):
    rng = np.random.default_rng(2)
    table = pd.DataFrame({"flight": "f", "receiver": "u", "receiver_x_m": rng.uniform(-300, 300, 100),
                          "receiver_y_m": rng.uniform(-300, 300, 100), "receiver_z_m": receiver_z_m, "device": ["a", "b"] * 50,
                          "rssi_dbm": rng.uniform(-100, -60, 100)})
    devices = pd.DataFrame({"device": ["a", "b"], "x_m": [0.0, 50.0], "y_m": 0.0, "z_m": z_m, "role": "anchor"})
    notes = prepare_links(Measurements(table, devices), None).notes
    assert any("the lowest of 2 sites is" in note for note in notes) == told
