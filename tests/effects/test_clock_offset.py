"""Levels and positions of different times: the level changes as the law says of where the receiver was."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset

DEVICES_M = np.array([[0.0, 0, 1.5], [150, 40, 1.5], [-80, 160, 1.5]])
SLOTS, FLIGHTS, SPEED_M_S = 60, 2, 8.0


def law_db(links, exact=False):
    return -40 - 22 * np.log10(links.distance_m)


def position_m(time_s, receiver, flight):
    """Where a receiver is: on a circle, each with its own phase, 8 m/s."""
    angle = SPEED_M_S / 120 * time_s + 2.0 * receiver + 0.7 * flight
    return np.column_stack([120 * np.sin(angle), 120 * np.cos(angle), np.full(len(angle), 40.0)])


@pytest.fixture
def links(make_links):
    """Links of two receivers on two flights."""
    time_s, flight, receiver = (each.ravel() for each in np.meshgrid(
        np.arange(SLOTS, dtype=float), np.arange(FLIGHTS), np.arange(2), indexing="ij"))
    receiver, flight, time_s = (np.repeat(each, len(DEVICES_M)) for each in (receiver, flight, time_s))
    every = slice(None, None, len(DEVICES_M))
    return make_links(DEVICES_M, position_m(time_s, receiver, flight)[every], receiver=receiver, flight=flight,
                      time_s=1000.0 * flight + time_s)


def late_db(links, offset_s):
    """Level by the law if receiver 1 is where its track has it that much later."""
    there_m = position_m(links.time_s - 1000.0 * links.flight + offset_s * (links.receiver == 1), links.receiver,
                         links.flight)
    return -40 - 22 * np.log10(np.linalg.norm(there_m - DEVICES_M[links.device], axis=1))


def test_the_level_is_that_of_where_the_receiver_is_at_the_other_time(links):
    params = ReceiverClockOffset.Params(receiver=1, offset_s=2.5, speed_m_s=SPEED_M_S)
    term = ReceiverClockOffset().with_params(params).term(links, law_db)
    assert np.abs(term.offset_db[links.receiver == 0]).max() == 0
    inside = links.time_s % 1000 < SLOTS - 3  # beyond the end of its track its position is unknown
    np.testing.assert_allclose(term.offset_db[inside], (late_db(links, 2.5) - law_db(links))[inside], atol=0.05)
    assert np.abs(term.offset_db[inside]).max() > 1
    part = links.select(np.arange(0, len(links), 7))  # gaps in the selection are none in the tracks
    some = ReceiverClockOffset().with_params(params).term(part, law_db)
    np.testing.assert_allclose(some.offset_db, term.offset_db[::7], atol=1e-9)


@pytest.mark.parametrize("offset_s", [-5.0, 3.0])
def test_the_receiver_and_the_sign_are_proposed(links, view, offset_s):
    links.level_db[:] = late_db(links, offset_s) + np.random.default_rng(0).normal(0, 0.5, len(links))
    (params,) = ReceiverClockOffset().propose(view(links, law_db(links), 0.5, law_db))
    assert params.receiver == 1 and params.offset_s == pytest.approx(offset_s, abs=1.2)
    assert params.speed_m_s == pytest.approx(SPEED_M_S, rel=0.01)


def test_where_clocks_agree_nothing_is_proposed(links, view):
    links.level_db[:] = law_db(links) + np.random.default_rng(1).normal(0, 0.5, len(links))
    assert ReceiverClockOffset().propose(view(links, law_db(links), 0.5, law_db)) == []


def test_without_times_or_movement_it_is_not_looked_for(make_links):
    assert "time_s" in ReceiverClockOffset().unavailable(make_links(DEVICES_M, np.ones((80, 3))))
    still = make_links(DEVICES_M, np.ones((80, 3)), time_s=np.repeat(np.arange(80.0), 3))
    assert "moves" in ReceiverClockOffset().unavailable(still)
