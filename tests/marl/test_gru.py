"""The compiled recurrent unit against PyTorch's."""

import pytest
import torch

from marl.gru import gru


@pytest.mark.parametrize("slots, batch, inputs, hidden", [(1, 1, 3, 4), (7, 1, 5, 8), (1, 6, 5, 8), (40, 9, 16, 12)])
@pytest.mark.parametrize("with_memory", [False, True])
def test_it_is_pytorchs_forwards_and_backwards(slots, batch, inputs, hidden, with_memory):
    torch.manual_seed(0)
    unit = torch.nn.GRU(inputs, hidden)
    x = torch.randn(slots, batch, inputs, requires_grad=True)
    memory = torch.randn(1, batch, hidden) if with_memory else None
    weight = torch.randn(slots, batch, hidden)
    results = []
    for function in (unit, lambda x, memory: gru(x, memory, unit)):
        unit.zero_grad()
        x.grad = None
        values, last = function(x, memory)
        (values * weight).sum().backward()
        results.append([values, last, x.grad.clone(), *(parameter.grad.clone() for parameter in unit.parameters())])
    for expected, got in zip(*results, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=2e-5)


def test_large_inputs_saturate_and_stay_finite():
    unit = torch.nn.GRU(4, 4)
    x = 1e4 * torch.randn(5, 3, 4)
    torch.testing.assert_close(gru(x, None, unit)[0], unit(x)[0], rtol=1e-4, atol=1e-5)


def test_one_sequence_is_its_parts_with_the_memory_carried_over():
    unit = torch.nn.GRU(4, 6)
    x = torch.randn(10, 3, 4)
    whole, last = gru(x, None, unit)
    first, memory = gru(x[:4], None, unit)
    rest, end = gru(x[4:], memory, unit)
    torch.testing.assert_close(torch.cat([first, rest]), whole)
    torch.testing.assert_close(end, last)
