"""Which policy, and which plan, flies."""

import numpy as np
import pytest
import torch

import marl.strategies
from marl.planner import Plan
from marl.settings import PRESETS, RunSettings
from marl.strategies import make_strategy

LEARNER = PRESETS["fast"].model_copy(update={"parallel": 4, "batch": 4, "replay": 20, "federate_every": 8,
                                             "hidden": 8, "selection_flights": 4})
RUN = RunSettings(algorithm="qmix", episodes=24)


class Seen:
    """Stands for flights of which the collected share is known beforehand."""

    def __init__(self, share):
        self._share = share

    def ratio(self, mission):
        return np.array([self._share])


def weights(strategy):
    return torch.cat([parameter.detach().ravel().clone() for parameter in strategy._best.parameters()])


def prepared(tiny, monkeypatch, shares, learner=LEARNER, rounds=1):
    """The strategy, the weights that flew in each look, and the number of looks."""
    shares, looked = iter(shares), []

    def evaluate(mission, policy, flights, rng):
        looked.append(torch.cat([parameter.detach().ravel().clone() for parameter in policy._agent.parameters()]))
        return Seen(next(shares))

    monkeypatch.setattr(marl.strategies, "evaluate", evaluate)
    mission = tiny(0)
    strategy = make_strategy(RUN, learner, mission, rounds, "cpu")
    for _ in range(rounds):
        strategy.prepare(mission, lambda _: None)
    return strategy, looked


@pytest.mark.parametrize("shares, best", [([0.3, 0.6, 0.5], 1), ([0.6, 0.5, 0.4], 0), ([0.1, 0.2, 0.3], 2)])
def test_the_policy_that_does_best_in_the_map_flies(tiny, monkeypatch, shares, best):
    strategy, looked = prepared(tiny, monkeypatch, shares)
    assert len(looked) == 3 and strategy.selection_flights == 12
    assert torch.equal(weights(strategy), looked[best])


@pytest.mark.parametrize("second_look, stays", [(0.5, True), (0.3, False)])
def test_an_earlier_best_flies_on_if_it_is_still_best_in_the_new_map(tiny, monkeypatch, second_look, stays):
    strategy, looked = prepared(tiny, monkeypatch, [0.3, 0.6, 0.5, second_look, 0.4, 0.45, 0.44], rounds=2)
    assert torch.equal(looked[3], looked[1])  # looked at again, in the new map
    assert torch.equal(weights(strategy), looked[1] if stays else looked[5])


def test_without_looks_the_last_policy_flies(tiny, monkeypatch):
    strategy, looked = prepared(tiny, monkeypatch, [], LEARNER.model_copy(update={"selection_flights": 0}))
    assert not looked and strategy.selection_flights == 0
    mean = strategy._replicas.call("weights")[0]
    agent = torch.cat([torch.from_numpy(mean[f"agent.{name}"]).ravel() for name, _ in
                       strategy._best.named_parameters()])
    assert torch.equal(weights(strategy), agent)


@pytest.mark.parametrize("shares, kept", [((0.50, 0.51), 0), ((0.50, 0.53), 1)])
def test_a_teacher_changes_its_plan_only_for_one_that_is_clearly_better(tiny, monkeypatch, shares, kept):
    mission = tiny(0)
    plans = [np.full((mission.longest, mission.uavs), number, np.int8) for number in (0, 5)]
    strategy = make_strategy(RUN.model_copy(update={"guide": "planner"}), LEARNER, mission, 2, "cpu")
    new, seen = iter(plans), iter(shares)
    monkeypatch.setattr(marl.strategies, "plan", lambda *_: Plan(next(new), 0.0, None, None))
    monkeypatch.setattr(marl.strategies, "evaluate", lambda *_: Seen(next(seen)))
    strategy._actions = strategy._better_plan(mission)
    np.testing.assert_array_equal(strategy._better_plan(mission), plans[kept])
