"""Greedy claims, random choice, and flights from one random cell to the next."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl.environment import Environment, observe
from marl.flights import fly
from marl.heuristics import (
    WEIGHTS,
    HeuristicPolicy,
    greedy_actions,
    random_actions,
    waypoint_actions,
    weighed_actions,
)
from marl.mission import EAST, HOVER, NO_OP, NORTH
from marl.planner import PlanPolicy
from studies.generated import generated_mission


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


@pytest.mark.parametrize("known_m, change, actions", [
    ([[60.0, 40.0]], lambda frame: frame.battery[0].put(0, 0), [NO_OP, EAST]),  # who has landed claims nothing
    ([[60.0, 40.0], [40.0, 80.0]], lambda frame: frame.data_units[0].put(0, 0), [NORTH]),  # an empty device
    ([[np.nan, np.nan], [40.0, 80.0]], lambda frame: None, [NORTH])])  # a device that is not located
def test_greedy_uavs_fly_to_what_is_left(tiny, known_m, change, actions):
    uavs, devices = len(actions), len(known_m)
    mission = tiny(0, uavs=uavs, devices=devices, battery=(30, 30), known_m=known_m, data_units=[1e6] * devices, snr_db=20.0)
    frame = Environment(mission, 1, np.random.default_rng(0)).reset()
    change(frame)
    assert greedy_actions(mission, frame, np.random.default_rng(0)).tolist() == [actions]


def test_random_actions_are_any_feasible_one_with_equal_chances(tiny):
    mission = tiny(0, uavs=1, battery=(30,))
    environment = Environment(mission, 6000, np.random.default_rng(0))
    counts = np.bincount(random_actions(mission, environment.reset(), np.random.default_rng(1))[:, 0], minlength=6)
    assert counts[5] == 0 and np.abs(counts[:5] / 6000 - 0.2).max() < 4 * np.sqrt(0.16 / 6000)


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_every_weighed_action_is_feasible(missions, data):
    mission = data.draw(missions)
    weights = np.random.default_rng(data.draw(st.integers(0, 99))).uniform(0, 3, len(WEIGHTS))
    environment = Environment(mission, 2, np.random.default_rng(0))
    frame = environment.reset()
    for _ in range(mission.longest):
        action = weighed_actions(mission, frame, weights)
        assert np.take_along_axis(observe(mission, frame)[1], action[..., None], axis=-1).all()
        environment.step(action)
    assert environment.done.all()


def test_weighed_flights_collect_more_than_greedy_ones_on_missions_that_they_were_not_tuned_on():
    gains = []
    for seed in range(4):
        mission = generated_mission(seed, uavs=2 + seed % 2)
        weighed, greedy = (fly(Environment(mission, 2, np.random.default_rng(0)),
                               HeuristicPolicy(name, np.random.default_rng(0))).ratio(mission).mean() for name in
                           ("heuristic", "greedy"))
        gains.append(weighed / greedy)
    assert np.mean(gains) > 1.03


def seen(mission, policy):
    """Distinct cells that all UAVs fly over."""
    cells = fly(Environment(mission, 1, np.random.default_rng(0)), policy).frames.cell[0]
    return len(np.unique(cells.reshape(-1, 2), axis=0))


def test_every_action_is_feasible_and_all_uavs_land_with_an_empty_battery(small_scene, city_mission):
    actions = waypoint_actions(small_scene, city_mission, np.random.default_rng(0))
    assert actions.shape == (city_mission.longest, city_mission.uavs)
    environment, policy = Environment(city_mission, 1, np.random.default_rng(0)), PlanPolicy(actions)
    frame = environment.reset()
    policy.start(city_mission, 1)
    uavs = np.arange(city_mission.uavs)
    for _ in range(city_mission.longest):
        action = policy.act(frame)
        assert observe(city_mission, frame)[1][0, uavs, action[0]].all()
        environment.step(action)
    assert environment.done.all()
    assert (city_mission.steps_home[uavs, frame.cell[0, :, 0], frame.cell[0, :, 1]] == 0).all()


def test_waypoint_flights_cover_more_cells_than_random_steps(small_scene, city_mission):
    about, steps = (np.mean([seen(city_mission, make(np.random.default_rng(seed))) for seed in range(20)])
                    for make in (lambda rng: PlanPolicy(waypoint_actions(small_scene, city_mission, rng)),
                                 lambda rng: HeuristicPolicy("random", rng)))
    assert about > 1.2 * steps
