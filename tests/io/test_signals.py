"""Signals to whole commands: one line, an exit status, nothing left over, no child that is disturbed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SIGNALLED = """
import os, signal, tempfile, threading, time
make = tempfile.mkdtemp
def signalled(*arguments, **options):
    path = make(*arguments, **options)
    if os.path.basename(path).startswith(".radiotwin-"):
        first, *others = {numbers}
        for number in others:
            threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
        os.kill(os.getpid(), first)
    return path
tempfile.mkdtemp = signalled
from radiotwin.cli import main
main()
"""
CHILD = """
import multiprocessing, os, signal, sys, time
from radiotwin.io.signals import kept_from_children
if __name__ == "__main__":
    child = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(0.1,))
    with kept_from_children():
        child.start()
    os.kill(child.pid, signal.SIGINT)
    child.join()
    sys.exit(child.exitcode)
"""


def run(program, folder, *arguments):
    return subprocess.run([sys.executable, "-c", program, *arguments], cwd=folder, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=60)


@pytest.mark.seconds
@pytest.mark.parametrize("numbers, status, word", [("[signal.SIGINT]", 130, "interrupted"),
                                                   ("[signal.SIGTERM] * 2", 143, "terminated"),
                                                   ("[signal.SIGINT, signal.SIGTERM]", 130, "interrupted")])
def test_a_command_that_writes_leaves_nothing(numbers, status, word, tmp_path):
    done = run(SIGNALLED.format(numbers=numbers), tmp_path, "build-scene", "preset:small", "-o", "new/scene")
    assert done.returncode == status, done.stderr
    assert done.stderr.startswith(f"radiotwin: {word}; ") and len(done.stderr.splitlines()) == 1
    assert not done.stdout and not list(tmp_path.iterdir())


def test_a_child_never_gets_a_ctrl_c(tmp_path):
    """The first one got it: Python's resource tracker, started with it, let the signal through again."""
    done = run(CHILD, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


WHILE_LOADED = """
import enum, os, signal, sys
set_item, sent = enum._EnumDict.__setitem__, []
def signalled(self, *item):
    if "drjit" in sys.modules and not sent:
        sent.append(True)
        os.kill(os.getpid(), signal.SIGINT)
    return set_item(self, *item)
enum._EnumDict.__setitem__ = signalled
from radiotwin.io import signals
from radiotwin.runtime.command import exit_status
from radiotwin.trace.solver import import_sionna
signals.leave(exit_status(import_sionna, "all is kept"))
"""


@pytest.mark.llvm
def test_a_signal_while_the_tracer_is_loaded(tmp_path):
    """Compiled code that makes an enumeration aborted the process."""
    done = run(WHILE_LOADED, tmp_path)
    assert (done.returncode, done.stderr) == (130, "radiotwin: interrupted; all is kept\n")
