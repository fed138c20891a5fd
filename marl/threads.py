"""Threads and memory of a process that trains, checked before any is taken.

Threads and memory of a process that trains.

Memory that a run would take, checked before any is taken.
"""

import ctypes
import math
import sys

import scipy.linalg  # noqa: F401  compiled code uses its BLAS, limited only once it is loaded
import threadpoolctl
import torch

from marl.features import observation_size, state_size
from marl.mission import Mission
from marl.registry import learner_class
from marl.settings import LearnerSettings, RunSettings
from radiotwin.io.budgets import TRAINING_BYTES

_COPIES = 4  # of the weights: target network, and two moments of the optimiser


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


def check_sizes(run: RunSettings, settings: LearnerSettings, mission: Mission) -> None:
    """Refuse settings that take more memory than `TRAINING_BYTES`.

    Args:
        run: settings of the run.
        settings: settings of learning.
        mission: gives the sizes.

    Raises:
        BadInput: names the option.
    """
    uavs, devices, slots = mission.uavs, mission.devices, mission.longest
    flight = slots * (4 * (uavs * devices + devices + uavs) + 9 * uavs)  # see Frame and Flights
    field = 4 * math.prod(mission.snr_db.shape[1:])  # shadowing that stays for a flight
    subject = f"{slots} slots, {uavs} UAVs and {devices} devices"
    needed = {"flights": run.flights * (flight + field)}
    if learner_class(run.algorithm).learns:
        replicas = uavs if run.algorithm == "fedqmix" else 1
        kept = min(settings.replay, run.real_episodes * run.episodes)
        width, hidden = observation_size(mission) + uavs + 6, settings.hidden
        mixer = state_size(mission) * settings.mixing_width * (uavs + 3)
        needed |= {
            "selection_flights": settings.selection_flights * (flight + field),
            "parallel": settings.parallel * (flight + field),
            "replay": replicas * kept * flight,
            "batch": settings.batch * slots * uavs * 4 * (width + 10 * hidden),
            "hidden": replicas * _COPIES * 4 * hidden * (width + 6 * hidden),
            "mixing_width": replicas * _COPIES * 4 * mixer}
    for name, size in needed.items():
        given = getattr(run if hasattr(run, name) else settings, name)
        TRAINING_BYTES.check(size, f"--{name.replace('_', '-')} {given} with {subject}")
