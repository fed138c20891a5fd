"""Find out whether tracing and training work on an NVIDIA GPU, by a trial.

The trial link is traced in another process, which a wrong library or driver may abort.
"""

import ctypes
import logging
import math
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Literal, cast

from scipy.constants import speed_of_light

from radiotwin.errors import BadInput, optional_package
from radiotwin.runtime.processes import try_program

TIMEOUT_S = 120  # a first run compiles its kernels
TOLERANCE_DB = 0.01
# Trace a link of 100 m in free space, and one through a sheet of metal.
_PROGRAM = """
import sys
import numpy as np
if sys.argv[1] == "cpu":
    from radiotwin.runtime import llvm
    llvm.prepare()
import mitsuba
mitsuba.set_variant({"cpu": "llvm", "cuda": "cuda"}[sys.argv[1]] + "_ad_mono_polarized")
import sionna.rt
scene = sionna.rt.load_scene(sionna.rt.scene.simple_reflector)
scene.frequency = 2.4e9
one_antenna = sionna.rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.tx_array = scene.rx_array = one_antenna
scene.add(sionna.rt.Transmitter("device", [0.1, 0.1, 10]))
scene.add(sionna.rt.Receiver("free", [100.1, 0.1, 10]))
scene.add(sionna.rt.Receiver("hidden", [0.1, 0.1, -10]))
real, imaginary = sionna.rt.PathSolver(deterministic=True)(scene, max_depth=0).a
free, hidden = (np.square(np.array(real)) + np.square(np.array(imaginary))).reshape(2, -1).sum(1)
if hidden > 0:
    sys.exit("a ray went through a sheet of metal")
print(10 * np.log10(free))
"""
FREE_SPACE_GAIN_DB = 20 * math.log10(speed_of_light / 2.4e9 / (4 * math.pi * 100))
"""Friis' equation for the link of 100 m."""
log = logging.getLogger(__name__)
Device = Literal["cpu", "cuda"]
DEVICES = ("auto", "cpu", "cuda")
DRIVER_VARIABLE = "DRJIT_LIBCUDA_PATH"  # Dr.Jit's own
_ASK_GPUS = ("nvidia-smi", "--query-gpu=name,memory.total,driver_version",
             "--format=csv,noheader,nounits")


class TrialFailed(Exception):
    """Raised if the trial link cannot be traced; the message is the reason."""


def trace_trial_link(device: str) -> float:
    """Trace a link of 100 m in free space at 2.4 GHz on `cpu` or `cuda`; return its gain [dB].

    Raises:
        TrialFailed: tracing fails, a ray went through a wall, or the gain is not Friis'.
    """
    answer, failure = try_program(_PROGRAM, device, TIMEOUT_S)
    if failure:
        raise TrialFailed(failure)
    gain_db = float(answer.split()[-1])
    if not abs(gain_db - FREE_SPACE_GAIN_DB) <= TOLERANCE_DB:  # NaN, too
        raise TrialFailed(f"the link has {gain_db:.2f} dB, free space has "
                          f"{FREE_SPACE_GAIN_DB:.2f} dB")
    return gain_db


@dataclass(frozen=True)
class Gpu:
    """A GPU that the driver lists."""

    name: str
    memory_bytes: int
    driver: str

    def __str__(self) -> str:
        return f"{self.name}, {self.memory_bytes / 2**30:.0f} GiB, driver {self.driver}"


def gpus() -> list[Gpu]:
    """Return the GPUs that `nvidia-smi` lists; empty without that tool."""
    if shutil.which(_ASK_GPUS[0]) is None:
        return []
    answer = subprocess.run(_ASK_GPUS, check=False, capture_output=True, text=True)
    rows = [line.split(", ") for line in answer.stdout.strip().splitlines()]
    return [Gpu(name, int(memory) * 2**20, driver) for name, memory, driver in
            (row for row in rows if len(row) == 3 and row[1].isdigit())] \
        if answer.returncode == 0 else []


def has_driver() -> bool:
    """Return whether NVIDIA's driver is installed."""
    name = os.environ.get(DRIVER_VARIABLE) or (
        "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


NO_DRIVER = "there is no NVIDIA driver on this machine"


@cache
def tracing_refusal() -> str | None:
    """Return why rays cannot be traced on a GPU, found by tracing one link; None if they can."""
    if not has_driver():
        return NO_DRIVER
    try:
        trace_trial_link("cuda")
    except TrialFailed as reason:
        return f"Mitsuba's CUDA variant fails ({reason})"
    return None


@cache
def torch_refusal() -> str | None:
    """Return why PyTorch cannot train on a GPU, found by one small product; None if it can."""
    torch = optional_package("torch", "torch is not installed (`pip install 'radiotwin[nn]'`)")
    if not torch.cuda.is_available():
        return (NO_DRIVER if not has_driver() else
                f"torch {torch.__version__} finds none (a build without CUDA, or the driver)")
    try:
        ones = torch.ones((3, 3), device="cuda")
        product = (ones @ ones).sum().item()
    except RuntimeError as error:
        return f"torch fails on it ({str(error).strip().splitlines()[0][:200]})"
    return None if product == 27 else f"torch multiplies wrongly on it ({product} for 27)"


def tracing_device(wanted: str) -> Device:
    """Resolve the option `--device` for tracing: `auto` becomes `cuda` if that works, else `cpu`.

    Raises:
        BadInput: another word, or `cuda` and it does not work.
    """
    return _device(wanted, "tracing")


def torch_device(wanted: str) -> Device:
    """Resolve the option `--device` for training, like `tracing_device`."""
    return _device(wanted, "training")


def _device(wanted: str, work: Literal["tracing", "training"]) -> Device:
    """Choose `cpu` or `cuda` by the option `--device`, for a kind of work, and log the reason."""
    if wanted not in DEVICES:
        raise BadInput(f"--device {wanted[:60]!r}: allowed are {', '.join(DEVICES)}"
                       + "; --devices names radios" * (work == "tracing"))
    if wanted == "cpu":
        return "cpu"
    refusal = tracing_refusal() if work == "tracing" else torch_refusal()
    if refusal is not None and wanted == "cuda":
        raise BadInput(f"--device cuda: {refusal}; `radiotwin doctor` says what works. Leave the "
                       "option out to use the processor")
    used = "cuda" if refusal is None else "cpu"
    log.info("%s on %s%s", work, used, f": {refusal}" if refusal else "")
    return cast(Device, used)


def share_of_gpu(memory_bytes: int) -> float:
    """Return the share of a GPU for a worker that needs so many bytes of its memory.

    It is 0.0001 to 1, with four decimals as Ray takes it; 1 if the memory is unknown (0).
    """
    memories = [gpu.memory_bytes for gpu in gpus()]
    if not memories or not memory_bytes:
        return 1.0
    return max(1, 10_000 // max(1, min(memories) // memory_bytes)) / 10_000
