"""What tracing costs as links, buildings and devices grow: `growth`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.io.cells import write_csv
from radiotwin.io.files import scratch_folder
from radiotwin.scene import Scene
from studies.load import make_town, run_measured
from studies.runner import Study
from studies.tables import markdown

HEIGHTS_M = 30.0, 80.0  # of the receivers
QUALITY = "fast"
BATCH = 100  # links that are solved together
SIZES = {  # name -> buildings, devices, receivers of each device; cheap ones first
    "links 1000": (1_000, 10, 100),
    "buildings 30": (30, 10, 300),
    "buildings 300": (300, 10, 300),
    "buildings 1000": (1_000, 10, 300),
    "buildings 5000": (5_000, 10, 300),
    "links 10000": (1_000, 10, 1_000),
    "devices 100": (1_000, 100, 100),
    "links 100000": (1_000, 10, 10_000),
    "devices 1000": (1_000, 1_000, 100)}


def growth_cases(seed: int) -> dict[str, dict]:
    """Return sizes of the town of study `load`."""
    return {name: {"buildings": buildings, "devices": devices, "receivers": receivers,
                   "quality": QUALITY}
            for name, (buildings, devices, receivers) in SIZES.items()}


def measure_growth(seed: int, settings: dict) -> dict[str, Any]:
    """Run `radiotwin gains` in one process with one thread, for one batch and for all links.

    Returns:
        Links; processor time [s] and peak memory [MiB] of the command for one batch, which loads
        the libraries and the town, and for all of them; wall time [s].
    """
    with scratch_folder() as folder:
        build = make_town(settings["buildings"], folder)["build-scene"]
        run_measured([*(str(settings["devices"]) if part == "20" else part for part in build)],
                     folder)
        scene = Scene.load(folder / "scene")
        first, rng = scene.config.devices[0].device, np.random.default_rng(seed)
        # The first command compiles kernels, which are kept for the others.
        _gains(folder, scene, BATCH, rng, settings["quality"], ["--devices", first])
        start = _gains(folder, scene, BATCH, rng, settings["quality"], ["--devices", first])
        cost = _gains(folder, scene, settings["receivers"], rng, settings["quality"], [])
    return {"links": settings["devices"] * settings["receivers"],
            "start_s": start["cpu_s"], "start_mib": start["peak_mib"],
            "cpu_s": cost["cpu_s"], "wall_s": cost["wall_s"], "peak_mib": cost["peak_mib"]}


def _gains(folder: Path, scene: Scene, count: int, rng: np.random.Generator, quality: str,
           options: list[str]) -> dict[str, float]:
    """Trace to new points, as gains are kept, and return what it cost."""
    low_m, high_m = np.array(scene.config.extent.bounds).reshape(2, 2).T
    points_m = np.column_stack([rng.uniform(low_m, high_m, (count, 2)),
                                rng.uniform(*HEIGHTS_M, count)])
    write_csv(pd.DataFrame(points_m, columns=["x_m", "y_m", "z_m"]), folder / "points.csv")
    return run_measured(["radiotwin", "gains", "scene", "--points", "points.csv", "--quality",
                         quality, "--workers", "1", "--device", "cpu", *options], folder)


def growth_table(rows: pd.DataFrame) -> str:
    """Return time and memory, and time a link beyond the start."""
    return markdown(
        ["", "buildings", "devices", "links", "start [s]", "all [s]", "a link [ms]",
         "peak memory of the start [MiB]", "of all [MiB]"],
        [[name, f"{settings['buildings']:,}", f"{settings['devices']:,}", f"{row['links']:,}",
          f"{row['start_s']:.1f}", f"{row['cpu_s']:.1f}", f"{_link_ms(row):.1f}",
          f"{row['start_mib']:,.0f}", f"{row['peak_mib']:,.0f}"]
         for name, settings, row in _in_order(rows)])


def _link_ms(row: pd.Series) -> float:
    """Return the time of a link [ms] without that of the start, which solves one batch."""
    return 1000 * (row["cpu_s"] - row["start_s"]) / (row["links"] - BATCH)


def _in_order(rows: pd.DataFrame) -> Iterator[tuple[str, dict, pd.Series]]:
    by_name = rows.set_index("name")
    for name in SIZES:
        if name in by_name.index:
            yield name, by_name.loc[name, "settings"], by_name.loc[name]


STUDIES = {"growth": Study("What does tracing cost as links, buildings and devices grow?",
                           measure_growth, growth_cases, growth_table, seeds=1)}
