"""What large inputs cost: seconds and peak memory of whole commands, by size: `load`."""

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
from radiotwin.scene import Scene
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


def make_close_loop(links: int, folder: Path) -> dict[str, list[str]]:
    """Write flights over a small city with one receiver that reads 5 dB too much; see `Make`.

    Five flights of two UAVs; half of the devices are anchors. Levels follow a law of distance and
    line of sight, with shadowing that changes over 40 m along the way.
    """
    run_measured(["radiotwin.cli", "build-scene", "preset:small", "-o", "scene"], folder)
    scene, rng = Scene.load(folder / "scene"), np.random.default_rng(0)
    device_m, flights, uavs = scene.device_m, 5, 2
    slots = -(-links // (len(device_m) * flights * uavs))
    low, high = np.array(scene.config.extent.bounds).reshape(2, 2).T
    names = np.array([device.device for device in scene.config.devices])
    for flight, uav in np.ndindex(flights, uavs):
        speed_m, away_m = 4000.0 / slots, np.cumsum(rng.normal(0, 0.3 / np.sqrt(slots), slots))
        angle = rng.uniform(0, 2 * np.pi) + 12 * away_m
        way_m = np.cumsum(speed_m * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
        place_m = low + np.abs((way_m + rng.uniform(low, high)) % (2 * (high - low)) - (high - low))
        receiver_m = np.column_stack([place_m, np.full(slots, 50.0 + 10 * uav)])
        keep = np.exp(-speed_m / 40.0)
        step_db = rng.normal(0, 3 * np.sqrt(1 - keep**2), (slots, len(device_m)))
        shadowing_db = step_db.copy()
        for slot in range(1, slots):
            shadowing_db[slot] += keep * shadowing_db[slot - 1]
        ends_m = np.repeat(receiver_m, len(device_m), axis=0)
        from_m = np.tile(device_m, (slots, 1))
        los = scene.city.line_of_sight(from_m, ends_m)
        distance_m = np.linalg.norm(ends_m - from_m, axis=1)
        gain_db = np.where(los, -32 - 22 * np.log10(distance_m), -35 - 30 * np.log10(distance_m))
        gain_db += shadowing_db.ravel() + rng.normal(0, 1.0, len(los)) + 5.0 * uav
        gain_db[gain_db < scene.config.gain_limit_db] = np.nan
        pd.DataFrame({
            "time_s": (600.0 * (flight + np.arange(slots) / slots)).repeat(len(device_m)).round(3),
            "flight": f"f{flight}", "receiver": f"r{uav}", "receiver_x_m": ends_m[:, 0].round(2),
            "receiver_y_m": ends_m[:, 1].round(2), "receiver_z_m": ends_m[:, 2],
            "device": np.tile(names, slots), "gain_db": gain_db.round(2),
        }).to_csv(folder / "measurements.csv", mode="a", header=not flight + uav, index=False)
    known = np.arange(len(device_m)) % 2 == 0
    pd.DataFrame({"device": names, "x_m": np.where(known, device_m[:, 0], np.nan),
                  "y_m": np.where(known, device_m[:, 1], np.nan), "z_m": device_m[:, 2],
                  "role": np.where(known, "anchor", "unknown")}).to_csv(
        folder / "devices.csv", index=False)
    loop = ["radiotwin.cli", "close-loop", "measurements.csv", "--scene", "scene"]
    return {"close-loop": [*loop, "--out", "loop"]}


PARTS: dict[str, tuple[Make, tuple[int, ...]]] = {
    "close-loop": (make_close_loop, (10_000, 100_000, 1_000_000)),
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
