"""Ends with wrong positions or clocks: levels change as the law says of the true ones, for the links of that end only."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset
from radiotwin.effects.catalogue.position_errors import DevicePositionError, ReceiverPositionError
from radiotwin.effects.params import Estimate
from tests.effects.conftest import law_db, with_params

DEVICES_M = np.array([[0.0, 0, 1.5], [150, 40, 1.5], [150, 40, 1.5]])  # the third shares the mast of the second
MOVE_M = np.array([(0, 0, 0), (36, -22, 0), (36, -22, 0)])
SLOTS, FLIGHTS, SPEED_M_S = 60, 2, 8.0
CLOCK_DEVICES_M = np.array([[0.0, 0, 1.5], [150, 40, 1.5], [-80, 160, 1.5]])


@pytest.fixture
def links(make_links):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-150, 250, (300, 2)), np.full(300, 40.0)])
    return make_links(DEVICES_M, receiver_m, receiver=np.repeat(np.arange(300) % 2, 3))


def moved_db(links, device_m, receiver_m):
    """Change of level by the law if ends are elsewhere than declared."""
    return -40 - 22 * np.log10(np.linalg.norm(receiver_m - device_m, axis=1)) - law_db(links)


def of_receiver(links, receiver, move_m):
    return links.receiver_m + (links.receiver == receiver)[:, None] * np.array(move_m)


@pytest.mark.parametrize("seed", range(2))
def test_a_mast_elsewhere_changes_its_own_links_and_is_proposed_as_one(links, view, seed):
    expected_db = moved_db(links, (DEVICES_M + MOVE_M)[links.device], links.receiver_m)
    term = with_params(DevicePositionError, device=1, move_m=(36.0, -22.0)).term(links, law_db)
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    assert np.abs(term.offset_db[links.device == 0]).max() == 0 and np.abs(expected_db).max() > 3
    links.level_db[:] = law_db(links) + expected_db + np.random.default_rng(seed).normal(0, 0.5, len(links))
    given = view(links, law_db(links), 0.5, law_db)
    (params,) = DevicePositionError().propose(given)
    assert params.device == 1 and np.hypot(params.move_m[0] - 36, params.move_m[1] + 22) < 15
    found = replace(given, found=(DevicePositionError().with_params(params),))
    assert all(other.device == 0 for other in DevicePositionError().propose(found))


def test_each_device_of_a_mast_is_corrected_from_where_it_was_declared(links):
    beside_m = links.device_m + [[0, 0, 0], [0, 0, 0], [0.6, -0.3, 0]]
    found = with_params(DevicePositionError, device=1, move_m=(36.0, -22.0)).parameters(
        links.with_devices(beside_m), Estimate(np.zeros(0), (), np.ones((2, 2))))
    values = [found[f"{axis}_m[{links.device_names[device]}]"].value for device in (1, 2) for axis in "xy"]
    assert values == pytest.approx([186.0, 18.0, 186.6, 17.7])


def test_a_receiver_elsewhere_changes_its_own_links_and_is_proposed_with_its_direction(links, view):
    term = with_params(ReceiverPositionError, receiver=0, move_m=(0.0, 5.0, -25.0)).term(links, law_db)
    expected_db = moved_db(links, DEVICES_M[links.device], of_receiver(links, 0, (0, 5, -25)))
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    links.level_db[:] = law_db(links) + np.random.default_rng(1).normal(0, 0.5, len(links)) + moved_db(
        links, DEVICES_M[links.device], of_receiver(links, 1, (0, 0, 21)))
    (params,) = ReceiverPositionError().propose(view(links, law_db(links), 0.5, law_db))
    assert params == ReceiverPositionError.Params(receiver=1, move_m=(0.0, 0.0, 20.0))


def test_an_end_at_its_declared_position_is_left_there(links, view):
    links.level_db[:] = law_db(links) + np.random.default_rng(2).normal(0, 0.5, len(links))
    given = view(links, law_db(links), 0.5, law_db)
    assert DevicePositionError().propose(given) == [] and ReceiverPositionError().propose(given) == []


@pytest.mark.parametrize(("effect", "params", "size"), [
    (DevicePositionError, {"device": 0, "move_m": (3.0, 3.0)}, "4.2 m"),
    (DevicePositionError, {"device": 0, "move_m": (3.0, 4.2)}, ""),
    (ReceiverPositionError, {"receiver": 0, "move_m": (0.0, 0.0, 4.9)}, "4.9 m"),
    (ReceiverPositionError, {"receiver": 0, "move_m": (3.0, 0.0, 4.9)}, "")])
def test_a_move_within_the_accuracy_of_surveys_is_no_effect(effect, params, size):
    why = with_params(effect, **params).implausible(np.zeros(0))
    assert size in why if size else why is None


def position_m(time_s, receiver, flight):
    """Where a receiver is: on a circle, each with its own phase, 8 m/s."""
    angle = SPEED_M_S / 120 * time_s + 2.0 * receiver + 0.7 * flight
    return np.column_stack([120 * np.sin(angle), 120 * np.cos(angle), np.full(len(angle), 40.0)])


@pytest.fixture
def circling(make_links):
    """Links of two receivers on two flights."""
    time_s, flight, receiver = (np.repeat(each.ravel(), 3) for each in np.meshgrid(
        np.arange(SLOTS, dtype=float), np.arange(FLIGHTS), np.arange(2), indexing="ij"))
    return make_links(CLOCK_DEVICES_M, position_m(time_s, receiver, flight)[::3], receiver=receiver, flight=flight,
                      time_s=1000.0 * flight + time_s)


def late_db(links, offset_s):
    """Level by the law if receiver 1 is where its track has it that much later."""
    there_m = position_m(links.time_s - 1000.0 * links.flight + offset_s * (links.receiver == 1), links.receiver,
                         links.flight)
    return -40 - 22 * np.log10(np.linalg.norm(there_m - CLOCK_DEVICES_M[links.device], axis=1))


def test_the_level_is_that_of_where_the_receiver_is_at_the_other_time(circling):
    late = with_params(ReceiverClockOffset, receiver=1, offset_s=2.5, speed_m_s=SPEED_M_S)
    offset_db = late.term(circling, law_db).offset_db
    assert np.abs(offset_db[circling.receiver == 0]).max() == 0
    inside = circling.time_s % 1000 < SLOTS - 3  # beyond the end of its track its position is unknown
    np.testing.assert_allclose(offset_db[inside], (late_db(circling, 2.5) - law_db(circling))[inside], atol=0.05)
    assert np.abs(offset_db[inside]).max() > 1
    part = circling.select(np.arange(0, len(circling), 7))  # gaps in the selection are none in the tracks
    np.testing.assert_allclose(late.term(part, law_db).offset_db, offset_db[::7], atol=1e-9)


@pytest.mark.parametrize("offset_s", [-5.0, 0.0, 3.0])
def test_the_receiver_and_the_sign_of_a_clock_are_proposed(circling, view, offset_s):
    circling.level_db[:] = late_db(circling, offset_s) + np.random.default_rng(0).normal(0, 0.5, len(circling))
    proposed = ReceiverClockOffset().propose(view(circling, law_db(circling), 0.5, law_db))
    assert [params.receiver for params in proposed] == ([1] if offset_s else [])
    for params in proposed:
        assert params.offset_s == pytest.approx(offset_s, abs=1.2)
        assert params.speed_m_s == pytest.approx(SPEED_M_S, rel=0.01)
