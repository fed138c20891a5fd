"""Targets, losses and updates against slow double-precision computations."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marl.environment import Environment, Frame
from marl.flights import Flights, HeuristicPolicy, fly
from marl.learner import Learner, _lambda_targets
from marl.settings import LearnerSettings

SETTINGS = LearnerSettings(hidden=6, mixing_width=4, target_every=3, reward_scale=500.0)


def flown(mission, count=3, seed=0):
    rng = np.random.default_rng(seed)
    return fly(Environment(mission, count, rng), HeuristicPolicy("random", rng))


def different_target(learner):
    """A target network that is not the present one."""
    with torch.no_grad():
        for module in (learner.target_agent, learner.target_mixer):
            for parameter in module.parameters() if module else ():
                parameter.mul_(0.7).add_(0.05)
    return learner


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=50, deadline=None)
def test_lambda_returns_are_the_weighted_sum_of_n_step_returns(seed, discount, td_lambda):
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 8, 3)
    reward, best = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    valid = (np.arange(7)[:, None] < lengths).astype(float)
    got = _lambda_targets(*(torch.from_numpy(array) for array in (reward, best, valid)), discount, td_lambda).numpy()
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


@pytest.mark.parametrize("mix", [True, False])
@pytest.mark.parametrize("double_q", [True, False])
def test_the_loss_is_the_mean_squared_td_error_of_what_was_flown(tiny, slow, mix, double_q):
    mission = tiny(2, sigma_db=1.0)
    learner = different_target(Learner(SETTINGS.model_copy(update={"mix": mix, "double_q": double_q}), mission, 0))
    flights = flown(mission)
    nets = {name: {key: value.detach().numpy().copy() for key, value in getattr(learner, name).named_parameters()}
            for name in ("agent", "mixer", "target_agent", "target_mixer") if getattr(learner, name)}
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
        learner = Learner(SETTINGS, mission, 0)
        learner.update(batch, mission, 1e-3)
        results.append([parameter.detach().numpy().copy() for parameter in learner.parameters()])
    for one, other in zip(*results):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_the_target_network_follows_every_so_many_updates(tiny):
    mission = tiny(0)
    learner, flights = Learner(SETTINGS, mission, 0), flown(tiny(0))
    for update in range(1, 7):
        learner.update(flights, mission, 1e-2)
        same = all(torch.equal(a, b) for a, b in zip(learner.agent.parameters(), learner.target_agent.parameters()))
        assert same == (update % 3 == 0)


def test_repeated_updates_fit_a_batch(tiny):
    mission = tiny(0)
    learner, flights = Learner(SETTINGS.model_copy(update={"td_lambda": 1.0}), mission, 0), flown(mission, 8)
    losses = [learner.update(flights, mission, 1e-2)["loss"] for _ in range(150)]
    assert losses[-1] < 0.1 * losses[0]


def test_a_learner_goes_on_from_its_state_to_the_bit(tiny):
    mission, flights = tiny(0), flown(tiny(0))
    unbroken, stopped, again = (Learner(SETTINGS, mission, seed) for seed in (0, 0, 5))
    for _ in range(4):
        unbroken.update(flights, mission, 1e-2)
    for _ in range(2):
        stopped.update(flights, mission, 1e-2)
    again.load_state(stopped.state())
    for _ in range(2):
        again.update(flights, mission, 1e-2)
    for one, other in zip(unbroken.parameters(), again.parameters()):
        assert torch.equal(one, other)


def test_flights_of_an_earlier_twin_are_seen_with_the_positions_known_now(tiny):
    mission, flights = tiny(0), flown(tiny(0))
    moved = mission._replace(known_m=mission.known_m + 10.0)
    learner = Learner(SETTINGS, mission, 0)
    before, after = (learner._tensors(flights, each)[0] for each in (mission, moved))
    assert isinstance(flights, Flights) and not torch.equal(before, after)
    assert torch.equal(before[..., 0], after[..., 0])  # the SNR is what it was
