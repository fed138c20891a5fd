"""The memory of flights."""

import numpy as np
import pytest

from marl.environment import Environment
from marl.flights import HeuristicPolicy, fly
from marl.mission import Mission
from marl.replay import Replay

GIB = 2**30


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


def test_samples_are_different_flights_with_equal_chances_cut_to_the_longest(tiny):
    mission = tiny(0)
    replay = Replay(20, mission)
    replay.add(flown(mission, 10, 0))
    rng, counts = np.random.default_rng(1), np.zeros(10)
    for _ in range(500):
        sample = replay.sample(4, rng)
        which = names(sample)
        assert len(set(which)) == 4
        assert sample.action.shape[1] == sample.length.max() == sample.frames.snr_db.shape[1]
        counts[which] += 1
    assert np.abs(counts / 2000 - 0.1).max() < 4 * np.sqrt(0.1 * 0.9 / 2000)


def test_what_was_flown_comes_back_whole(tiny):
    mission = tiny(1)
    replay, flights = Replay(3, mission), flown(mission, 3, 0)
    replay.add(flights)
    sample = replay.sample(3, np.random.default_rng(0))
    for row, source in enumerate(names(sample)):
        slots = sample.length[row]
        assert slots == flights.length[source]
        for kept, original in zip((*sample.frames, sample.action), (*flights.frames, flights.action)):
            np.testing.assert_array_equal(kept[row, :slots], original[source, :slots])


def test_the_state_restores_it(tiny):
    mission = tiny(0)
    replay, other = Replay(5, mission), Replay(5, mission)
    for seed in range(4):
        replay.add(flown(mission, 2, seed))
    other.load_state(replay.state())
    for memory in (replay, other):
        memory.add(flown(mission, 1, 9))
    one, two = (memory.sample(3, np.random.default_rng(0)) for memory in (replay, other))
    for kept, again in zip((*one.frames, one.action, one.collected), (*two.frames, two.action, two.collected)):
        np.testing.assert_array_equal(kept, again)


@pytest.mark.parametrize("battery", [60.0, 80.0])
def test_three_replicas_of_five_thousand_flights_of_the_papers_missions_take_at_most_0_7_gib(battery):
    uavs, devices = 3, 10
    mission = Mission(
        np.zeros((uavs, devices, 2, 2), np.float32), np.zeros((uavs, devices, 2, 2), np.float32),
        np.zeros((uavs, 2, 2), np.int64), np.zeros((uavs, 2), np.int64), np.full(uavs, int(2 * battery)),
        np.zeros(uavs), np.ones(devices), np.zeros((devices, 2)), 20.0, 100.0, 10.0, -np.inf, np.zeros(2), False)
    # Zeros are not yet taken from the system, so this needs no memory.
    assert 3 * Replay(5000, mission).bytes < 0.7 * GIB


def test_flown_again_in_another_map_the_actions_stay_and_what_they_meet_is_new(tiny, monkeypatch):
    monkeypatch.setattr("marl.replay.SIDE_BY_SIDE", 4)  # ten flights are three parts
    here, there = tiny(2), tiny(2)._replace(snr_db=tiny(3).snr_db, known_m=tiny(3).known_m)
    replay = Replay(20, here)
    flights = fly(Environment(here, 10, np.random.default_rng(0)), HeuristicPolicy("random", np.random.default_rng(1)))
    replay.add(flights)
    replay.fly_again(there, np.random.default_rng(2))
    environment = Environment(there, 10, np.random.default_rng(3))
    frame, collected = environment.reset(), []
    for slot in range(flights.action.shape[1]):
        state = replay.state()
        np.testing.assert_array_equal(state["snr_db"][:, slot], frame.snr_db)
        np.testing.assert_array_equal(state["data_units"][:, slot], frame.data_units)
        np.testing.assert_array_equal(state["cell"][:, slot], flights.frames.cell[:, slot])
        np.testing.assert_array_equal(state["battery"][:, slot], flights.frames.battery[:, slot])
        collected.append(environment.step(flights.action[:, slot]))
    state = replay.state()
    assert replay.size == 10
    np.testing.assert_array_equal(state["collected"], np.stack(collected, axis=1))
    np.testing.assert_array_equal(state["action"], flights.action)
    np.testing.assert_array_equal(state["length"], flights.length)
    assert (state["collected"] != flights.collected).any()
