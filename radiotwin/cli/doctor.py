"""Check which parts of radiotwin work on this machine, and name the remedy for the others."""

import os
import platform
import re
import shutil
import sys
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from radiotwin.errors import MissingPackage
from radiotwin.runtime import cuda, llvm
from radiotwin.runtime.cuda import FREE_SPACE_GAIN_DB, TrialFailed, trace_trial_link
from radiotwin.runtime.processes import free_memory_bytes, usable_cores

GIB = 2**30
MIN_MEMORY_GIB = 4  # twice what tracing scenes/rbm takes (docs/results/tracer.md)
MIN_DISK_GIB = 2
_REMEDY = "install the versions of sionna-rt, mitsuba and drjit that constraints.txt names"

Rows = list[tuple[str, str]]


@dataclass
class Diagnosis:
    """Findings about this machine.

    Attributes:
        sections: rows of (item, finding) by heading.
        problems: faults that stop something from working, each with its remedy.
        cautions: shortages that may stop something later.
    """

    sections: dict[str, Rows] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)

    @property
    def healthy(self) -> bool:
        """Whether everything works."""
        return not self.problems


def diagnose() -> Diagnosis:
    """Check machine, GPU, packages and tracing; checks that may crash run in a child process."""
    diagnosis = Diagnosis()
    diagnosis.sections["System"] = [
        ("Python", f"{platform.python_version()} ({sys.executable})"),
        ("platform", platform.platform()),
    ]
    diagnosis.sections["Machine"] = _check_machine(diagnosis)
    diagnosis.sections["GPU"] = _check_gpu()
    diagnosis.sections["Packages"] = _check_packages(diagnosis)
    if find_spec("sionna") is None:
        diagnosis.sections["Tracing"] = [
            ("Sionna RT", "not installed: pip install 'radiotwin[trace]'; everything else works")]
        return diagnosis
    diagnosis.sections["libLLVM"] = _check_llvm(diagnosis)
    diagnosis.sections["Tracing"] = (
        _check_tracing(diagnosis) if llvm.available()
        else [("rays", "cannot be traced; everything else works")])
    return diagnosis


def print_diagnosis(diagnosis: Diagnosis, console: Console) -> None:
    """Print findings and remedies."""
    def say(text: str, style: str | None = None) -> None:  # no wrapped paths, no markup
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
    """List cores, memory and free disk; add cautions if there is little."""
    cores = usable_cores()
    memory_bytes, disk_gib = free_memory_bytes(), shutil.disk_usage(Path.cwd()).free / GIB
    if memory_bytes is not None and memory_bytes < MIN_MEMORY_GIB * GIB:
        diagnosis.cautions.append(f"{memory_bytes / GIB:.1f} GiB of memory free: tracing a city "
                                  f"takes up to {MIN_MEMORY_GIB} GiB")
    if disk_gib < MIN_DISK_GIB:
        diagnosis.cautions.append(f"{disk_gib:.1f} GiB of disk free here: have {MIN_DISK_GIB} GiB "
                                  "before you trace cities")
    return [
        ("cores", str(cores)),
        ("free memory",
         "unknown" if memory_bytes is None else f"{memory_bytes / GIB:.1f} GiB"),
        ("free disk here", f"{disk_gib:.1f} GiB"),
    ]


def _check_gpu() -> Rows:
    """List graphics processors, and what `--device auto` uses."""
    rows = [("GPU", str(gpu)) for gpu in cuda.gpus()] or [("GPU", "none is listed by nvidia-smi")]
    for work, refusal in (("tracing", cuda.tracing_refusal), ("training", cuda.torch_refusal)):
        try:
            reason = refusal()
        except MissingPackage as error:
            reason = str(error)
        except (ImportError, OSError) as error:
            reason = f"torch cannot be imported: {error}"
        rows.append((work, f"on the processor: {reason}" if reason else "on the GPU"))
    return rows


def _check_packages(diagnosis: Diagnosis) -> Rows:
    """List packages with installed versions; add a problem for each missing one that is needed."""
    try:
        rows = [("radiotwin", version("radiotwin"))]
        requirements = requires("radiotwin") or []
    except PackageNotFoundError:
        diagnosis.problems.append("radiotwin runs from a folder and is not installed: pip install "
                                  "-e .")
        return [("radiotwin", "not installed")]
    listed = {"radiotwin"}  # extras name each other, and a package may be of several
    for requirement in requirements:
        name = re.findall(r"^[\w.-]+", requirement)[0]
        if name in listed:
            continue
        listed.add(name)
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            if extra and extra[1] in ("docs", "test"):  # which no command needs
                continue
            rows.append((name, f"not installed (extra '{extra[1]}')" if extra else "MISSING"))
            if not extra and ";" not in requirement:
                diagnosis.problems.append(f"the package {name} is missing: pip install "
                                          f"'{requirement}'")
    return rows


def _check_llvm(diagnosis: Diagnosis) -> Rows:
    """List every libLLVM found, with the chosen one; add a problem if none works."""
    chosen = llvm.choose()
    rows = [(str(candidate), "works, chosen" if candidate == chosen
             else llvm.rejection(candidate) or "works") for candidate in llvm.find()]
    if os.environ.get(llvm.VARIABLE):
        rows.append((llvm.VARIABLE, os.environ[llvm.VARIABLE]))
    if chosen is None:
        diagnosis.problems.append(llvm.advice())
    return rows or [("libLLVM", "none found")]


def _check_tracing(diagnosis: Diagnosis) -> Rows:
    """Trace one free-space link, to compare with Friis' equation; add a problem if it fails."""
    item = "one link of 100 m at 2.4 GHz"
    try:
        gain_db = trace_trial_link("cpu")
    except TrialFailed as reason:
        diagnosis.problems.append(f"tracing fails ({reason}): {_REMEDY}")
        return [(item, f"fails: {reason}")]
    return [(item, f"{gain_db:.2f} dB (free space: {FREE_SPACE_GAIN_DB:.2f} dB)")]
