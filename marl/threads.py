"""Threads, memory and device of a process that trains."""

import ctypes
import os
import sys

import scipy.linalg  # noqa: F401  compiled code multiplies with its BLAS, which can only be limited once it is loaded
import threadpoolctl
import torch

from radiotwin.errors import BadInput


def limit_threads(count: int) -> None:
    """Let PyTorch and every BLAS use `count` threads in this process from now on. On small matrices more than one
    costs more than it gives."""
    torch.set_num_threads(count)
    threadpoolctl.threadpool_limits(count)


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_memory() -> None:
    """Let the C library keep freed memory for the next update instead of giving it back to the system, which saves an
    eighth of the time; only the GNU library needs to be told."""
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        mmap_threshold, trim_threshold = -3, -1  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h
        ctypes.CDLL(None).mallopt(mmap_threshold, 32 << 20)
        ctypes.CDLL(None).mallopt(trim_threshold, 512 << 20)


def torch_device(wanted: str) -> str:
    """Where networks are trained, of `auto`, `cpu` and `cuda`.

    Raises:
        BadInput: `cuda` where there is none.
    """
    if wanted == "cuda" and not torch.cuda.is_available():
        raise BadInput("device cuda: torch finds no usable GPU here; leave the option out, or install a CUDA build of "
                       "torch")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted
