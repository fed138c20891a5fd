"""Cities by tiles: costs in 2,000 and in 50,000 buildings, and what a radius leaves out: `regions`.

The cities are those of `studies.region_city`, built once by `radiotwin build-scene` and kept in
`build/regions`. Receivers lie within 1 km of each device: drawn all over it for the costs, in
patches of neighbouring lattice positions for the error, as those of a map.
"""

import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin import Scene, SolverSettings
from radiotwin.io.files import atomic_path
from radiotwin.runtime.execution.job import peak_bytes
from radiotwin.scene.folder import read_city
from radiotwin.trace import trace_gains
from radiotwin.trace.link_job import LinkBatch, SolveTiles, link_pieces
from radiotwin.trace.tiles import (
    RADIUS_M,
    PackedCity,
    batches_by_place,
    longest_path_m,
    tile_of,
)
from studies.load import run_measured
from studies.region_city import city_footprints, write_map
from studies.runner import Study
from studies.tables import markdown

KEPT = Path("build/regions")
REACH_M = 1_000.0
RADII_M = (50.0, 100.0, 200.0, 400.0, 800.0)
COSTS = ("wall_s", "cpu_s", "peak_mib")


def region_cases(seed: int) -> dict[str, dict]:
    """Return the costs by city, and the error in the smaller one."""
    cost = {"part": "cost", "quality": "fast", "devices": 10, "radius_m": RADIUS_M}
    return {"2,000 buildings": cost | {"buildings": 2_000, "links": 10_000},
            "50,000 buildings": cost | {"buildings": 50_000, "links": 10_000},
            "error": {"part": "error", "buildings": 2_000, "quality": "default", "devices": 4,
                      "patches": 2, "receivers": 20, "radii_m": list(RADII_M)}}


def measure_region(seed: int, settings: dict) -> dict:
    """Run a row: in a process of its own, so that its memory is its own."""
    build = _built(settings["buildings"], seed)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        measure = {"cost": measure_cost, "error": measure_error}[settings["part"]]
        return {"build": build} | pool.submit(measure, seed, settings).result()


def _folder(buildings: int, seed: int) -> Path:
    return KEPT / f"{buildings}-{seed}"


