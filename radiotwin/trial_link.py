"""One link that is traced in a process of its own: a wrong library or driver may abort it."""

import math
import subprocess
import sys

from scipy.constants import speed_of_light

TIMEOUT_S = 120  # a first run compiles its kernels
TOLERANCE_DB = 0.01

# A link of 100 m in free space, and one through a sheet of metal, which no ray passes.
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


class TrialFailed(Exception):
    """The link could not be traced; the message is the reason."""


def trace_trial_link(device: str) -> float:
    """Return the gain of a link of 100 m in free space at 2.4 GHz [dB].

    Args:
        device: `cpu` or `cuda`.

    Raises:
        TrialFailed: It cannot be traced, or a ray went through a wall.
    """
    command = [sys.executable, "-P", "-c", _PROGRAM, device]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True,
                              timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise TrialFailed(f"tracing one link did not end within {TIMEOUT_S} s") from None
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise TrialFailed(lines[-1] if lines else f"exit status {done.returncode}")
    return float(done.stdout.split()[-1])
