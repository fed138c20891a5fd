"""Threads of the numerical libraries. On small matrices more than one costs more than it gives."""

import threadpoolctl
import torch


def limit_threads(count: int) -> None:
    """Let PyTorch and every BLAS use `count` threads in this process from now on."""
    torch.set_num_threads(count)
    threadpoolctl.threadpool_limits(count)
