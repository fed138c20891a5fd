"""Flights from one random cell to the next."""

import numpy as np
import pytest

from marl.environment import Environment
from marl.features import observe
from marl.flights import HeuristicPolicy, fly
from marl.planner import PlanPolicy
from marl.waypoints import waypoint_actions


def seen(mission, policy):
    """Distinct cells that all UAVs fly over."""
    cells = fly(Environment(mission, 1, np.random.default_rng(0)), policy).frames.cell[0]
    return len(np.unique(cells.reshape(-1, 2), axis=0))


@pytest.mark.parametrize("seed", range(5))
def test_every_action_is_feasible_and_all_uavs_land_with_an_empty_battery(small_scene, city_mission, seed):
    actions = waypoint_actions(small_scene, city_mission, np.random.default_rng(seed))
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


def test_they_get_about_more_than_random_steps(small_scene, city_mission):
    about, steps = (np.mean([seen(city_mission, make(np.random.default_rng(seed))) for seed in range(20)])
                    for make in (lambda rng: PlanPolicy(waypoint_actions(small_scene, city_mission, rng)),
                                 lambda rng: HeuristicPolicy("random", rng)))
    assert about > 1.2 * steps


def test_the_same_random_numbers_fly_the_same(small_scene, city_mission):
    one, same, other = (waypoint_actions(small_scene, city_mission, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
