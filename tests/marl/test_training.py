"""Training: schedules, exploration, memory, reproducibility, and a small mission learned to near its optimum."""


import numpy as np
import pytest
import torch

from marl.environment import Environment, observation_size, observe
from marl.flights import fly
from marl.heuristics import HeuristicPolicy
from marl.qmix import Agent, AgentPolicy, IndependentNetworks, QNetworks, Trainer
from marl.settings import LearnerSettings
from marl.training import Exploration, Replay

SETTINGS = LearnerSettings(hidden=8, mixing_width=4, parallel=4, batch=4, replay=12, epsilon_slots=400)
POLICY = 5  # an action that nothing in these masks allows: whoever flies it is not on an excursion
GIB = 2**30


def test_schedules_are_linear_and_counted_in_slots_and_episodes(tiny):
    trainer = Trainer(QNetworks, SETTINGS, tiny(0), 40, 0)
    assert trainer.epsilon == 1.0 and trainer.learning_rate == SETTINGS.learning_rate
    trainer.train(20)
    assert trainer.epsilon == pytest.approx(1.0 - 0.95 * min(trainer.slots / 400, 1))
    assert trainer.learning_rate == pytest.approx((2e-3 + 2e-4) / 2)
    trainer.train(40)
    assert trainer.learning_rate == pytest.approx(2e-4) and trainer.epsilon == pytest.approx(0.05)


def test_there_is_an_update_for_every_so_many_episodes_once_a_batch_is_there(tiny):
    settings = SETTINGS.model_copy(update={"parallel": 3, "batch": 4, "episodes_per_update": 2})
    trainer = Trainer(QNetworks, settings, tiny(0), 40, 0)
    for episodes, updates in ((3, 0), (3, 2), (6, 5)):  # the first three flights are less than a batch
        trainer.train(episodes)
        assert trainer.networks.updates == updates
    trainer.train(1)  # fewer than fit side by side
    assert trainer.episodes == 13 and trainer.networks.updates == 5


@pytest.mark.parametrize("networks", [QNetworks, IndependentNetworks])
def test_the_same_seed_learns_the_same_weights_and_another_replica_others(tiny, networks):
    mission = tiny(0, sigma_db=1.0)
    trainers = [Trainer(networks, SETTINGS, mission, 40, 0, number) for number in (0, 0, 1)]
    start = [parameter.detach().clone() for parameter in trainers[2].networks.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(start, trainers[0].networks.parameters()))
    records = [trainer.train(12) for trainer in trainers]
    assert records[0] == records[1] != records[2]
    one, same, other = (list(trainer.networks.parameters()) for trainer in trainers)
    assert all(torch.equal(a, b) for a, b in zip(one, same))
    assert any(not torch.equal(a, b) for a, b in zip(one, other))


def test_a_trainer_goes_on_from_its_state_to_the_bit(tiny):
    mission = tiny(0, sigma_db=1.0)
    unbroken, stopped, again = (Trainer(QNetworks, SETTINGS, mission, 40, seed) for seed in (0, 0, 3))
    unbroken.train(8)
    expected = unbroken.train(16)
    stopped.train(8)
    again.load_state(stopped.state())
    assert again.train(16) == expected
    for one, other in zip(unbroken.networks.parameters(), again.networks.parameters()):
        assert torch.equal(one, other)


def test_a_small_mission_is_learnt_to_95_percent_of_its_optimum(corners):
    mission, optimum = corners
    settings = LearnerSettings(hidden=32, mixing_width=16, epsilon_slots=30_000, target_every=20, replay=500,
                               episodes_per_update=2)
    trainer = Trainer(QNetworks, settings, mission, 3000, 0)
    trainer.train(3000)
    rng = np.random.default_rng(0)
    ratio = fly(Environment(mission, 1, rng), AgentPolicy(trainer.networks.agent)).ratio(mission)[0]
    assert 0.95 * optimum <= ratio <= optimum * (1 + 1e-6)


@pytest.fixture
def agent(city_mission):
    return Agent(observation_size(city_mission), city_mission.uavs, 8, torch.Generator().manual_seed(0))


