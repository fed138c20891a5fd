"""Runs the installed command as a user would."""

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = Path(sys.executable).with_name("radiotwin")


@pytest.fixture(scope="session")
def run():
    def run(words: str, cwd: Path) -> subprocess.CompletedProcess:
        return subprocess.run([str(COMMAND), *shlex.split(words)], cwd=cwd, capture_output=True, text=True,
                              timeout=300, env=os.environ | {"COLUMNS": "100"})
    return run


@pytest.fixture
def run_here(monkeypatch, capsys):
    """The same within this process, which saves seconds: for many cases of bad input."""
    def run_here(words: str, cwd: Path) -> subprocess.CompletedProcess:
        from radiotwin.cli import main

        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", ["radiotwin", *shlex.split(words)])
        before = signal.getsignal(signal.SIGINT)
        try:
            main()
            status = 0
        except SystemExit as end:
            status = end.code
        finally:
            signal.signal(signal.SIGINT, before)
        said = capsys.readouterr()
        return subprocess.CompletedProcess(words, status, said.out, said.err)
    return run_here
