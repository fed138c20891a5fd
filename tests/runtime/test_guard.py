"""A command whose process a library ends still has its message and its status; signals reach the one that works."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="commands go on in a child on Linux only")
PROGRAM = """
import os, signal, sys, time
import radiotwin.cli as cli
sys.argv = ["radiotwin", "{command}", "town.gpkg", "-o", "out"]
go_on = cli.go_on_in_a_child
def go_on_and_fail():
    status = go_on()
    if status is None:
        print(os.getpid(), flush=True)
        {work}
    return status
cli.go_on_in_a_child = go_on_and_fail
cli.main()
"""


def program(work, command="build-scene"):
    return [sys.executable, "-c", PROGRAM.format(work=work, command=command)]


@pytest.mark.parametrize("command", ["build-scene", "import"])
@pytest.mark.parametrize(("name", "word"), [("SIGSEGV", "Segmentation fault"), ("SIGABRT", "Aborted"), ("SIGFPE", "Floating")])
def test_a_library_that_ends_the_process(name, word, command):
    done = subprocess.run(program(f"os.kill(os.getpid(), signal.{name})", command), capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert f"{command} town.gpkg: a library ended on this file ({word}" in done.stderr


@pytest.mark.parametrize(("work", "status"), [("sys.exit(0)", 0), ("sys.exit(2)", 2), ("os._exit(143)", 143),
                                              ("os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL)])
def test_other_ends_are_those_of_the_child(work, status):
    assert subprocess.run(program(work), capture_output=True, check=False).returncode == status


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -signal.SIGKILL)])
def test_signals_end_the_one_that_works(number, status):
    with subprocess.Popen(program("time.sleep(600)"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        assert child != process.pid
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == status
    assert number == signal.SIGKILL or "nothing had been done yet" in said
    deadline = time.monotonic() + 60
    while works(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not works(child)


def works(child):
    """Whether a process is there, and not only its status, which nobody may have asked for."""
    try:
        return Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
