"""Commands and programs that a page shows, and a way to run them as a reader would."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROGRAMS = {"radiotwin": "radiotwin", "python -m marl.fedqmix": "marl.fedqmix"}
"""How a command line begins -> the module that is run."""


def page(name):
    """Return the text of a page of the documentation."""
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def fences(text, language):
    """Return the content of a page's fences of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(text):
    """Return module and arguments of each command of ours in the fences of a page."""
    lines = [line.split("#")[0].strip() for line in "\n".join(fences(text, "sh")).splitlines()]
    return [[module, *line.removeprefix(start).split()]
            for line in lines for start, module in PROGRAMS.items() if line.startswith(start + " ")]


def run(command, folder):
    """Run one of `commands` in a folder; what it printed."""
    done = subprocess.run([sys.executable, "-m", *command], cwd=folder, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, (command, done.stderr)
    return done.stdout + done.stderr


def run_program(text, folder):
    """Run a program of a page in a folder; what it printed."""
    done = subprocess.run([sys.executable, "-c", text], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def table(text, heading):
    """Return the rows of the first table after a heading, as a list of cells without bold and code marks."""
    rows = re.findall(r"^\|(.+)\|$", text.split(heading)[1].split("\n#")[0], re.MULTILINE)
    return [[re.sub(r"[*`]", "", cell).strip() for cell in row.split("|")] for row in rows[2:]]
