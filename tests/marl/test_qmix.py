"""QMIX and IQL against double precision: networks, targets, losses, updates; and which policy flies."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import marl.qmix
from marl.environment import Environment, Frame
from marl.flights import Flights, fly
from marl.heuristics import HeuristicPolicy
from marl.learner import make_learner
from marl.qmix import IndependentNetworks, Mixer, QNetworks, td_lambda_targets
from marl.settings import PRESETS, LearnerSettings, RunSettings

SETTINGS = LearnerSettings(hidden=6, mixing_width=4, target_every=3, reward_scale=500.0)
LEARNER = PRESETS["fast"].model_copy(update={"parallel": 4, "batch": 4, "replay": 20, "federate_every": 8,
                                             "hidden": 8, "selection_flights": 4})
RUN = RunSettings(algorithm="qmix", episodes=24)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@given(st.integers(0, 2**31 - 1), st.integers(1, 5), st.floats(0.1, 100))
@settings(max_examples=50, deadline=None)
def test_the_joint_value_never_falls_when_one_value_rises(seed, uavs, scale):
    mixer = Mixer(6, uavs, 7, seeded(seed))
    chosen = (scale * torch.randn(20, uavs, generator=seeded(seed))).requires_grad_()
    state = scale * torch.randn(20, 6, generator=seeded(seed + 1))
    mixer(chosen, state).sum().backward()
    assert (chosen.grad >= 0).all() and (chosen.grad > 0).any()


def flown(mission, count=3, seed=0):
    rng = np.random.default_rng(seed)
    return fly(Environment(mission, count, rng), HeuristicPolicy("random", rng))


def different_target(learner):
    """A target network that is not the online one."""
    with torch.no_grad():
        for module in learner.targets.values():
            for parameter in module.parameters():
                parameter.mul_(0.7).add_(0.05)
    return learner


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=50, deadline=None)
def test_lambda_returns_are_the_weighted_sum_of_n_step_returns(seed, discount, td_lambda):
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 8, 3)
    reward, best = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    valid = (np.arange(7)[:, None] < lengths).astype(float)
    got = td_lambda_targets(*(torch.from_numpy(array)[..., None] for array in (reward, best, valid)), discount,
                            td_lambda)[..., 0].numpy()
    for e, length in enumerate(lengths):
        for t in range(length):
            returns = []
            for n in range(1, length - t + 1):
                ahead = sum(discount**i * reward[t + i, e] for i in range(n))
                if t + n < length:
                    ahead += discount**n * best[t + n, e]
                returns.append(ahead)
            expected = sum((1 - td_lambda) * td_lambda**i * value for i, value in enumerate(returns[:-1]))
            expected += td_lambda ** (len(returns) - 1) * returns[-1]
            assert got[t, e] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("networks", [QNetworks, IndependentNetworks])
@pytest.mark.parametrize("double_q", [True, False])
def test_the_loss_is_the_mean_squared_td_error_of_the_flights(tiny, slow, networks, double_q):
    mission, mix = tiny(2, sigma_db=1.0), networks is QNetworks
    learner = different_target(networks(SETTINGS.model_copy(update={"double_q": double_q}), mission, 0))
    flights = flown(mission)
    modules = learner.modules | {f"target_{name}": module for name, module in learner.targets.items()}
    nets = {name: {key: value.detach().numpy().copy() for key, value in module.named_parameters()}
            for name, module in modules.items()}
    errors = []
    for e, length in enumerate(flights.length):
        frames = [Frame(*(array[e:e + 1, t] for array in flights.frames)) for t in range(length)]
        seen = np.array([[slow.observation(mission, frame, 0, u) for u in range(mission.uavs)] for frame in frames])
        last = np.concatenate([np.full((1, mission.uavs), -1), flights.action[e, :length - 1]])
        now, later = (slow.agent_values(nets[name], seen, last) for name in ("agent", "target_agent"))
        mask = seen[:, :, -8:-2] > 0.5
        best = np.where(mask, now if double_q else later, -np.inf).argmax(-1)
        reward = flights.collected[e, :length].sum(axis=1) / 500.0
        chosen = np.take_along_axis(now, flights.action[e, :length, :, None].astype(int), -1)[..., 0]
        following = np.take_along_axis(later, best[..., None], -1)[..., 0]
        if mix:
            states = [np.array(slow.state(mission, frame, 0)) for frame in frames]
            chosen = np.array([[slow.mixed_value(nets["mixer"], c, s)] for c, s in zip(chosen, states)])
            following = np.array([[slow.mixed_value(nets["target_mixer"], f, s)] for f, s in zip(following, states)])
        target, ahead = np.empty_like(chosen), np.zeros(chosen.shape[1])
        for t in reversed(range(length)):
            target[t] = reward[t] + 0.99 * ahead
            ahead = (1 - SETTINGS.td_lambda) * following[t] + SETTINGS.td_lambda * target[t]
        errors.append((chosen - target).ravel())
    expected = np.mean(np.concatenate(errors) ** 2)
    assert learner.update(flights, mission, 1e-3)["loss"] == pytest.approx(expected, rel=1e-4)


def test_padding_behind_the_end_does_not_matter(tiny):
    mission = tiny(2)
    flights = flown(mission)
    assert flights.length.min() < flights.action.shape[1]
    rng, spoilt = np.random.default_rng(0), copy.deepcopy(flights)
    for e, length in enumerate(flights.length):
        spoilt.frames.data_units[e, length:] = rng.uniform(0, 1000, spoilt.frames.data_units[e, length:].shape)
        spoilt.frames.snr_db[e, length:] = rng.uniform(-50, 50, spoilt.frames.snr_db[e, length:].shape)
        spoilt.collected[e, length:] = 1e6
        spoilt.action[e, length:] = 2
    results = []
    for batch in (flights, spoilt):
        learner = QNetworks(SETTINGS, mission, 0)
        learner.update(batch, mission, 1e-3)
        results.append([parameter.detach().numpy().copy() for parameter in learner.parameters()])
    for one, other in zip(*results):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_the_target_network_follows_every_so_many_updates(tiny):
    mission = tiny(0)
    learner, flights = QNetworks(SETTINGS, mission, 0), flown(tiny(0))
    for update in range(1, 7):
        learner.update(flights, mission, 1e-2)
        same = all(torch.equal(a, b) for a, b in zip(learner.agent.parameters(), learner.targets["agent"].parameters()))
        assert same == (update % 3 == 0)


def test_flights_of_an_earlier_twin_are_seen_with_the_positions_known_now(tiny):
    mission, flights = tiny(0), flown(tiny(0))
    moved = mission._replace(known_m=mission.known_m + 10.0)
    learner = QNetworks(SETTINGS, mission, 0)
    before, after = (learner._batch(flights, each).observation for each in (mission, moved))
    assert isinstance(flights, Flights) and not torch.equal(before, after)
    assert torch.equal(before[..., 0], after[..., 0])  # the SNR is what it was


class Seen:
    """As many flights as `LEARNER` selects by, each with a given collected share."""

    def __init__(self, share):
        self._share = share

    def ratio(self, mission):
        return np.full(LEARNER.selection_flights, self._share)


def best(learner):
    return torch.cat([parameter.detach().ravel().clone() for parameter in learner._best.parameters()])


def prepared(tiny, monkeypatch, shares, learner=LEARNER, rounds=1):
    """The learner, and the weights that flew in each evaluation."""
    shares, looked = iter(shares), []

    def evaluate(mission, policy, flights, rng):
        looked.append(torch.cat([parameter.detach().ravel().clone() for parameter in policy._agent.parameters()]))
        return Seen(next(shares))

    monkeypatch.setattr(marl.qmix, "evaluate", evaluate)
    mission = tiny(0)
    learner = make_learner(RUN, learner, mission, rounds)
    for _ in range(rounds):
        learner.prepare(mission, lambda _: None)
    return learner, looked


@pytest.mark.parametrize("shares, which", [([0.3, 0.6, 0.5], 1), ([0.6, 0.5, 0.4], 0), ([0.1, 0.2, 0.3], 2)])
def test_the_policy_that_does_best_in_the_map_flies(tiny, monkeypatch, shares, which):
    learner, looked = prepared(tiny, monkeypatch, shares)
    assert len(looked) == 3 and learner.selection.flights == 12
    assert torch.equal(best(learner), looked[which])


@pytest.mark.parametrize("second_ratio, stays", [(0.5, True), (0.3, False)])
def test_an_earlier_best_flies_on_if_it_is_still_best_in_the_new_map(tiny, monkeypatch, second_ratio, stays):
    learner, looked = prepared(tiny, monkeypatch, [0.3, 0.6, 0.5, second_ratio, 0.4, 0.45, 0.44], rounds=2)
    assert torch.equal(looked[3], looked[1])  # looked at again, in the new map
    assert torch.equal(best(learner), looked[1] if stays else looked[5])


def test_without_selection_flights_the_last_policy_flies(tiny, monkeypatch):
    learner, looked = prepared(tiny, monkeypatch, [], LEARNER.model_copy(update={"selection_flights": 0}))
    assert not looked and learner.selection.flights == 0
    [mean] = learner._trainers.call("weights")
    agent = torch.cat([torch.from_numpy(mean[f"agent.{name}"]).ravel() for name, _ in
                       learner._best.named_parameters()])
    assert torch.equal(best(learner), agent)
