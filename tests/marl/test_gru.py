"""The compiled recurrent unit against PyTorch's."""

import numpy as np
import pytest
import torch
from torch.nn.utils.rnn import PackedSequence

from marl.gru import gru


@pytest.mark.parametrize("sizes, inputs, hidden", [([1], 3, 4), ([1] * 7, 5, 8), ([6], 5, 8), ([9] * 40, 16, 12), ([9, 9, 4, 4, 3, 1], 7, 8)])
@pytest.mark.parametrize("with_memory", [False, True])
def test_it_is_pytorchs_forwards_and_backwards(sizes, inputs, hidden, with_memory):
    torch.manual_seed(0)
    unit, sizes = torch.nn.GRU(inputs, hidden), np.array(sizes)
    x = torch.randn(sizes.sum(), inputs, requires_grad=True)
    memory = torch.randn(sizes[0], hidden) if with_memory else None
    weight = torch.randn(sizes.sum(), hidden)

    def expected():
        values, last = unit(PackedSequence(x, torch.from_numpy(sizes)), None if memory is None else memory[None])
        return values.data, last[0, :sizes[-1]]

    results = []
    for function in (expected, lambda: gru(x, sizes, memory, unit)):
        unit.zero_grad()
        x.grad = None
        values, last = function()
        (values * weight).sum().backward()
        results.append([values, last, x.grad.clone(), *(parameter.grad.clone() for parameter in unit.parameters())])
    for wanted, got in zip(*results, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-4, atol=2e-5)


def test_large_inputs_saturate_and_stay_finite():
    unit = torch.nn.GRU(4, 4)
    x = 1e4 * torch.randn(5, 3, 4)
    torch.testing.assert_close(gru(x.flatten(0, 1), np.full(5, 3), None, unit)[0].view(5, 3, 4), unit(x)[0], rtol=1e-4,
                               atol=1e-5)
