"""What works on this machine, and what to do about what does not."""

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

GIB = 2**30
MEMORY_WANTED_GIB = 4
DISK_WANTED_GIB = 2
TRACE_TIMEOUT_S = 120

# One link through free space: the whole way from the import to a gain, in a process that may well abort.
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
_FREE_SPACE_GAIN_DB = 20 * math.log10(speed_of_light / 2.4e9 / (4 * math.pi * 100))  # Friis, the same link
_TESTED_VERSIONS = "install the versions of sionna-rt, mitsuba and drjit that constraints.txt names"


@dataclass
class Diagnosis:
    """What was found: rows of (what, finding) under each heading, and one line for each thing to do.

    `problems` keep something from working; `cautions` do not.
    """

    sections: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)

    @property
    def healthy(self) -> bool:
        return not self.problems


def _check_packages(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """The packages that radiotwin itself declares, with the versions that are installed."""
    try:
        rows = [("radiotwin", version("radiotwin"))]
        requirements = requires("radiotwin") or []
    except PackageNotFoundError:
        diagnosis.problems.append("radiotwin runs from a folder and is not installed: pip install -e .")
        return [("radiotwin", "not installed")]
    for requirement in requirements:
        name = re.findall(r"^[\w.-]+", requirement)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            rows.append((name, f"not installed (extra '{extra[1]}')" if extra else "MISSING"))
            if not extra and ";" not in requirement:
                diagnosis.problems.append(f"the package {name} is missing: pip install '{requirement}'")
    return rows


def _check_llvm(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    chosen = llvm.choose()
    rows = []
    for candidate in llvm.find():
        reason = llvm.refusal(candidate)
        state = "works, chosen" if candidate == chosen else reason or "works"
        rows.append((str(candidate), state))
    if os.environ.get(llvm.VARIABLE):
        rows.append((llvm.VARIABLE, os.environ[llvm.VARIABLE]))
    if chosen is None:
        diagnosis.problems.append(llvm.advice())
    return rows or [("libLLVM", "none found")]


def _check_tracing(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Trace one free-space link in a process of its own and hold it against its closed form."""
    name = "one link of 100 m at 2.4 GHz"
    command = [sys.executable, "-c", _TRACE]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=TRACE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        diagnosis.problems.append(f"tracing one link did not end within {TRACE_TIMEOUT_S} s")
        return [(name, "did not end")]
    if done.returncode != 0:
        complaint = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        diagnosis.problems.append(f"tracing fails ({complaint}): {_TESTED_VERSIONS}")
        return [(name, f"fails: {complaint}")]
    gain_db = float(done.stdout.split()[-1])
    if abs(gain_db - _FREE_SPACE_GAIN_DB) > 0.01:
        diagnosis.problems.append(
            f"tracing gives {gain_db:.2f} dB, free space has {_FREE_SPACE_GAIN_DB:.2f} dB: {_TESTED_VERSIONS}"
        )
    return [(name, f"{gain_db:.2f} dB (free space: {_FREE_SPACE_GAIN_DB:.2f} dB)")]


def _check_gpu() -> list[tuple[str, str]]:
    """Graphics processors; none is no problem, everything runs on the processor."""
    rows = []
    if shutil.which("nvidia-smi"):
        query = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
        answer = subprocess.run(query, check=False, capture_output=True, text=True)
        if answer.returncode == 0:
            rows += [("GPU", line) for line in answer.stdout.strip().splitlines()]
    if not rows:
        return [("GPU", "none: everything runs on the processor")]
    try:
        import torch  # takes seconds

        used = torch.cuda.is_available()
        rows.append(("torch", "uses it" if used else "does not use it (a CPU build, or the driver)"))
    except (ImportError, OSError) as error:
        rows.append(("torch", f"cannot be imported: {error}"))
    return rows


def _memory_gib() -> float | None:
    """What this process may use [GiB]: the machine's memory or its container's limit; None if unknown."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return None
    try:
        memory = min(memory, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no container, or "max"
        pass
    return memory / GIB


def _check_machine(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    memory_gib = _memory_gib()
    disk_gib = shutil.disk_usage(Path.cwd()).free / GIB
    if memory_gib is not None and memory_gib < MEMORY_WANTED_GIB:
        diagnosis.cautions.append(
            f"{memory_gib:.1f} GiB of memory: tracing a city takes up to {MEMORY_WANTED_GIB} GiB"
        )
    if disk_gib < DISK_WANTED_GIB:
        diagnosis.cautions.append(
            f"{disk_gib:.1f} GiB of disk free here: have {DISK_WANTED_GIB} GiB before you trace cities"
        )
    return [
        ("cores", str(cores)),
        ("memory", "unknown" if memory_gib is None else f"{memory_gib:.1f} GiB"),
        ("free disk here", f"{disk_gib:.1f} GiB"),
    ]


def diagnose() -> Diagnosis:
    """Look at everything that radiotwin needs; nothing that fails in it can end this process."""
    diagnosis = Diagnosis()
    diagnosis.sections["System"] = [
        ("Python", f"{platform.python_version()} ({sys.executable})"),
        ("platform", platform.platform()),
    ]
    diagnosis.sections["Machine"] = _check_machine(diagnosis)
    diagnosis.sections["GPU"] = _check_gpu()
    diagnosis.sections["Packages"] = _check_packages(diagnosis)
    diagnosis.sections["libLLVM"] = _check_llvm(diagnosis)
    if llvm.available():
        diagnosis.sections["Tracing"] = _check_tracing(diagnosis)
    else:
        diagnosis.sections["Tracing"] = [("rays", "cannot be traced; everything else works")]
    return diagnosis


def run(console: Console) -> Diagnosis:
    """Print the diagnosis, and what to do, on `console`."""
    with console.status("looking at this machine"):
        diagnosis = diagnose()

    def say(text: str, style: str | None = None) -> None:  # paths as they are: neither wrapped nor markup
        console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    for heading, rows in diagnosis.sections.items():
        say(heading, "bold")
        width = max(len(what) for what, _ in rows)
        for what, finding in rows:
            say(f"  {what:<{width}}  {finding}")
    say("What to do", "bold")
    for lines, style in ((diagnosis.problems, "red"), (diagnosis.cautions, "yellow")):
        for line in lines:
            say(f"  - {line}".replace("\n", "\n    "), style)
    if diagnosis.healthy:
        say("  Everything works.", "green")
    return diagnosis
