"""Runs the command line: in this process, where importing the package once serves all, or as it is installed."""

import contextlib
import io
import os
import shlex
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from radiotwin import console, signals
from radiotwin.cli import main
from tests.cli.strangers import FIT, MAP, SECRET, SURVEY

COMMAND = Path(sys.executable).with_name("radiotwin")
COLUMNS = 100


@contextlib.contextmanager
def as_in_a_process_of_its_own(arguments: list[str], cwd: Path) -> Iterator[None]:
    """Restore the state of the process that a command changes."""
    argv, folder, show = sys.argv, Path.cwd(), warnings.showwarning
    handlers = {number: signal.getsignal(number) for number in (*signals.NUMBERS, signal.SIGALRM)}
    width = console.console.width
    try:
        sys.argv, console.console.width = ["radiotwin", *arguments], COLUMNS
        os.chdir(cwd)
        with warnings.catch_warnings():  # whatever was shown once would not be shown again
            warnings.simplefilter("default")
            yield
    finally:
        os.chdir(folder)
        sys.argv, console.console.width, warnings.showwarning = argv, width, show
        for number, handler in handlers.items():
            signal.signal(number, handler)


@pytest.fixture(scope="session")
def run():
    """Run the command with a line of arguments in a folder."""
    def run(arguments: str, cwd: Path) -> subprocess.CompletedProcess:
        out, error, status = io.StringIO(), io.StringIO(), 0
        with as_in_a_process_of_its_own(shlex.split(arguments), cwd), contextlib.redirect_stdout(out), \
                contextlib.redirect_stderr(error):
            try:
                main()
            except SystemExit as end:
                status = end.code or 0
        return subprocess.CompletedProcess(arguments, status, out.getvalue(), error.getvalue())
    return run


@pytest.fixture(scope="session")
def run_installed():
    """The same with the command as it is installed: seconds more for each."""
    def run_installed(arguments: str, cwd: Path) -> subprocess.CompletedProcess:
        return subprocess.run([str(COMMAND), *shlex.split(arguments)], cwd=cwd, capture_output=True, text=True,
                              timeout=300, env=os.environ | {"COLUMNS": str(COLUMNS)})
    return run_installed


@pytest.fixture(scope="session")
def scene_to_map(run, tmp_path_factory):
    """A folder with a scene, a survey of it (m.csv), a twin, and a map."""
    folder = tmp_path_factory.mktemp("scene-to-map")
    for command in ("build-scene preset:small -o scene", SURVEY.replace("out", "m"), FIT.replace("out", "twin"),
                    MAP.replace("out", "map")):
        assert run(command, folder).returncode == 0
    return folder


@pytest.fixture
def strangers_folder(scene_to_map, tmp_path):
    """A copy of them, beside a secret."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret").write_text(SECRET)
    return shutil.copytree(scene_to_map, tmp_path / "work", ignore=shutil.ignore_patterns("cache"))
