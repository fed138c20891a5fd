"""A command that is given what a stranger sent: one message, and nothing read, run, written or fetched.

Each command runs in a forked child with 20 seconds and 2 GiB, and only the command's own words and files are judged, so
that the tests run on older code, too. At commit 0f68f2a all fail but seven: the variable, three meshes, effects without
freedom and with null inside, and the long output.
"""

import contextlib
import json
import os
import re
import resource
import runpy
import shlex
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path

import pytest

from tests.fuzz.sandbox import resident_bytes

MAX_S, MAX_BYTES = 20, 2 * 2**30
HERE = Path(__file__).parents[1]
STORED, CLOSELOOP = HERE / "twin" / "stored", HERE / "closeloop" / "sample" / "closeloop.json"
SQUARE = [[8.001, 50.001], [8.002, 50.001], [8.002, 50.002], [8.001, 50.002], [8.001, 50.001]]
SECRET = "only for its owner: 4711"
SURVEY = "survey scene --truth segmented --flights 1 -o out.csv"
FIT = "fit m.csv --scene scene --model log_distance -o out"
MAP = "map twin --scene scene -o out.nc"
MAP_IN = "survey scene --truth map.nc --flights 1 -o out.csv"


class Strangers:
    """The cases of a file, for `@pytest.mark.parametrize(*strangers.cases)`."""

    def __init__(self):
        self._cases = []

    def __call__(self, command, message, status=2, **limits):
        """Register a function that prepares a folder, and maybe returns a check of what the command did there.

        Lower limits, which older code does not know, save the time of coming near the real ones.
        """
        def register(prepare):
            self._cases.append(pytest.param(prepare, command, message, status, limits, id=prepare.__name__))
            return prepare
        return register

    @property
    def cases(self):
        return ("prepare", "command", "message", "status", "limits"), self._cases


def check_stranger(run, folder, monkeypatch, prepare, command, message, status, limits):
    for name, limit in limits.items():
        monkeypatch.setenv(f"RADIOTWIN_MAX_{name}", str(limit))
    check = prepare(folder)
    judge(run, command, folder, message, status)
    if check:
        check()


def forked(run, command, folder, until=None):
    """Run a command in a child; return its exit status, and what it said.

    The status is negative where the child was killed: by its own error, because it took too long or too much, or because
    the file `until` was there.
    """
    said = folder.parent / "said.txt"
    child = os.fork()
    if child == 0:
        try:
            with open(said, "w", encoding="utf-8") as file:
                os.environ["TMPDIR"] = str(folder.parent)
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                try:
                    result = run(command, folder) if not command.startswith("marl.") else planning(command, folder, file)
                    file.write(result.stdout + result.stderr)
                    status = result.returncode
                except BaseException:
                    traceback.print_exc(file=file)
                    status = 70
            os._exit(status)
        finally:
            os._exit(71)
    # What this process holds already is the child's, too, and is no fault of the command's.
    held, started = resident_bytes(os.getpid()), time.monotonic()
    while not (done := os.wait4(child, os.WNOHANG))[0]:
        with contextlib.suppress(OSError, ValueError, IndexError):
            if resident_bytes(child) - held > MAX_BYTES or time.monotonic() - started > MAX_S or (until and until.exists()):
                os.kill(child, signal.SIGKILL)
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(done[1]), said.read_text(encoding="utf-8")


def planning(command, folder, file):
    module, *sys.argv[1:] = shlex.split(command)
    os.chdir(folder)
    with contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        try:
            runpy.run_module(module, run_name="__main__")
            status = 0
        except SystemExit as end:
            status = end.code or 0
    return subprocess.CompletedProcess(command, status, "", "")


def names(folder):
    return {str(path) for path in folder.parent.rglob("*") if path.name != "said.txt"}


def judge(run, command, folder, message, status):
    before = names(folder)
    found, said = forked(run, command, folder)
    if status:
        assert names(folder) == before, f"{found}: a command that fails writes nothing"
    assert "Traceback" not in said and found >= 0, f"{found}: {said[-2000:]}"
    assert SECRET not in said and "\x1b" not in said
    assert found == status, said[-2000:]
    assert re.search(message, " ".join(said.split())), said[-2000:]
    if status:
        assert len(said) < 4000


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def write_town(path, *rings):
    features = [{"type": "Feature", "properties": {"building": "yes"}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
                for ring in rings]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
