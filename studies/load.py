"""What large inputs cost: seconds and peak memory of whole commands, by size: `load`."""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import RunFailed
from radiotwin.files import scratch_folder
from studies.runner import Study
from studies.tables import markdown

PLOT_M = 26.0  # [m], side of a plot of the town
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


def make_town(size: int, folder: Path) -> dict[str, list[str]]:
    """Write a map of a town: rectangles, L-shapes, courtyards, and rows of houses that touch."""
    rng, side = np.random.default_rng(0), math.ceil(math.sqrt(size))
    features = []
    for number in range(size):
        x_m, y_m = (PLOT_M * (place - side / 2) for place in divmod(number, side)[::-1])
        outline, courtyard = _house(*rng.uniform(8, 20, 2), rng.random())
        rings = [[_degrees(x_m + x, y_m + y) for x, y in [*ring, ring[0]]]
                 for ring in (outline, courtyard) if ring]
        tags = {"building": "yes"}
        if rng.random() < 0.5:
            tags["building:levels"] = str(rng.integers(1, 7))
        if rng.random() < 0.2:
            tags["building:material"] = str(rng.choice(["brick", "wood", "concrete"]))
        features.append({"type": "Feature", "properties": tags,
                         "geometry": {"type": "Polygon", "coordinates": rings}})
    (folder / "town.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
    return {"build-scene": ["radiotwin.cli", "build-scene", "town.geojson", "-o", "scene",
                            "--devices", "20", "--quiet"]}


def _house(width_m: float, depth_m: float, kind: float) -> tuple[list, list]:
    """Return outline and courtyard [m]; `kind` from 0 to 1 chooses the shape."""
    if kind < 0.15:  # as wide as its plot: it touches the next
        width_m = PLOT_M
    corners = [(0, 0), (width_m, 0), (width_m, depth_m), (0, depth_m)]
    if 0.5 < kind < 0.75:
        return [*corners[:2], (width_m, depth_m / 2), (width_m / 2, depth_m / 2),
                (width_m / 2, depth_m), corners[3]], []
    if kind > 0.93:
        return corners, [(0.3 * width_m, 0.3 * depth_m), (0.3 * width_m, 0.7 * depth_m),
                         (0.7 * width_m, 0.7 * depth_m), (0.7 * width_m, 0.3 * depth_m)]
    return corners, []


def _degrees(x_m: float, y_m: float) -> list[float]:
    """Return longitude and latitude, near 8.5° east and 47.4° north."""
    return [round(8.5 + x_m / 75_300, 7), round(47.4 + y_m / 111_190, 7)]


PARTS: dict[str, tuple[Make, tuple[int, ...]]] = {
    "build-scene": (make_town, (1_000, 10_000, 50_000)),
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
