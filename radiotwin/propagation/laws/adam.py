"""Adam without torch.optim, whose first use imports a compiler: seconds in every process."""

from collections.abc import Sequence

import torch

MEAN_RATE, SQUARE_RATE, EPSILON = 0.1, 0.001, 1e-8  # 1 - beta_1, 1 - beta_2, epsilon of the paper


class Adam:
    """Kingma and Ba 2015, algorithm 1, with decoupled weight decay (Loshchilov and Hutter 2019).

    Attributes:
        tensors: parameters, which `step` changes in place.
        mean: first moments of their gradients, of the same shapes.
        square: second moments.
        count: steps taken.
    """

    def __init__(self, tensors: Sequence[torch.Tensor],
                 decay: Sequence[float] | None = None) -> None:
        """Start at zero moments; `decay` is the weight decay of each tensor, None: none."""
        self.tensors = list(tensors)
        self._decay = [0.0] * len(self.tensors) if decay is None else list(decay)
        self.mean = [torch.zeros_like(tensor) for tensor in self.tensors]
        self.square = [torch.zeros_like(tensor) for tensor in self.tensors]
        self.count = 0

    @torch.no_grad()
    def step(self, gradients: Sequence[torch.Tensor], rate: float) -> None:
        """Update the parameters in place by one step, from a gradient for each of `tensors`."""
        self.count += 1
        unbias_mean = 1.0 - (1.0 - MEAN_RATE) ** self.count
        unbias_square = 1.0 - (1.0 - SQUARE_RATE) ** self.count
        for tensor, gradient, mean, square, decay in zip(
                self.tensors, gradients, self.mean, self.square, self._decay, strict=True):
            mean.lerp_(gradient, MEAN_RATE)
            square.lerp_(gradient.square(), SQUARE_RATE)
            tensor.mul_(1.0 - rate * decay)
            tensor.addcdiv_(mean, (square / unbias_square).sqrt_().add_(EPSILON),
                            value=-rate / unbias_mean)

    def state_dict(self) -> dict:
        """Return the count and the moments, from which training can be resumed."""
        return {"count": self.count, "mean": self.mean, "square": self.square}

    @torch.no_grad()
    def load_state_dict(self, state: dict) -> None:
        """Restore count and moments that `state_dict` returned for tensors of the same shapes."""
        self.count = state["count"]
        for name in ("mean", "square"):
            for moment, stored in zip(getattr(self, name), state[name], strict=True):
                moment.copy_(stored)
