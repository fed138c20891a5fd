"""Excursions: how long, until when, and how far they take a UAV."""

import numpy as np
import pytest

from marl.exploration import Exploration

POLICY = 5  # an action that nothing in these masks allows: whoever flies it is not on an excursion


def fly(exploration, slots, flights=2000, feasible=lambda slot: [0, 1, 2, 3, 4]):
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
    actions = fly(Exploration(epsilon, mean_slots, np.random.default_rng(0)), 300)
    assert (actions[100:] != POLICY).mean() == pytest.approx(epsilon, rel=0.02)  # the first slots remember the start


def test_an_excursion_keeps_its_action_and_is_as_long_as_it_should():
    actions = fly(Exploration(0.01, 4.0, np.random.default_rng(1)), 400)
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
    actions = fly(Exploration(1.0, 1000.0, np.random.default_rng(2)), 5, feasible=feasible)
    assert (actions[:3] == 1).all() and (actions[3] == POLICY).mean() > 0.95 and (actions[4] == 2).all()


def test_longer_excursions_lead_further():
    def distance(mean_slots):
        actions = fly(Exploration(1.0, mean_slots, np.random.default_rng(3)), 10, feasible=lambda slot: [1, 3])
        return np.abs((actions == 1).sum(0) - (actions == 3).sum(0).astype(int)).mean()
    assert distance(1.0) == pytest.approx(np.sqrt(2 * 10 / np.pi), rel=0.1)  # a random walk's
    assert distance(8.0) > 1.8 * distance(1.0)
