"""Speed, memory and numerical error of tracing: `tracer` by settings, `accuracy` by scene.

A random sample of a scene's lattice is solved for all devices, in `tracer` in a process of its own,
and compared with a reference: with ten times the default's rays in `tracer`, with ten times its own
in `accuracy`.
"""

import multiprocessing
import os
import resource
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from radiotwin import Scene, SolverSettings
from radiotwin.io.files import scratch_folder
from radiotwin.scene.build import BuildOptions, build_scene
from radiotwin.trace import trace_gains
from radiotwin.trace.settings import FINER
from radiotwin.trace.solver import PathGains
from studies.runner import Study
from studies.tables import markdown, scene_folder

ROWS: dict[str, dict] = {
    "`fast` (30,000 samples)": {"quality": "fast"},
    "`default` (100,000 samples, depth 4)": {"quality": "default"},
    "`high` (500,000 samples)": {"quality": "high"},
    "depth 3": {"quality": "default", "max_depth": 3},
    "depth 5": {"quality": "default", "max_depth": 5},
    "no diffraction": {"quality": "default", "diffraction": "off"}}


def tracer_cases(seed: int) -> dict[str, dict]:
    """Return settings of the solver."""
    return {name: {"scene": "rbm", "receivers": 100} | settings for name, settings in ROWS.items()}


def time_tracer(seed: int, settings: dict) -> dict:
    """Trace a sample and compare it with the reference, over the links that receivers detect there.

    Returns:
        Links per second of two cores' processor time, peak memory, absolute differences [dB], and
        the share of the links that is missed.
    """
    fixed = ("scene", "receivers", "quality")
    solver = SolverSettings.of_quality(settings["quality"], **{
        name: value for name, value in settings.items() if name not in fixed})
    sample = settings["scene"], settings["receivers"], seed
    reference_db = _in_a_process(SolverSettings().finer(10), *sample)[0]
    gain_db, per_s, peak_gib = _in_a_process(solver, *sample)
    detected = reference_db >= Scene.load(scene_folder(settings["scene"])).config.gain_limit_db
    both = detected & np.isfinite(gain_db)
    error_db = np.abs(gain_db - reference_db)[both]
    return {"links": reference_db.size, "detected": int(detected.sum()), "links_per_s": per_s,
            "peak_gib": peak_gib, "median_db": np.median(error_db),
            "p90_db": np.quantile(error_db, 0.9), "rms_db": np.sqrt(np.mean(error_db**2)),
            "missed": 1 - both.sum() / detected.sum()}


@lru_cache  # of the reference
def _in_a_process(*arguments: Any) -> tuple:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(trace_sample, arguments)


def trace_sample(settings: SolverSettings, name: str, receivers: int, seed: int) -> tuple:
    """Return gains [dB], links per second of two cores, and peak memory [GiB]."""
    scene = Scene.load(scene_folder(name))
    rng, lattice_m = np.random.default_rng(seed), scene.lattice.positions_m
    points_m = lattice_m[rng.choice(len(lattice_m), receivers, replace=False)]
    solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, settings)
    solver.solve(scene.device_m[0], points_m[:settings.batch_receivers])  # compiles the kernels
    started = sum(os.times()[:2])
    gain_db = np.stack([solver.gains(device_m, points_m) for device_m in scene.device_m])
    cpu_s = sum(os.times()[:2]) - started
    # A batch that is not full costs what a full one does; speeds are of full ones.
    solved = len(scene.device_m) * len(solver.batches(receivers)) * settings.batch_receivers
    return gain_db, 2 * solved / cpu_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def tracer_table(rows: pd.DataFrame) -> str:
    """Return speed, memory and error by settings."""
    by_name = rows.set_index("name")
    heads = ["settings", "links/s", "peak GiB", "median [dB]", "90 % [dB]", "RMS [dB]",
             "links lost"]
    return markdown(heads, [[name, f"{row['links_per_s']:.0f}", *(
        f"{row[column]:.2f}" for column in ("peak_gib", "median_db", "p90_db", "rms_db")),
        "0 %" if row["missed"] == 0 else f"{100 * row['missed']:.1f} %"]
        for name, row in ((each, by_name.loc[each]) for each in ROWS if each in by_name.index)])


def accuracy_cases(seed: int) -> dict[str, dict]:
    """Return scenes and qualities; the reference of `high` takes half of the receivers."""
    return {f"{name} `{quality}`": {"city": name, "quality": quality, "receivers": receivers}
            for quality, receivers in (("default", 40), ("fast", 40), ("high", 20))
            for name in ("sionna:munich", "rbm", "rdm")}


def measure_accuracy(seed: int, settings: dict) -> dict:
    """Compare gains with those of ten times the rays, over links detected in both.

    Returns:
        By line of sight: number of links, mean difference, RMS and 90th percentile [dB].
    """
    with scratch_folder() as folder:
        name = settings["city"]
        if name.startswith("sionna:"):
            build_scene(name, folder / "scene", BuildOptions(devices=10))
        scene = Scene.load(folder / "scene" if name.startswith("sionna:") else scene_folder(name))
        rng, lattice_m = np.random.default_rng(seed), scene.lattice.positions_m
        outdoors_m = lattice_m[~scene.blocked.ravel()]
        points_m = outdoors_m[rng.choice(len(outdoors_m), settings["receivers"], replace=False)]
        solver = SolverSettings.of_quality(settings["quality"], seed=seed + 1)
        gain_db, finer_db = (trace_gains(scene, scene.device_m, points_m, each)
                             for each in (solver, solver.finer(FINER)))
        los = np.stack([scene.city.line_of_sight(at_m[None], points_m) for at_m in scene.device_m])
        limit_db = scene.config.gain_limit_db
    both = (gain_db >= limit_db) & (finer_db >= limit_db)
    results: dict[str, float] = {}
    for kind, of_kind in (("los", los), ("nlos", ~los)):
        error_db = (gain_db - finer_db)[both & of_kind]
        results |= {f"{kind}_links": len(error_db), f"{kind}_bias_db": error_db.mean(),
                    f"{kind}_rms_db": np.sqrt(np.mean(error_db**2)),
                    f"{kind}_p90_db": np.quantile(np.abs(error_db), 0.9)}
    return results


def accuracy_table(rows: pd.DataFrame) -> str:
    """Return the differences by scene, quality and line of sight."""
    heads = ["scene and quality", *(
        f"{kind}: {what}" for kind in ("LoS", "NLoS")
        for what in ("links", "mean [dB]", "RMS [dB]", "9 of 10 within [dB]"))]
    return markdown(heads, [[row["name"], *(
        str(row[f"{kind}_links"]) if what == "links" else f"{row[f'{kind}_{what}']:.2f}"
        for kind in ("los", "nlos") for what in ("links", "bias_db", "rms_db", "p90_db"))]
        for _, row in rows.iterrows()])


STUDIES = {"tracer": Study("What do the ray tracer's settings cost and bring?", time_tracer,
                           tracer_cases, tracer_table, seeds=1),
           "accuracy": Study("How far are traced gains from those of ten times the rays?",
                             measure_accuracy, accuracy_cases, accuracy_table, seeds=1)}