def _built(buildings: int, seed: int) -> dict[str, float]:
    """Build a city unless it is kept; return what that took, see `run_measured`."""
    folder = _folder(buildings, seed)
    if not (folder / "build.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_map(city_footprints(buildings, seed), folder / "city.geojson")
        taken = run_measured(["radiotwin", "build-scene", "city.geojson", "-o", "scene",
                              "--devices", "10", "--step", "50", "--altitudes", "60", "--quiet"],
                             folder)
        with atomic_path(folder / "build.json") as temporary:
            temporary.write_text(json.dumps(taken), encoding="utf-8")
    return json.loads((folder / "build.json").read_text(encoding="utf-8"))


def _points(scene: Scene, device: int, count: int, size: int, seed: int) -> np.ndarray:
    """Draw (n, 3) outdoor lattice positions near a device, in batches by place [m]."""
    lattice_m = scene.lattice.positions_m[~scene.blocked.ravel()]
    away_m = np.linalg.norm(lattice_m - scene.device_m[device], axis=1)
    near_m = lattice_m[away_m < REACH_M]
    rng = np.random.default_rng([seed, device])
    drawn_m = near_m[rng.choice(len(near_m), min(count, len(near_m)), replace=False)]
    return drawn_m[np.concatenate(batches_by_place(drawn_m, size))]


def _patches(scene: Scene, device: int, count: int, size: int, seed: int) -> list[np.ndarray]:
    """Draw patches (size, 3) of neighbouring outdoor lattice positions near a device [m]."""
    lattice_m = scene.lattice.positions_m[~scene.blocked.ravel()]
    near_m = lattice_m[np.linalg.norm(lattice_m - scene.device_m[device], axis=1) < REACH_M]
    rng = np.random.default_rng([seed, device])
    middles_m = near_m[rng.choice(len(near_m), count, replace=False)]
    return [near_m[np.argsort(np.linalg.norm(near_m - middle_m, axis=1), kind="stable")[:size]]
            for middle_m in middles_m]


def measure_cost(seed: int, settings: dict) -> dict:
    """Trace links by tiles in this process.

    Returns:
        Links; median processor time of a link once kernels are compiled, of that the loading of
        tiles [s]; buildings kept of a tile; peak memory [GiB]; seconds until the scene and the
        geometry are read.
    """
    solver = SolverSettings.of_quality(settings["quality"], radius_m=settings["radius_m"],
                                       seed=seed + 1)
    begun_s = time.process_time()
    scene = Scene.load(_folder(settings["buildings"], seed) / "scene")
    solve = SolveTiles(scene, solver)
    read_s = time.process_time() - begun_s
    pieces: list[LinkBatch] = []
    for device in range(settings["devices"]):
        points_m = _points(scene, device, settings["links"] // settings["devices"],
                           solver.batch_receivers, seed)
        pieces += link_pieces(scene, solver, [(str(device), scene.device_m[device], None)],
                              points_m)[0]
    seconds, shapes, detected = [], [], 0
    for piece in pieces:
        begun_s = time.process_time()
        detected += int(np.isfinite(solve(piece)).sum())
        seconds.append((time.process_time() - begun_s) / len(piece))
        shapes.append(solve.shapes)
    return {"links": sum(map(len, pieces)), "detected": detected, "read_s": read_s,
            "link_ms": 1000 * float(np.mean(seconds[1:])), "first_s": seconds[0] * len(pieces[0]),
            "shapes": float(np.mean(shapes)), "peak_gib": peak_bytes() / 2**30}


def measure_error(seed: int, settings: dict) -> dict:
    """Compare culled gains with those of the whole city, over the same batches and rays.

    Returns:
        By radius, and of a second seed in the whole city (`noise`): links detected in both, 50th
        and 90th percentile of the differences [dB], and the share of links detected in one only.
    """
    scene = Scene.load(_folder(settings["buildings"], seed) / "scene")
    size = settings["receivers"]
    links = [(device, patch_m) for device in range(settings["devices"])
             for patch_m in _patches(scene, device, settings["patches"], size, seed)]
    first_seed = 2 * seed + 1

    def traced(**others: float | int) -> np.ndarray:
        solver = SolverSettings.of_quality(settings["quality"], batch_receivers=size, **(
            {"seed": first_seed, "radius_m": np.inf} | others))
        gain_db = np.concatenate([
            trace_gains(scene, scene.device_m[device][None], patch_m, solver)[0]
            for device, patch_m in links])
        return np.where(gain_db >= scene.config.gain_limit_db, gain_db, np.nan)

    city = PackedCity.of(read_city(scene.xml_path))
    whole_db = traced()
    found = {"noise": _compared(whole_db, traced(seed=first_seed + 1))}
    for radius_m in settings["radii_m"]:
        kept = [city.near(tile_of(scene.device_m[device], patch_m, radius_m,
                                  longest_path_m(scene))).mean() for device, patch_m in links]
        found[f"{radius_m:g}"] = _compared(whole_db, traced(radius_m=radius_m)) | {
            "kept_share": float(np.mean(kept))}
    return {"links": len(whole_db), "errors": found}


def _compared(whole_db: np.ndarray, other_db: np.ndarray) -> dict[str, float]:
    both = np.isfinite(whole_db) & np.isfinite(other_db)
    difference_db = np.abs(whole_db - other_db)[both]
    return {"links": int(both.sum()), "median_db": float(np.median(difference_db)),
            "p90_db": float(np.quantile(difference_db, 0.9)),
            "mean_db": float(np.mean((other_db - whole_db)[both])),
            "within_share": float(np.mean(difference_db <= 0.1)),
            "one_only_share": float(np.mean(np.isfinite(whole_db) != np.isfinite(other_db)))}


def region_table(rows: pd.DataFrame) -> str:
    """Return the costs by city, and the error by radius."""
    costs = rows[rows["settings"].map(lambda settings: settings["part"]) == "cost"]
    least = costs[costs["name"] == "2,000 buildings"].set_index("seed")
    lines = [[row["name"], str(row["seed"]), *(f"{row['build'][key]:,.0f}" for key in COSTS),
              f"{row['read_s']:.1f}", f"{row['links']:,}", f"{row['shapes']:,.0f}",
              f"{row['link_ms']:.1f}",
              f"{row['link_ms'] / least['link_ms'].get(row['seed'], np.nan):.2f}",
              f"{row['peak_gib']:.2f}"] for _, row in costs.iterrows()]
    text = [markdown(["city", "seed", "build [s]", "build [CPU s]", "build [MiB]", "read [CPU s]",
                      "links", "shapes of a tile", "ms of CPU a link", "ratio",
                      "peak memory [GiB]"], lines, "Cost by tiles")]
    errors = rows[rows["settings"].map(lambda settings: settings["part"]) == "error"]
    for _, row in errors.iterrows():
        text.append(markdown(
            ["against the whole city", "shapes kept", "links", "median [dB]",
             "9 of 10 within [dB]", "mean [dB]", "within 0.1 dB", "detected in one only"],
            [[f"radius {name} m" if name != "noise" else "whole city, another seed",
              f"{100 * one.get('kept_share', 1.0):.0f} %", f"{one['links']:,}",
              f"{one['median_db']:.3f}", f"{one['p90_db']:.2f}",
              f"{one['mean_db']:+.3f}", f"{100 * one['within_share']:.0f} %",
              f"{100 * one['one_only_share']:.1f} %"] for name, one in row["errors"].items()],
            f"Error of a radius, seed {row['seed']}",
            f", {row['settings']['buildings']:,} buildings, `{row['settings']['quality']}`"))
    return "\n\n".join(text)


STUDIES = {"regions": Study("What does a city by tiles cost, and what does a radius leave out?",
                            measure_region, region_cases, region_table, seeds=1)}
