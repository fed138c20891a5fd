"""GRU with compiled forward and backward loops, for the agents' recurrent layer.

`torch.nn.GRU` spends three quarters of its time on launching small operations, because sequences
are long and matrices small. Parameters and results are those of `torch.nn.GRU` (Cho et al.,
"Learning phrase representations using RNN encoder-decoder", EMNLP 2014, in the variant of cuDNN):

    r = σ(W_r x + U_r h + b_r),  z = σ(W_z x + U_z h + b_z),
    n = tanh(W_n x + b_n + r (U_n h + c_n)),  h' = n + z (h - n)
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import PackedSequence

from radiotwin.runtime.compiled import njit

_ONE, _HALF = np.float32(1), np.float32(0.5)


def gru(x: Tensor, sizes: np.ndarray, memory: Tensor | None,
        unit: torch.nn.GRU) -> tuple[Tensor, Tensor]:
    """Apply a one-layer GRU to packed sequences (as `torch.nn.utils.rnn.PackedSequence`).

    The result is differentiable by x and the parameters, not by the memory.

    Args:
        x: (N, inputs) float32 inputs, slot by slot, the longest sequence first.
        sizes: (T,) int64 number of sequences that reach each slot; their sum is N.
        memory: (sizes[0], hidden) initial hidden state; None: zero.
        unit: the GRU with the parameters.

    Returns:
        hidden states (N, hidden), and those of the last slot (sizes[-1], hidden).
    """
    if x.device.type != "cpu":
        packed = PackedSequence(x, torch.from_numpy(sizes))
        hidden_states = unit(packed, None if memory is None else memory[None])[0].data
    else:
        start = x.new_zeros(int(sizes[0]), unit.hidden_size) if memory is None else memory
        hidden_states = _PackedGru.apply(x, unit.weight_ih_l0, unit.weight_hh_l0, unit.bias_ih_l0,
                                         unit.bias_hh_l0, start, sizes)
    return hidden_states, hidden_states[len(hidden_states) - int(sizes[-1]):]


class _PackedGru(torch.autograd.Function):
    """Differentiable map from inputs (N, inputs) to hidden states (N, H)."""

    @staticmethod
    def forward(context: Any, x: Tensor, weight: Tensor, recurrent: Tensor, bias: Tensor,
                recurrent_bias: Tensor, start: Tensor, sizes: np.ndarray) -> Tensor:
        """See `torch.autograd.Function`; the parameters are those of `torch.nn.GRU`."""
        hidden = len(bias) // 3
        # Both biases of r and z add up; the recurrent bias of n is scaled by r.
        bias = bias.clone()
        bias[:2 * hidden] += recurrent_bias[:2 * hidden]
        # One work array, since allocation costs more than the arithmetic. It holds the inputs'
        # contributions to the gates, then the gates r, z, n, u = U_n h + c_n, then the gradients.
        work = torch.empty(4, len(x), hidden)
        for gate in range(3):
            rows = slice(gate * hidden, (gate + 1) * hidden)
            torch.addmm(bias[rows], x, weight[rows].t(), out=work[gate])
        memories = torch.cat([start, torch.empty(len(x), hidden)])  # with the initial state
        transposed = recurrent.view(3, hidden, hidden).transpose(1, 2).contiguous()
        _forward(work.numpy(), transposed.numpy(), recurrent_bias[2 * hidden:].numpy(),
                 memories.numpy(), sizes)
        context.save_for_backward(x, weight, recurrent, memories)
        context.work, context.sizes = work, sizes
        return memories[len(start):]

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """See `torch.autograd.Function`."""
        x, weight, recurrent, memories = context.saved_tensors
        hidden = gradient.shape[1]
        gate_gradients, context.work = context.work, None  # overwritten: only one backward pass
        before = torch.empty_like(gradient)
        _backward(gradient.contiguous().numpy(), recurrent.view(3, hidden, hidden).numpy(),
                  memories.numpy(), gate_gradients.numpy(), before.numpy(), context.sizes)
        input_gradient = gate_gradients[0] @ weight[:hidden]
        for gate in (1, 2):
            input_gradient.addmm_(gate_gradients[gate], weight[gate * hidden:(gate + 1) * hidden])
        sums = gate_gradients.sum(1)
        return (input_gradient, torch.cat([gate_gradients[gate].t() @ x for gate in (0, 1, 2)]),
                torch.cat([gate_gradients[gate].t() @ before for gate in (0, 1, 3)]),
                sums[:3].flatten(), sums[[0, 1, 3]].flatten(), None, None)


@njit(cache=True, inline="always", fastmath=True, error_model="numpy")
def _tanh(x: np.float32) -> np.float32:
    """Return tanh by a rational approximation that vectorises, exact to 2 ulp of a float32."""
    x = min(max(x, np.float32(-7.9)), np.float32(7.9))
    s = x * x
    p = np.float32(-2.76076847742355e-16)
    p = p * s + np.float32(2.00018790482477e-13)
    p = p * s + np.float32(-8.60467152213735e-11)
    p = p * s + np.float32(5.12229709037114e-08)
    p = p * s + np.float32(1.48572235717979e-05)
    p = p * s + np.float32(6.37261928875436e-04)
    p = p * s + np.float32(4.89352455891786e-03)
    q = np.float32(1.19825839466702e-06)
    q = q * s + np.float32(1.18534705686654e-04)
    q = q * s + np.float32(2.26843463243900e-03)
    q = q * s + np.float32(4.89352518554385e-03)
    return x * p / q


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _cell(r: np.ndarray, z: np.ndarray, n: np.ndarray, u: np.ndarray, r_h: np.ndarray,
          z_h: np.ndarray, n_h: np.ndarray, n_bias: np.ndarray, before: np.ndarray,
          after: np.ndarray) -> None:
    """Compute the gates r, z, n and u, and the hidden states `after`, of one slot in place."""
    for b in range(len(before)):
        for i in range(len(n_bias)):
            r[b, i] = _HALF + _HALF * _tanh(_HALF * (r[b, i] + r_h[b, i]))
        for i in range(len(n_bias)):
            z[b, i] = _HALF + _HALF * _tanh(_HALF * (z[b, i] + z_h[b, i]))
        for i in range(len(n_bias)):
            u[b, i] = n_h[b, i] + n_bias[i]
            n[b, i] = _tanh(n[b, i] + r[b, i] * u[b, i])
        for i in range(len(n_bias)):
            after[b, i] = n[b, i] + z[b, i] * (before[b, i] - n[b, i])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _forward(work: np.ndarray, recurrent: np.ndarray, n_bias: np.ndarray, memories: np.ndarray,
             sizes: np.ndarray) -> None:
    """Run all slots forwards: fill the gates in `work` and the hidden states in `memories`."""
    from_memory = np.empty((3, sizes[0], memories.shape[1]), np.float32)
    before, first = 0, 0  # rows of the slot before in `memories`, and of this slot in `work`
    for size in sizes:
        rows, after = slice(first, first + size), sizes[0] + first
        memory = memories[before:before + size]
        for gate in range(3):
            np.dot(memory, recurrent[gate], from_memory[gate, :size])
        _cell(work[0, rows], work[1, rows], work[2, rows], work[3, rows], from_memory[0],
              from_memory[1], from_memory[2], n_bias, memory, memories[after:after + size])
        before, first = after, first + size


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _cell_backward(gradient: np.ndarray, r: np.ndarray, z: np.ndarray, n: np.ndarray,
                   u: np.ndarray, before: np.ndarray, carried: np.ndarray) -> None:
    """Replace the gates of one slot by the loss's gradients by them; update `carried` in place.

    `carried` is the gradient by the hidden state that goes on to the slot before.
    """
    for b in range(len(before)):
        for i in range(before.shape[1]):
            r_bi, z_bi, n_bi = r[b, i], z[b, i], n[b, i]
            g = carried[b, i] + gradient[b, i]
            n_gradient = g * (_ONE - z_bi) * (_ONE - n_bi * n_bi)
            r[b, i] = n_gradient * u[b, i] * r_bi * (_ONE - r_bi)
            z[b, i] = g * (before[b, i] - n_bi) * z_bi * (_ONE - z_bi)
            n[b, i] = n_gradient
            u[b, i] = n_gradient * r_bi
            carried[b, i] = g * z_bi


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _backward(gradient: np.ndarray, recurrent: np.ndarray, memories: np.ndarray, work: np.ndarray,
              before: np.ndarray, sizes: np.ndarray) -> None:
    """Run all slots backwards: turn `work` into gradients, and fill `before` with prior states."""
    hidden = gradient.shape[1]
    carried = np.zeros((sizes[0], hidden), np.float32)
    from_memory = np.empty((3, sizes[0], hidden), np.float32)
    first = len(gradient)
    for t in range(len(sizes) - 1, -1, -1):
        size = sizes[t]
        first -= size
        rows = slice(first, first + size)
        start = first + sizes[0] - sizes[t - 1] if t > 0 else 0
        before[rows] = memories[start:start + size]
        _cell_backward(gradient[rows], work[0, rows], work[1, rows], work[2, rows], work[3, rows],
                       before[rows], carried)
        np.dot(work[0, rows], recurrent[0], from_memory[0, :size])
        np.dot(work[1, rows], recurrent[1], from_memory[1, :size])
        np.dot(work[3, rows], recurrent[2], from_memory[2, :size])
        for b in range(size):
            for i in range(hidden):
                carried[b, i] += from_memory[0, b, i] + from_memory[1, b, i] + from_memory[2, b, i]
