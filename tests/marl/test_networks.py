"""Agent and mixer against double precision, and the mixer's monotony."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marl.networks import Agent, Mixer


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def weights(module):
    return {name: tensor.detach().numpy() for name, tensor in module.named_parameters()}


def test_the_agent_is_the_network_it_says_it_is(slow):
    agent = Agent(11, 3, 8, seeded())
    rng = np.random.default_rng(0)
    seen, last = rng.normal(size=(6, 2, 3, 11)).astype(np.float32), rng.integers(0, 6, (6, 2, 3))
    last[0] = -1
    values, _ = agent(torch.from_numpy(seen), torch.from_numpy(last))
    for flight in range(2):
        expected = slow.agent_values(weights(agent), seen[:, flight], last[:, flight])
        np.testing.assert_allclose(values[:, flight].detach().numpy(), expected, atol=1e-5)


def test_the_agent_walks_slot_by_slot_as_over_the_whole_flight():
    agent = Agent(5, 2, 8, seeded())
    seen, last = torch.randn(7, 3, 2, 5), torch.randint(0, 6, (7, 3, 2))
    whole, _ = agent(seen, last)
    memory, steps = None, []
    for slot in range(7):
        values, memory = agent(seen[slot:slot + 1], last[slot:slot + 1], memory)
        steps.append(values)
    torch.testing.assert_close(torch.cat(steps), whole)


def test_the_mixer_is_the_network_it_says_it_is(slow):
    mixer = Mixer(9, 3, 5, seeded(1))
    chosen, state = torch.randn(4, 2, 3), torch.randn(4, 2, 9)
    total = mixer(chosen, state).detach().numpy()
    for t in range(4):
        for e in range(2):
            expected = slow.mixed_value(weights(mixer), chosen[t, e].double().numpy(), state[t, e].double().numpy())
            assert total[t, e] == pytest.approx(expected, abs=1e-5)


@given(st.integers(0, 2**31 - 1), st.integers(1, 5), st.floats(0.1, 100))
@settings(max_examples=50, deadline=None)
def test_the_joint_value_never_falls_when_one_value_rises(seed, uavs, scale):
    mixer = Mixer(6, uavs, 7, seeded(seed))
    chosen = (scale * torch.randn(20, uavs, generator=seeded(seed))).requires_grad_()
    state = scale * torch.randn(20, 6, generator=seeded(seed + 1))
    mixer(chosen, state).sum().backward()
    assert (chosen.grad >= 0).all() and (chosen.grad > 0).any()


def test_initial_weights_come_from_the_seed_and_not_from_a_global_state():
    torch.manual_seed(1)
    one = weights(Agent(5, 2, 8, seeded(3)))
    torch.manual_seed(2)
    other, different = weights(Agent(5, 2, 8, seeded(3))), weights(Agent(5, 2, 8, seeded(4)))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    assert not np.array_equal(one["encoder.weight"], different["encoder.weight"])
    assert np.abs(one["memory.weight_hh_l0"]).max() <= 8**-0.5
