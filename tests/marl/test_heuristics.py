"""Greedy claims and random choice."""

import numpy as np

from marl.environment import Environment
from marl.flights import HeuristicPolicy, fly
from marl.heuristics import greedy_actions, random_actions
from marl.mission import EAST, HOVER, NORTH


def test_greedy_uavs_claim_different_devices_fly_the_longer_way_first_and_hover_on_top(tiny):
    # Both UAVs are at (40 m, 40 m); device 0 is nearest to both, device 1 next.
    mission = tiny(0, uavs=2, devices=2, battery=(20, 20), known_m=[[60.0, 40.0], [40.0, 80.0]],
                   data_units=[1e6, 1e6], snr_db=20.0)
    environment = Environment(mission, 1, np.random.default_rng(0))
    environment.reset()
    rng = np.random.default_rng(0)
    assert greedy_actions(mission, environment.frame, rng).tolist() == [[EAST, NORTH]]
    environment.step(np.array([[EAST, NORTH]]))
    assert greedy_actions(mission, environment.frame, rng).tolist() == [[HOVER, NORTH]]


def test_greedy_turns_to_another_device_when_one_is_empty(tiny):
    mission = tiny(0, uavs=1, devices=2, battery=(30,), known_m=[[60.0, 40.0], [40.0, 80.0]], data_units=[1.0, 1e6],
                   snr_db=20.0)
    environment = Environment(mission, 1, np.random.default_rng(0))
    environment.reset()
    environment.frame.data_units[0, 0] = 0.0
    assert greedy_actions(mission, environment.frame, np.random.default_rng(0)).tolist() == [[NORTH]]


def test_greedy_ignores_devices_that_nobody_has_located(tiny):
    mission = tiny(0, uavs=1, devices=2, battery=(30,), known_m=[[np.nan, np.nan], [40.0, 80.0]], snr_db=20.0)
    environment = Environment(mission, 1, np.random.default_rng(0))
    assert greedy_actions(mission, environment.reset(), np.random.default_rng(0)).tolist() == [[NORTH]]


def test_random_actions_are_any_feasible_one_with_equal_chances(tiny):
    mission = tiny(0, uavs=1, battery=(30,))
    environment = Environment(mission, 6000, np.random.default_rng(0))
    counts = np.bincount(random_actions(mission, environment.reset(), np.random.default_rng(1))[:, 0], minlength=6)
    assert counts[5] == 0 and np.abs(counts[:5] / 6000 - 0.2).max() < 4 * np.sqrt(0.16 / 6000)


def test_greedy_collects_more_than_random(city_mission):
    mission = city_mission._replace(data_units=2 * city_mission.data_units)
    greedy, chance = (fly(Environment(mission, 32, np.random.default_rng(0)),
                          HeuristicPolicy(name, np.random.default_rng(0))).ratio(mission) for name in
                      ("greedy", "random"))
    assert greedy.mean() > chance.mean() + 0.1
