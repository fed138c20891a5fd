"""What large inputs cost: seconds and peak memory of whole commands, by size: `load`."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from radiotwin.errors import RunFailed
from radiotwin.files import scratch_folder
from studies.runner import Study
from studies.tables import markdown

Make = Callable[[int, Path], dict[str, list[str]]]
"""Writes the inputs of a size to a folder; returns commands by name, in their order."""


def measure_load(seed: int, settings: dict) -> dict:
    """Run the commands of a `part` at a `size`; return seconds and peak memory of each."""
    with scratch_folder() as folder:
        commands = PARTS[settings["part"]][0](settings["size"], folder)
        return {"commands": {name: run_measured(command, folder)
                             for name, command in commands.items()}}


def run_measured(command: list[str], folder: Path) -> dict[str, float]:
    """Run a command line of this Python in a folder.

    Args:
        command: arguments after `python -m`.
        folder: working directory.

    Returns:
        `wall_s`, `cpu_s`, and `peak_mib` of the process and of those that it waited for.

    Raises:
        RunFailed: its exit status is not 0.
    """
    started = time.perf_counter()
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    child = subprocess.Popen([sys.executable, "-m", *command], cwd=folder, env=environment)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RunFailed(f"{' '.join(command)}: exit status {child.returncode}")
    return {"wall_s": time.perf_counter() - started, "cpu_s": usage.ru_utime + usage.ru_stime,
            "peak_mib": usage.ru_maxrss / 2**10}


PARTS: dict[str, tuple[Make, tuple[int, ...]]] = {
}
"""Name of a part -> inputs and commands, and sizes from the smallest."""


def load_cases(seed: int) -> dict[str, dict]:
    """Return every part at every size."""
    return {f"{part} {size}": {"part": part, "size": size}
            for part, (_, sizes) in PARTS.items() for size in sizes}


def load_table(rows: pd.DataFrame) -> str:
    """Return time and memory of each command, and their ratios to those of the smallest size."""
    lines, first = [], {}
    for row in rows.sort_values(["part", "size"]).to_dict("records"):
        for name, cost in row["commands"].items():
            least = first.setdefault((row["part"], name), cost)
            lines.append([row["part"], f"{row['size']:,}", name, f"{cost['wall_s']:.1f}",
                          f"{cost['wall_s'] / least['wall_s']:.1f}", f"{cost['peak_mib']:,.0f}",
                          f"{cost['peak_mib'] / least['peak_mib']:.2f}"])
    return markdown(["part", "size", "command", "wall [s]", "ratio", "peak memory [MiB]", "ratio"],
                    lines)


STUDIES = {"load": Study("What do large inputs cost?", measure_load, load_cases, load_table,
                         seeds=1)}
