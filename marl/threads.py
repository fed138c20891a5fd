"""Threads and memory of a process that trains."""

import ctypes
import sys

import scipy.linalg  # noqa: F401  compiled code uses its BLAS, limited only once it is loaded
import threadpoolctl
import torch


def limit_threads(count: int) -> None:
    """Let PyTorch and every BLAS use `count` threads in this process from now on.

    On matrices as small as here, one is fastest.
    """
    torch.set_num_threads(count)
    threadpoolctl.threadpool_limits(count)


def keep_memory() -> None:
    """Let the C library keep freed memory for the next update, which saves an eighth of the time.

    Only the GNU library needs this.
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        mmap_threshold, trim_threshold = -3, -1  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD of malloc.h
        ctypes.CDLL(None).mallopt(mmap_threshold, 32 << 20)
        ctypes.CDLL(None).mallopt(trim_threshold, 512 << 20)
