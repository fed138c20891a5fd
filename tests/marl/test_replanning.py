"""Re-planning in flight."""

import numpy as np
import pytest

from marl.environment import Environment
from marl.flights import fly
from marl.planner import PlanPolicy, plan
from marl.replanning import ReplanPolicy


class Surprising(Environment):
    """Each device has 0 to twice the data of the mission; with `loses`, a UAV fails after the first slot."""

    loses = False

    def reset(self, which=None):
        frame = super().reset(which)
        frame.data_units[:] = self.mission.data_units * self._rng.uniform(0, 2, frame.data_units.shape)
        return frame

    def step(self, action):
        collected = super().step(action)
        if self.loses:
            self.frame.battery[:, 0], self.frame.assigned[:, 0] = 0, -1
        return collected


def policy(mission, linked, every=4, iterations=200):
    return ReplanPolicy(mission, None, linked, every, iterations, 1000, 0, np.random.default_rng(0))


@pytest.mark.parametrize("linked", [True, False])
def test_every_action_is_feasible_under_disturbance(tiny, slow, linked):
    mission = tiny(1, sigma_db=2.0, battery=(30, 25))
    environment = Surprising(mission, 8, np.random.default_rng(0))
    environment.loses = True
    flights = fly(environment, policy(mission, linked))
    homes = [slow.ways_home(mission, u) for u in range(mission.uavs)]
    for flight in range(8):
        for slot in range(flights.length[flight]):
            for u in range(mission.uavs):
                row, column = flights.frames.cell[flight, slot, u]
                can = slow.feasible(homes[u], row, column, int(flights.frames.battery[flight, slot, u]))
                assert can[flights.action[flight, slot, u]]


@pytest.mark.parametrize("linked", [True, False])
def test_without_disturbance_it_flies_the_plan_or_a_better_one(tiny, linked):
    mission = tiny(2, battery=(30, 30))
    first = plan(mission, 1000, 0)
    flights = fly(Environment(mission, 2, np.random.default_rng(0)), policy(mission, linked))
    assert flights.ratio(mission).min() >= first.ratio - 1e-6
    never = fly(Environment(mission, 1, np.random.default_rng(0)), policy(mission, linked, every=1000))
    np.testing.assert_array_equal(never.action[0], first.actions)


def test_data_seen_in_flight_improve_the_plan(tiny):
    """Three devices that only one UAV reaches, one at a time; what they have is known on arrival."""
    mission = tiny(3, rows=9, columns=9, uavs=2, devices=5, battery=(46, 46), data_units=np.full(5, 1500.0),
                   snr_db=np.where(np.random.default_rng(0).random((2, 5, 9, 9)) < 0.1, 25.0, -np.inf))
    def worth(flier):
        return fly(Surprising(mission, 40, np.random.default_rng(1)), flier).ratio(mission).mean()
    fixed = worth(PlanPolicy(plan(mission, 1000, 0).actions))
    assert worth(policy(mission, True)) > fixed + 0.01


def test_without_a_link_a_uav_does_not_know_what_another_one_sees(tiny):
    mission = tiny(4, uavs=2, devices=2, snr_db=np.array([[[[30.0]], [[-np.inf]]], [[[-np.inf]], [[30.0]]]]))
    mission = mission._replace(uav_link_db=np.array([-1000.0, 0.0]))  # out of reach of each other
    for linked, known in ((True, [[7, 9], [7, 9]]), (False, [[7, 500], [500, 9]])):
        flier = policy(mission._replace(data_units=np.array([500.0, 500.0])), linked)
        flier.start(mission, 1)
        frame = Environment(mission, 1, np.random.default_rng(0)).reset()
        frame.data_units[:] = [7, 9]
        flier.act(frame)
        minds = flier._flights[0]
        np.testing.assert_array_equal([minds[min(u, len(minds) - 1)].seen for u in range(2)], known)
