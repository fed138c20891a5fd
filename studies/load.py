"""What large inputs cost: seconds and peak memory of whole commands, by size: `load`."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import RunFailed
from radiotwin.io.cells import write_csv
from radiotwin.io.files import scratch_folder
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.scene import Scene
from radiotwin.scene.config import LatticeConfig, write_config
from radiotwin.scene.presets import build_preset
from radiotwin.twin import fit_twin
from studies.runner import Study
from studies.tables import markdown

# A process begins with the peak memory of the one that started it, so a small one has to: this
# starts Python with its own arguments, and prints exit status, wall and CPU seconds, and MiB.
_LAUNCHER = """
import json, os, sys, time
started = time.perf_counter()
child = os.posix_spawn(sys.executable, [sys.executable, *sys.argv[1:]], os.environ,
                       file_actions=[(os.POSIX_SPAWN_DUP2, 2, 1)])
_, status, used = os.wait4(child, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), time.perf_counter() - started,
                  used.ru_utime + used.ru_stime, used.ru_maxrss / 2**10]))
"""
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
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    launched = subprocess.run([sys.executable, "-I", "-S", "-c", _LAUNCHER, "-m", *command],
                              cwd=folder, env=environment, stdout=subprocess.PIPE, check=True)
    status, wall_s, cpu_s, peak_mib = json.loads(launched.stdout)
    if status:
        raise RunFailed(f"{' '.join(command)}: exit status {status}")
    return {"wall_s": wall_s, "cpu_s": cpu_s, "peak_mib": peak_mib}


def make_import(links: int, folder: Path) -> dict[str, list[str]]:
    """Write a table of links in a small city, and how to read it; see `Make`."""
    run_measured(["radiotwin", "build-scene", "preset:small", "-o", "scene"], folder)
    scene, rng = Scene.load(folder / "scene"), np.random.default_rng(0)
    names = np.array([device.device for device in scene.config.devices])
    low_x, high_x, low_y, high_y = scene.config.extent.bounds
    part = folder / "part.csv"
    for start in range(0, links, 500_000):
        n = min(500_000, links - start)
        place = [rng.uniform(low_x, high_x, n), rng.uniform(low_y, high_y, n),
                 np.full(n, 50.0) + rng.uniform(0, 20, n)]
        device = rng.integers(len(names), size=n)
        distance_m = np.linalg.norm(np.column_stack(place) - scene.device_m[device], axis=1)
        level_dbm = -10 - 30 * np.log10(distance_m) + rng.normal(0, 5, n)
        time_s = 1.65e9 + 0.02 * np.arange(start, start + n)
        write_csv(pd.DataFrame({
            "time": time_s.round(2), "x": place[0].round(3), "y": place[1].round(3),
            "z": place[2].round(2), "cell": names[device],
            "flight": np.char.add("f", (time_s // 1200 % 97).astype(int).astype(str)),
            "rsrp": np.where(level_dbm < -100, -140.0, level_dbm.round(1)),
            "speed": rng.uniform(0, 15, n).round(1),
        }), part)
        header, _, rows = part.read_bytes().partition(b"\n")
        with open(folder / "links.csv", "ab") as file:
            file.write(rows if start else header + b"\n" + rows)
    write_csv(pd.DataFrame({"device": names, **dict(zip("xyz", scene.device_m.T))}),
              folder / "cells.csv")
    columns = "level=rsrp,device=cell,x=x,y=y,z=z,time=time,flight=flight"
    fit = ["radiotwin", "fit", "out/measurements.csv", "--scene", "scene", "-o"]
    return {"import": ["radiotwin", "import", "links.csv", "--columns", columns,
                       "--level-unit", "dBm", "--length-unit", "m", "--time-format", "epoch s",
                       "--not-detected=-140", "--devices", "cells.csv", "-o", "out"],
            "fit segmented_log_distance": [*fit, "law", "--model", "segmented_log_distance"],
            "fit segmented_nn": [*fit, "net"]}


def make_map_inputs(size: int, folder: Path) -> dict[str, list[str]]:
    """Write a scene of 1.0 x 1.2 km whose lattice has about `size` positions, and a twin of it."""
    build_preset("rdm", folder / "scene")
    coarse = Scene.load(folder / "scene")
    survey = fly_survey(coarse, segmented_truth(coarse), flights=4, pattern="random-waypoint",
                        seed=0)
    fit_twin(survey, coarse, seed=0).save(folder / "twin")
    width_m, depth_m = coarse.lattice.x_m[-1], coarse.lattice.y_m[-1]
    altitudes_m = coarse.config.lattice.altitudes_m
    step_m = math.sqrt(width_m * depth_m * len(altitudes_m) / size)
    fine = LatticeConfig(step_m=step_m * 1.005, altitudes_m=altitudes_m)
    write_config(coarse.config.model_copy(update={"lattice": fine, "uavs": []}),
                 folder / "scene" / "scene.toml")
    device = coarse.config.devices[0].device
    command = ["radiotwin", "map", "twin", "--scene", "scene", "--devices", device, "-o"]
    return {f"map to {suffix}": [*command, f"map{suffix}"] for suffix in (".nc", ".tif", ".csv")}


def make_town(size: int, folder: Path) -> dict[str, list[str]]:
    """Write a map of a town: rectangles, L-shapes, courtyards, and rows of houses that touch."""
    rng, side = np.random.default_rng(0), math.ceil(math.sqrt(size))
    features = []
    for number in range(size):
        x_m, y_m = (PLOT_M * (place - side / 2) for place in divmod(number, side)[::-1])
        outline, courtyard = _house(rng.uniform(8, 20), rng.uniform(8, 20), rng.random())
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
    return {"build-scene": ["radiotwin", "build-scene", "town.geojson", "-o", "scene",
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


def make_close_loop(links: int, folder: Path) -> dict[str, list[str]]:
    """Write flights over a small city with one receiver that reads 5 dB too much; see `Make`.

    Five flights of two UAVs; half of the devices are anchors. Levels follow a law of distance and
    line of sight, with shadowing that changes over 40 m along the way.
    """
    run_measured(["radiotwin", "build-scene", "preset:small", "-o", "scene"], folder)
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
        part = pd.DataFrame({
            "time_s": (600.0 * (flight + np.arange(slots) / slots)).repeat(len(device_m)).round(3),
            "flight": f"f{flight}", "receiver": f"r{uav}", "receiver_x_m": ends_m[:, 0].round(2),
            "receiver_y_m": ends_m[:, 1].round(2), "receiver_z_m": ends_m[:, 2],
            "device": np.tile(names, slots), "gain_db": gain_db.round(2),
        })
        with open(folder / "measurements.csv", "ab") as file:
            write_csv(part, file, header=not flight + uav)
    known = np.arange(len(device_m)) % 2 == 0
    write_csv(pd.DataFrame({
        "device": names, "x_m": np.where(known, device_m[:, 0], np.nan),
        "y_m": np.where(known, device_m[:, 1], np.nan), "z_m": device_m[:, 2],
        "role": np.where(known, "anchor", "unknown")}), folder / "devices.csv")
    loop = ["radiotwin", "close-loop", "measurements.csv", "--scene", "scene"]
    return {"close-loop": [*loop, "--out", "loop"]}


PARTS: dict[str, tuple[Make, tuple[int, ...]]] = {
    "import and fit": (make_import, (100_000, 1_000_000, 10_000_000)),
    "build-scene": (make_town, (1_000, 10_000, 50_000)),
    "map": (make_map_inputs, (100_000, 1_000_000, 10_000_000)),
    "close-loop": (make_close_loop, (10_000, 100_000, 1_000_000)),
}
"""Name of a part -> inputs and commands, and sizes from the smallest."""


def load_cases(seed: int) -> dict[str, dict]:
    """Return every part at every size."""
    return {f"{part} {size}": {"part": part, "size": size}
            for part, (_, sizes) in PARTS.items() for size in sizes}


def load_table(rows: pd.DataFrame) -> str:
    """Return time and memory of each command, and their ratios to those of the smallest size."""
    lines: list[list[str]] = []
    first: dict[tuple, dict[str, float]] = {}
    for part, size, commands in sorted(
            (settings["part"], settings["size"], commands)
            for settings, commands in zip(rows["settings"], rows["commands"])):
        for name, cost in commands.items():
            least = first.setdefault((part, name), cost)
            lines.append([part, f"{size:,}", name, f"{cost['wall_s']:.1f}",
                          f"{cost['wall_s'] / least['wall_s']:.1f}", f"{cost['peak_mib']:,.0f}",
                          f"{cost['peak_mib'] / least['peak_mib']:.2f}"])
    return markdown(["part", "size", "command", "wall [s]", "ratio", "peak memory [MiB]", "ratio"],
                    lines)


STUDIES = {"load": Study("What do large inputs cost?", measure_load, load_cases, load_table,
                         seeds=1)}
