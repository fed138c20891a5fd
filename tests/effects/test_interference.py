"""An undeclared emitter: powers added by hand, and worlds with one or none."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.interference import Interference
from tests.effects.conftest import with_params
from tests.worlds import city_of_boxes

EMITTER = {"place_m": (120.0, 80.0), "level_db": -90.0, "within_m": (0, 0, 300, 300)}


def watts(level_db):
    return 10 ** (np.asarray(level_db) / 10)


def heard(receiver_m, emitter_m, level_db):
    """Power of an emitter, one receiver at a time: `level_db` at 100 m, less by the square of the distance."""
    return np.array([watts(level_db) * 100.0**2 / np.sum((receiver - emitter_m) ** 2) for receiver in receiver_m])


def test_powers_add_and_the_slope_is_known(make_links):
    rng = np.random.default_rng(0)
    links = make_links([[0.0, 0, 1.5], [90, 40, 1.5]], np.column_stack([rng.uniform(0, 300, (50, 2)), np.full(50, 60.0)]))
    level_db, emitter = rng.uniform(-120, -60, len(links)), with_params(Interference, **EMITTER)
    inputs = emitter.term(links, None).inputs
    read_db, slope = emitter.response(level_db, inputs)
    power = heard(links.receiver_m, np.array([120.0, 80.0, 1.5]), -90.0)
    np.testing.assert_allclose(watts(read_db), watts(level_db) + power, rtol=1e-9)
    more_db, less_db = (emitter.response(level_db + step, inputs)[0] for step in (1e-4, -1e-4))
    np.testing.assert_allclose(slope, (more_db - less_db) / 2e-4, atol=1e-6)


def test_receivers_that_stay_at_few_positions_cannot_locate_an_emitter(make_links):
    positions_m = np.column_stack([np.arange(12) * 30.0, np.zeros(12), np.full(12, 20.0)])
    assert "12 positions" in Interference().unavailable(make_links([[0.0, 0, 1.5]], np.repeat(positions_m, 40, axis=0)))
    assert Interference().unavailable(make_links([[0.0, 0, 1.5]], np.vstack([positions_m, positions_m + (0, 50, 0)]))) is None


def test_beside_a_node_that_sends_nothing_raises_a_gateway(make_links):
    """Where devices read the levels their places count, and two gateways cannot locate an emitter."""
    receiver_m = np.column_stack([np.arange(40) * 30.0, np.zeros(40), np.full(40, 20.0)])
    links = make_links([[0.0, 0, 30.0], [600.0, 50, 30.0]], receiver_m)
    assert Interference().unavailable(links) is None
    uplink = links.with_ends(reads=np.array([True, True]))
    assert "read at 2 positions" in Interference().unavailable(uplink)
    power = with_params(Interference, **EMITTER).term(uplink, None).inputs
    np.testing.assert_allclose(power, heard(links.device_m[links.device], np.array([120.0, 80.0, 1.5]), -90.0))


def test_an_emitter_at_the_edge_of_the_searched_area_is_implausible():
    edge, inside = (with_params(Interference, **EMITTER | {"place_m": (x_m, 80.0)}) for x_m in (300.0, 250.0))
    assert "edge" in edge.implausible(np.zeros(0)) and inside.implausible(np.zeros(0)) is None


@pytest.mark.slow
def test_an_emitter_is_found_at_its_position(open_ground, loop):
    world = open_ground.fly(21)
    power = heard(world.receiver_m, np.array([330.0, 140.0, 3.0]), -99.0)
    world.gain_db = 10 * np.log10(watts(world.gain_db) + power)
    found = loop(open_ground.measured(world))
    assert found.names == ["interference"]
    off_m = np.hypot(found.first["x_m"].value - 330, found.first["y_m"].value - 140)
    assert off_m < 20 and found.first["level_at_100_m"].value == pytest.approx(-99, abs=1)
    assert found.error["after"]["nll"] < found.error["before"]["nll"] - 0.1


@pytest.mark.slow
def test_a_floor_that_is_the_same_everywhere_is_no_emitter(open_ground, loop):
    world = open_ground.fly(22)
    world.gain_db = 10 * np.log10(watts(world.gain_db) + watts(-97.0))
    assert loop(open_ground.measured(world)).names == ["noise_floor_censoring"]


@pytest.fixture
def walled():
    """A long wall, 60 m high, along the y axis at x = 150 m."""
    return city_of_boxes([[148, -150, 0], [152, 450, 60]])


def walled_level_db(links, exact=False):
    """A channel by hand: free space, and 17 dB less through the wall."""
    device_m = links.device_m[links.device]
    hidden = (device_m[:, 0] < 150) & (links.receiver_m[:, 0] > 150) & (links.receiver_m[:, 2] < 60)
    return -40.0 - 20 * np.log10(np.linalg.norm(links.receiver_m - device_m, axis=1)) - 17.0 * hidden


def test_over_a_map_its_power_falls_as_that_of_a_device(make_links, walled):
    receiver_m = np.array([[50.0, 80, 30], [250.0, 80, 30], [250.0, 80, 400]])  # beside it, behind the wall, above it
    links = make_links([[0.0, 0, 1.5], [0.0, 200, 20.0]], receiver_m, city=walled)
    emitter = with_params(Interference, **EMITTER | {"level_db": -10.0, "through_channel": True})
    power = emitter.term(links, walled_level_db).inputs
    expected = heard(links.receiver_m, np.array([120.0, 80.0, 1.5]), -40.0 - 40.0 - 10.0)
    np.testing.assert_allclose(10 * np.log10(power / expected), np.where(links.receiver_m[:, 2] == 400, 0, np.where(
        links.receiver_m[:, 0] == 250, -17, 0)), atol=1e-9)


def test_an_emitter_that_a_wall_hides_is_found(make_links, view, walled):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(0, 300, (400, 2)), np.full(400, 25.0)])
    links = make_links([[150.0, -40, 40.0]], receiver_m, city=walled)
    emitter_m = np.array([60.0, 120.0, 1.5])
    mean_db = -60 - 22 * np.log10(links.distance_m)
    power = heard(links.receiver_m, emitter_m, -100.0)
    power[links.receiver_m[:, 0] > 150] /= 50  # behind the wall
    links.level_db[:] = 10 * np.log10(watts(mean_db) + power) + rng.normal(0, 1.0, 400)
    best = Interference().propose(view(links, mean_db, 1.0, level_at=walled_level_db))[0]
    assert np.hypot(*(np.array(best.place_m) - emitter_m[:2])) < 30 and best.through_channel
    assert best.level_db == pytest.approx(-20, abs=6)


def test_a_part_of_the_links_is_searched_where_all_of_them_found_it(make_links, view):
    """A part whose own links propose nothing, as the emitter is far below the level there, still tries it."""
    rng = np.random.default_rng(0)
    links = make_links([[0.0, 0, 1.5]], np.column_stack([rng.uniform(0, 300, (60, 2)), np.full(60, 60.0)]))
    weak, seen = with_params(Interference, **EMITTER | {"level_db": -190.0}), view(links, 0.0, 2.0)
    assert Interference().propose(seen) == [] and weak.propose_for_fold(seen) == [weak.params]
