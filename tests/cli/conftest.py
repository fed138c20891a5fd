"""Runs the installed command as a user would."""

import os
import shlex
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
