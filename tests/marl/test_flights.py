"""Records of flights, and policies."""

import numpy as np
import pytest
import torch

from marl.environment import Environment
from marl.exploration import Exploration
from marl.features import observation_size, observe
from marl.flights import AgentPolicy, HeuristicPolicy, fly, track_table
from marl.networks import Agent


@pytest.fixture
def agent(city_mission):
    return Agent(observation_size(city_mission), city_mission.uavs, 8, torch.Generator().manual_seed(0))


class Watching:
    """Keeps what another policy saw and did."""

    def __init__(self, policy):
        self.policy, self.frames, self.actions = policy, [], []

    def start(self, mission, flights):
        self.policy.start(mission, flights)

    def act(self, frame):
        self.frames.append(frame.copy())
        self.actions.append(self.policy.act(frame).copy())
        return self.actions[-1]


def test_a_record_is_what_was_seen_and_done(city_mission):
    rng = np.random.default_rng(0)
    watching = Watching(HeuristicPolicy("random", rng))
    flights = fly(Environment(city_mission, 5, rng), watching)
    for slot, (frame, action) in enumerate(zip(watching.frames, watching.actions)):
        for kept, seen in zip(flights.frames, frame):
            np.testing.assert_array_equal(kept[:, slot], seen)
        np.testing.assert_array_equal(flights.action[:, slot], action)
    for e, length in enumerate(flights.length):
        batteries = [frame.battery[e].max() for frame in watching.frames]
        assert batteries[length - 1] > 0 and all(battery == 0 for battery in batteries[length:])
    assert flights.length.max() == len(watching.frames) <= city_mission.longest


def test_without_exploration_the_feasible_action_of_greatest_value_is_flown(city_mission, agent):
    rng = np.random.default_rng(0)
    flights = fly(Environment(city_mission, 3, rng), AgentPolicy(agent))
    count, slots = flights.action.shape[:2]
    for e in range(count):
        frames = type(flights.frames)(*(array[e] for array in flights.frames))
        observation, mask = observe(city_mission, frames)
        last = np.concatenate([np.full((1, city_mission.uavs), -1), flights.action[e, :-1]]).astype(np.int64)
        values, _ = agent(torch.from_numpy(observation)[:, None], torch.from_numpy(last)[:, None])
        best = np.where(mask, values[:, 0].detach().numpy(), -np.inf).argmax(-1)
        np.testing.assert_array_equal(flights.action[e, :flights.length[e]], best[:flights.length[e]])


@pytest.mark.parametrize("mean_slots", [1.0, 4.0])
def test_exploration_is_as_frequent_as_epsilon_says_and_safe(city_mission, agent, mean_slots):
    rng = np.random.default_rng(0)
    environment = Environment(city_mission, 400, rng)
    explored = AgentPolicy(agent, exploration=Exploration(0.4, mean_slots, np.random.default_rng(1)))
    certain = AgentPolicy(agent)
    frame = environment.reset()
    for policy in (explored, certain):
        policy.start(city_mission, 400)
    one, other = explored.act(frame), certain.act(frame)
    # An explored action is the best one by chance once in as many cases as there are feasible actions.
    feasible = observe(city_mission, frame)[1][0, 0].sum()
    expected = 0.4 / (mean_slots - 0.4 * (mean_slots - 1)) * (1 - 1 / feasible)
    assert abs((one != other).mean() - expected) < 4 * np.sqrt(expected * (1 - expected) / one.size)
    environment = Environment(city_mission, 50, rng)
    fly(environment, AgentPolicy(agent, exploration=Exploration(1.0, mean_slots, rng)))
    home = city_mission.steps_home[np.arange(2), environment.frame.cell[..., 0], environment.frame.cell[..., 1]]
    assert (home == 0).all()


def test_a_guided_flight_follows_the_plan_as_long_as_it_is_told(city_mission, agent):
    rng = np.random.default_rng(0)
    plan = fly(Environment(city_mission, 1, rng), HeuristicPolicy("greedy", rng)).action[0]
    slots = np.array([0, 7, len(plan)])
    flights = fly(Environment(city_mission, 3, rng), AgentPolicy(agent, guide=(plan, slots)))
    np.testing.assert_array_equal(flights.action[1, :7], plan[:7])
    np.testing.assert_array_equal(flights.action[2, :flights.length[2]], plan[:flights.length[2]])
    assert not np.array_equal(flights.action[0, :7], plan[:7])


def test_a_track_table_says_where_each_uav_was_and_what_it_collected(small_scene, city_mission):
    flights = fly(Environment(city_mission, 3, np.random.default_rng(0)),
                  HeuristicPolicy("random", np.random.default_rng(1)))
    table = track_table(small_scene, city_mission, flights, 2)
    assert table["collected"].sum() == pytest.approx(float(flights.collected[2].sum()), rel=1e-5)
    for u, uav in enumerate(small_scene.config.uavs):
        track = table[table["uav"] == uav.uav]
        assert track.iloc[0][["x_m", "y_m", "z_m"]].tolist() == [uav.start_x_m, uav.start_y_m, uav.altitude_m]
        assert set(np.diff(track["time_s"])) == {small_scene.config.mission.slot_s}
        moves_m = np.hypot(np.diff(track["x_m"]), np.diff(track["y_m"]))
        assert set(moves_m) <= {0.0, 20.0} and (track["collected"] > 0).any()
        assert (track.loc[track["collected"] > 0, "device"] != "").all()
