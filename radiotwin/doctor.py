"""Checks of this machine: what works, and how to mend what does not."""

import math
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from rich.console import Console
from scipy.constants import speed_of_light

from radiotwin import llvm
from radiotwin.threads import usable_cores

GIB = 2**30
MIN_MEMORY_GIB = 4  # twice what tracing scenes/rbm takes (docs/results.md)
MIN_DISK_GIB = 2
TRACE_TIMEOUT_S = 120  # a first run compiles its kernels

# One link in free space, in a process of its own: a wrong libLLVM may abort it.
_TRACE = """
import numpy as np
from radiotwin import llvm
llvm.prepare()
import sionna.rt
scene = sionna.rt.load_scene()
scene.frequency = 2.4e9
one_antenna = sionna.rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.tx_array = scene.rx_array = one_antenna
scene.add(sionna.rt.Transmitter("device", [0, 0, 10]))
scene.add(sionna.rt.Receiver("receiver", [100, 0, 10]))
real, imaginary = sionna.rt.PathSolver(deterministic=True)(scene, max_depth=0).a
print(10 * np.log10(float((np.square(real) + np.square(imaginary)).sum())))
"""
# Friis' equation for the same link.
_FREE_SPACE_GAIN_DB = 20 * math.log10(speed_of_light / 2.4e9 / (4 * math.pi * 100))
_REMEDY = "install the versions of sionna-rt, mitsuba and drjit that constraints.txt names"

Rows = list[tuple[str, str]]


@dataclass
class Diagnosis:
    """Findings about this machine.

    Attributes:
        sections: heading -> rows of (item, finding).
        problems: what keeps something from working, with the remedy; one line each.
        cautions: what does not, but may later.
    """

    sections: dict[str, Rows] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)

    @property
    def healthy(self) -> bool:
        """Whether everything works."""
        return not self.problems


def diagnose() -> Diagnosis:
    """Check everything that radiotwin needs; what may crash runs in a process of its own."""
    diagnosis = Diagnosis()
    diagnosis.sections["System"] = [
        ("Python", f"{platform.python_version()} ({sys.executable})"),
        ("platform", platform.platform()),
    ]
    diagnosis.sections["Machine"] = _check_machine(diagnosis)
    diagnosis.sections["GPU"] = _check_gpu()
    diagnosis.sections["Packages"] = _check_packages(diagnosis)
    diagnosis.sections["libLLVM"] = _check_llvm(diagnosis)
    diagnosis.sections["Tracing"] = (
        _check_tracing(diagnosis) if llvm.available()
        else [("rays", "cannot be traced; everything else works")])
    return diagnosis


def print_diagnosis(diagnosis: Diagnosis, console: Console) -> None:
    """Print findings about this machine, and remedies.

    Args:
        diagnosis: to print.
        console: to print on.
    """
    def say(text: str, style: str | None = None) -> None:  # neither wraps paths nor reads markup
        console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    for heading, rows in diagnosis.sections.items():
        say(heading, "bold")
        width = max(len(item) for item, _ in rows)
        for item, finding in rows:
            say(f"  {item:<{width}}  {finding}")
    say("What to do", "bold")
    for lines, style in ((diagnosis.problems, "red"), (diagnosis.cautions, "yellow")):
        for line in lines:
            say(f"  - {line}".replace("\n", "\n    "), style)
    if diagnosis.healthy:
        say("  Everything works.", "green")


def _check_machine(diagnosis: Diagnosis) -> Rows:
    cores = usable_cores()
    memory_gib = _memory_gib()
    disk_gib = shutil.disk_usage(Path.cwd()).free / GIB
    if memory_gib is not None and memory_gib < MIN_MEMORY_GIB:
        diagnosis.cautions.append(f"{memory_gib:.1f} GiB of memory: tracing a city takes up to "
                                  f"{MIN_MEMORY_GIB} GiB")
    if disk_gib < MIN_DISK_GIB:
        diagnosis.cautions.append(f"{disk_gib:.1f} GiB of disk free here: have {MIN_DISK_GIB} GiB "
                                  "before you trace cities")
    return [
        ("cores", str(cores)),
        ("memory", "unknown" if memory_gib is None else f"{memory_gib:.1f} GiB"),
        ("free disk here", f"{disk_gib:.1f} GiB"),
    ]


def _memory_gib() -> float | None:
    """Return the memory of the machine, or its container's limit [GiB]; None if unknown."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return None
    try:
        memory = min(memory, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no container, or "max"
        pass
    return memory / GIB


def _check_gpu() -> Rows:
    """List graphics processors; without one everything runs on the processor."""
    rows = []
    if shutil.which("nvidia-smi"):
        query = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version",
                 "--format=csv,noheader"]
        answer = subprocess.run(query, check=False, capture_output=True, text=True)
        if answer.returncode == 0:
            rows += [("GPU", line) for line in answer.stdout.strip().splitlines()]
    if not rows:
        return [("GPU", "none: everything runs on the processor")]
    try:
        import torch  # takes seconds

        used = torch.cuda.is_available()
        rows.append(("torch", "uses it" if used else
                     "does not use it (a CPU build, or the driver)"))
    except (ImportError, OSError) as error:
        rows.append(("torch", f"cannot be imported: {error}"))
    return rows


def _check_packages(diagnosis: Diagnosis) -> Rows:
    """List the packages that radiotwin declares, with their installed versions."""
    try:
        rows = [("radiotwin", version("radiotwin"))]
        requirements = requires("radiotwin") or []
    except PackageNotFoundError:
        diagnosis.problems.append("radiotwin runs from a folder and is not installed: pip install "
                                  "-e .")
        return [("radiotwin", "not installed")]
    for requirement in requirements:
        name = re.findall(r"^[\w.-]+", requirement)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            rows.append((name, f"not installed (extra '{extra[1]}')" if extra else "MISSING"))
            if not extra and ";" not in requirement:
                diagnosis.problems.append(f"the package {name} is missing: pip install "
                                          f"'{requirement}'")
    return rows


def _check_llvm(diagnosis: Diagnosis) -> Rows:
    chosen = llvm.choose()
    rows = [(str(candidate), "works, chosen" if candidate == chosen
             else llvm.rejection(candidate) or "works") for candidate in llvm.find()]
    if os.environ.get(llvm.VARIABLE):
        rows.append((llvm.VARIABLE, os.environ[llvm.VARIABLE]))
    if chosen is None:
        diagnosis.problems.append(llvm.advice())
    return rows or [("libLLVM", "none found")]


def _check_tracing(diagnosis: Diagnosis) -> Rows:
    """Trace one link in free space and compare it with Friis' equation."""
    item = "one link of 100 m at 2.4 GHz"
    command = [sys.executable, "-P", "-c", _TRACE]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True,
                              timeout=TRACE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        diagnosis.problems.append(f"tracing one link did not end within {TRACE_TIMEOUT_S} s")
        return [(item, "did not end")]
    if done.returncode != 0:
        complaint = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        diagnosis.problems.append(f"tracing fails ({complaint}): {_REMEDY}")
        return [(item, f"fails: {complaint}")]
    gain_db = float(done.stdout.split()[-1])
    if abs(gain_db - _FREE_SPACE_GAIN_DB) > 0.01:
        diagnosis.problems.append(f"tracing gives {gain_db:.2f} dB, free space has "
                                  f"{_FREE_SPACE_GAIN_DB:.2f} dB: {_REMEDY}")
    return [(item, f"{gain_db:.2f} dB (free space: {_FREE_SPACE_GAIN_DB:.2f} dB)")]
