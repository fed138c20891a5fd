"""Functions of jobs that other processes import, and places to run them."""

import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
import warnings
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.runtime.execution import open_executor

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'radiotwin[ray]'")
PLACES = ["serial", "local", pytest.param("ray", marks=needs_ray)]


def square(number):
    return number * number


def environment(number):
    return os.getpid(), os.environ.get("OMP_NUM_THREADS"), os.getcwd()


def nap(seconds):
    time.sleep(seconds)
    return os.getpid()


def refuse(number):
    if number == 3:
        raise BadInput("three is not allowed")
    return number


def warn(number):
    warnings.warn("careful with this city", stacklevel=1)
    return number


class Sums:
    """Remembers its state within a process, and dies once, or always, at one of its pieces."""

    def __init__(self, folder, deadly=None, always=False):
        self.folder, self.deadly, self.always = Path(folder), deadly, always

    def __call__(self, piece):
        with open(self.folder / "calls", "a") as file:
            file.write(f"{piece[0]}\n")
        flag = self.folder / "died"
        if self.deadly in piece and (self.always or not flag.exists()) and len(piece) > 1:
            flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.cumsum(np.sqrt(np.array(piece, dtype=float)))


def halves(piece):
    middle = len(piece) // 2
    return (piece[:middle], piece[middle:]) if middle else None


def grow(megabytes):
    """Take memory step by step."""
    held = []
    for _ in range(megabytes // 10):
        held.append(np.ones(10 * 2**20 // 8))
        time.sleep(0.02)
    return len(held)


def processes_with(text):
    """Return numbers of processes whose command or environment holds a text."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            try:
                data = (folder / "cmdline").read_bytes() + (folder / "environ").read_bytes()
                state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if text.encode() in data and state != "Z":
                found.append(int(folder.name))
    return found


def wait_until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not within {seconds} s"
        time.sleep(0.05)


def start(program, *arguments, **environment):
    return subprocess.Popen([sys.executable, "-c", program, *map(str, arguments)], start_new_session=True,
                            env=os.environ | environment, cwd=Path(__file__).parents[3])


def linger(folder):
    """Note that this process works, and work for a minute in compiled code and out of it."""
    (Path(folder) / f"worker-{os.getpid()}").touch()
    for _ in range(600):
        np.linalg.svd(np.ones((60, 60)))
        time.sleep(0.1)


def is_worker(pid, place):
    """Whether a process runs pieces, and is no helper of loky or Ray."""
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
    return (b"LokyProcess" in command) if place == "local" else command.startswith(b"ray::PieceRunner")


@contextmanager
def two_workers(place, one_is_killed=True):
    """Yield an executor, one of whose workers is killed after a second of work, and a list of its number."""
    mark, killed, done = f"mark-{uuid.uuid4().hex}", [], threading.Event()

    def kill():
        while not done.wait(0.2):
            for pid in processes_with(mark):
                if is_worker(pid, place) and not done.wait(1.0):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)
                    return

    os.environ["MARK_OF_TEST"] = mark
    killer = threading.Thread(target=kill)
    try:
        with open_executor("2", "auto" if place == "ray" else None) as executor:
            if one_is_killed:
                killer.start()
            yield executor, killed
    finally:
        done.set()
        del os.environ["MARK_OF_TEST"]
        if one_is_killed:
            killer.join()
    wait_until(lambda: not [pid for pid in processes_with(mark) if not is_tracker(pid)], 20)


def is_tracker(pid):
    """Whether a process is loky's tracker of resources, which stays as long as this process."""
    try:
        return b"resource_tracker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return True
