"""The diagnosis: its sections, and a remedy for each problem."""

import io
import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from radiotwin.cli import doctor
from radiotwin.runtime import cuda, llvm

HEADINGS = ["System", "Machine", "GPU", "Packages", "libLLVM", "Tracing", "What to do"]


@pytest.fixture
def no_llvm(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/nonexistent/libLLVM.so")


@pytest.fixture
def untraced(monkeypatch):
    """Leave the tracing out, which takes seconds: a machine on which it works."""
    monkeypatch.setattr(doctor, "_check_tracing", lambda diagnosis: [("one link", "traced")])
    monkeypatch.setattr(llvm, "_eligible", lambda: [llvm.Candidate(Path("/lib/libLLVM.so.19.1"), (19, 1))])
    monkeypatch.setattr(llvm, "find", llvm._eligible)
    monkeypatch.setattr(llvm, "rejection", lambda candidate: None)


def printed():
    """Whether all is well, and the lines that `doctor.print_diagnosis` prints."""
    output = io.StringIO()
    diagnosis = doctor.diagnose()
    doctor.print_diagnosis(diagnosis, Console(file=output, width=40))
    return diagnosis.healthy, output.getvalue().splitlines()


def test_healthy_machine(untraced):
    healthy, lines = printed()
    assert healthy
    assert [line for line in lines if not line.startswith(" ")] == HEADINGS
    assert lines[-1].strip() == "Everything works."
    assert "  /lib/libLLVM.so.19.1 (version 19.1)  works, chosen" in lines  # whole on a narrow console
    assert any(line.startswith("  Python ") and sys.executable in line for line in lines)
    for package in ("sionna-rt", "torch", "numpy"):
        assert any(line.startswith(f"  {package} ") for line in lines)


def test_without_llvm(no_llvm):
    healthy, lines = printed()
    assert not healthy
    assert [line for line in lines if not line.startswith(" ")] == HEADINGS
    assert "Everything works" not in "".join(lines)
    advice = "\n".join(lines[lines.index("What to do"):])
    assert "/nonexistent/libLLVM.so" in advice
    assert f"unset {llvm.VARIABLE}" in advice


def test_missing_packages(untraced, monkeypatch):
    elsewhere = "elsewhere>=1; platform_machine == 'z80'"
    needed = ["numpy>=1", "no-such-package>=2.1", elsewhere, "more>=1; extra == 'plus'", "more>=1; extra == 'all'",
              "radiotwin[plus]; extra == 'all'"]
    monkeypatch.setattr(doctor, "requires", lambda name: needed)
    diagnosis = doctor.diagnose()
    rows = dict(diagnosis.sections["Packages"])
    assert len(rows) == len(diagnosis.sections["Packages"])  # each once
    assert rows["no-such-package"] == "MISSING"
    assert rows["more"] == "not installed (extra 'plus')"
    (problem,) = diagnosis.problems
    assert problem.endswith("no-such-package is missing: pip install 'no-such-package>=2.1'")


def test_little_memory_and_disk_is_said_but_stops_nothing(untraced, monkeypatch):
    monkeypatch.setattr(doctor, "free_memory_bytes", lambda: 3 * 2**29)
    monkeypatch.setattr(doctor, "MIN_DISK_GIB", 10**9)
    diagnosis = doctor.diagnose()
    assert diagnosis.healthy
    assert ["memory" in caution or "disk" in caution for caution in diagnosis.cautions] == [True, True]


@pytest.mark.parametrize(("program", "said"), [
    ("import os; os.abort()", "tracing fails (exit status -6)"),
    ("raise ImportError('no sionna here')", "tracing fails (ImportError: no sionna here)"),
    ("print(-70.0)", "tracing fails (the link has -70.00 dB, free space has -80.05 dB)"), ("print(-80.05)", "")])
def test_the_trial_link(monkeypatch, program, said):
    monkeypatch.setattr(cuda, "_PROGRAM", program)
    diagnosis = doctor.Diagnosis()
    doctor._check_tracing(diagnosis)
    assert len(diagnosis.problems) == bool(said)
    assert all(said in problem and "constraints.txt" in problem for problem in diagnosis.problems)


def test_gpu_is_listed_with_what_would_use_it(tmp_path, monkeypatch):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'Some GPU, 16384, 550.1'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(cuda, "tracing_refusal", lambda: None)
    monkeypatch.setattr(cuda, "torch_refusal", lambda: "torch is old")
    assert doctor._check_gpu() == [("GPU", "Some GPU, 16 GiB, driver 550.1"), ("tracing", "on the GPU"),
                                   ("training", "on the processor: torch is old")]
    tool.write_text("#!/bin/sh\nexit 9\n")  # the tool without its driver
    assert doctor._check_gpu()[0] == ("GPU", "none is listed by nvidia-smi")


@pytest.mark.llvm
def test_the_command_traces_a_link_here(run, tmp_path):
    done = run("doctor --json", tmp_path)
    found = json.loads(done.stdout)["doctor"]
    assert found["healthy"] == (done.returncode == 0) and "free space" in str(found["sections"]["Tracing"])
