"""Flights with a disturbance."""

import numpy as np

from marl.environment import Environment
from marl.flights import fly
from marl.heuristics import HeuristicPolicy
from studies.disturbed import Disturbance, DisturbedEnvironment


def flown(mission, disturbance, flights=200):
    rng = np.random.default_rng(0)
    return fly(DisturbedEnvironment(mission, flights, rng, disturbance), HeuristicPolicy("greedy", rng))


def test_nothing_happens_without_a_disturbance(tiny):
    mission = tiny(0)
    calm = fly(Environment(mission, 20, np.random.default_rng(0)), HeuristicPolicy("greedy", np.random.default_rng(1)))
    np.testing.assert_array_equal(flown(mission, Disturbance(), 20).collected, calm.collected)


def test_volumes_are_uniform_and_the_ratio_refers_to_them(tiny):
    mission = tiny(0, snr_db=60.0, battery=(200, 200))
    flights = flown(mission, Disturbance(volume_spread=1.0), 2000)
    share = flights.frames.data_units[:, 0] / mission.data_units
    assert share.min() >= 0 and share.max() <= 2
    np.testing.assert_allclose(share.mean(axis=0), 1, atol=0.05)
    np.testing.assert_allclose(share.std(axis=0), 1 / 3**0.5, atol=0.05)
    np.testing.assert_allclose(flights.ratio(mission), 1, atol=1e-5)  # all is collected, however much it was


def test_a_failed_uav_stays_where_it_is_and_collects_no_more(tiny):
    mission = tiny(0, uavs=2, battery=(40, 40))
    flights = flown(mission, Disturbance(loss=1.0))
    full = mission.battery[None]
    spent = (flights.frames.battery == 0).argmax(axis=1)  # (E, U) first slot without battery
    lost = spent.argmin(axis=1)
    assert (full == 40).all() and 0.3 < lost.mean() < 0.7
    others = 0.0
    for flight, uav in enumerate(lost):
        slot = spent[flight, uav]
        assert 1 <= slot <= mission.longest // 2
        assert (flights.collected[flight, slot:, uav] == 0).all()
        assert (flights.frames.cell[flight, slot:, uav] == flights.frames.cell[flight, slot, uav]).all()
        others += flights.collected[flight, slot:, 1 - uav].sum()
    assert others > 0  # they go on


def test_a_battery_of_one_hover_can_fail_too(tiny):
    flights = flown(tiny(0, uavs=1, battery=(1,)), Disturbance(loss=1.0), 20)
    assert (flights.length == 1).all()