def test_without_exploration_the_feasible_action_of_greatest_value_is_flown(city_mission, agent):
    rng = np.random.default_rng(0)
    flights = fly(Environment(city_mission, 3, rng), AgentPolicy(agent))
    count, slots = flights.action.shape[:2]
    for e in range(count):
        frames = type(flights.frames)(*(array[e] for array in flights.frames))
        observation, mask = observe(city_mission, frames)
        last = np.concatenate([np.full((1, city_mission.uavs), -1), flights.action[e, :-1]]).astype(np.int64)
        values, _ = agent(torch.from_numpy(observation), torch.from_numpy(last), np.ones(len(last), dtype=np.int64))
        best = np.where(mask, values.detach().numpy(), -np.inf).argmax(-1)
        np.testing.assert_array_equal(flights.action[e, :flights.length[e]], best[:flights.length[e]])


def explored(exploration, slots, flights=2000, feasible=lambda slot: [0, 1, 2, 3, 4]):
    """(slots, flights) actions of one UAV in each flight whose policy always says POLICY."""
    exploration.start(flights, 1)
    actions = []
    for slot in range(slots):
        mask = np.zeros((flights, 1, 6), dtype=bool)
        mask[..., feasible(slot)] = True
        actions.append(exploration.change(np.full((flights, 1), POLICY), mask)[:, 0])
    return np.array(actions)


@pytest.mark.parametrize("epsilon, mean_slots", [(0.05, 1.0), (0.05, 4.0), (0.6, 4.0), (1.0, 4.0)])
def test_epsilon_is_the_share_of_the_slots_that_are_explored(epsilon, mean_slots):
    actions = explored(Exploration(epsilon, mean_slots, np.random.default_rng(0)), 300)
    assert (actions[100:] != POLICY).mean() == pytest.approx(epsilon, rel=0.02)  # the first slots remember the start


def test_an_excursion_keeps_its_action_and_is_as_long_as_it_should():
    actions = explored(Exploration(0.01, 4.0, np.random.default_rng(1)), 400)
    lengths, kinds = [], []
    for flight in actions[:-60].T:  # excursions that begin late would be cut off
        starts = np.flatnonzero((flight[1:] != POLICY) & (flight[:-1] == POLICY)) + 1
        for start in starts[starts < 300]:
            stop = start + np.argmax(flight[start:] == POLICY)
            lengths.append(stop - start)
            kinds.append(flight[start])
    assert np.mean(lengths) == pytest.approx(4.0, rel=0.05)
    assert np.bincount(kinds, minlength=5) / len(kinds) == pytest.approx([0.2] * 5, abs=0.03)


def test_an_excursion_ends_where_its_action_is_not_feasible():
    def feasible(slot):
        return [1] if slot < 3 else [2]
    actions = explored(Exploration(1.0, 1000.0, np.random.default_rng(2)), 5, feasible=feasible)
    assert (actions[:3] == 1).all() and (actions[3] == POLICY).mean() > 0.95 and (actions[4] == 2).all()


def flown(mission, count, seed):
    """Random flights; what they collected first is replaced by a number that tells them apart."""
    rng = np.random.default_rng(seed)
    flights = fly(Environment(mission, count, rng), HeuristicPolicy("random", rng))
    flights.collected[:, 0, 0] = 100 * seed + np.arange(count)
    return flights


def names(flights):
    return flights.collected[:, 0, 0].astype(int)


def test_the_oldest_flights_are_overwritten(tiny):
    mission = tiny(0)
    replay = Replay(5, mission)
    for seed in range(4):  # eight flights into five places
        replay.add(flown(mission, 2, seed))
    assert replay.size == 5
    assert sorted(names(replay.sample(5, np.random.default_rng(0)))) == [101, 200, 201, 300, 301]


def test_stored_flights_come_back_whole(tiny):
    mission = tiny(1)
    replay, flights = Replay(3, mission), flown(mission, 3, 0)
    replay.add(flights)
    sample = replay.sample(3, np.random.default_rng(0))
    for row, source in enumerate(names(sample)):
        slots = sample.length[row]
        assert slots == flights.length[source]
        for kept, original in zip((*sample.frames, sample.action), (*flights.frames, flights.action)):
            np.testing.assert_array_equal(kept[row, :slots], original[source, :slots])
