"""Speed, memory and numerical error of tracing, for settings that are worth a thought.

    python benchmarks/trace.py [SCENE] [--receivers 60] [--reference FILE]

SCENE is a scene folder (default scenes/rbm). A random sample of its lattice is solved for all devices by each of
the settings, in a process of its own, and held against a reference with ten times the default's rays (solved once;
`--reference` keeps it in a file). Printed for each:

- links/s: per second of wall time, and per two seconds of processor time (what two idle cores would do);
- GiB: peak resident memory;
- median, p90, RMS: of the difference from the reference [dB], over links that the scene's receiver detects;
- lost: links that the reference has and the settings miss [%].

The last line is the ratio of times between one device a call and all devices in one call, with the same rays in
the same memory.
"""

import argparse
import multiprocessing
import os
import resource
import time
from pathlib import Path

import numpy as np

from radiotwin.scene import Scene
from radiotwin.trace import SolverSettings
from radiotwin.trace.solver import PathGains

DEFAULT = SolverSettings()
ROWS = {
    "fast": SolverSettings.of_quality("fast"),
    "default": DEFAULT,
    "high": SolverSettings.of_quality("high"),
    "50,000 samples": SolverSettings(samples_per_src=50_000),
    "200,000 samples": SolverSettings(samples_per_src=200_000),
    "20 receivers a call": SolverSettings(batch_receivers=20),
    "depth 3": SolverSettings(max_depth=3),
    "depth 5": SolverSettings(max_depth=5),
    "refraction": SolverSettings(refraction=True),
    "no diffraction": SolverSettings(diffraction=False),
}


def sample_points(scene: Scene, receivers: int) -> np.ndarray:
    positions_m = scene.lattice.positions_m
    return positions_m[np.random.default_rng(0).choice(len(positions_m), receivers, replace=False)]


def measure(folder: Path, settings: SolverSettings, receivers: int, queue) -> None:
    """Solve the sample; kernels are compiled before the clock starts."""
    scene = Scene.load(folder)
    points_m = sample_points(scene, receivers)
    solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, settings)
    solver.solve(scene.device_m[0], points_m[: settings.batch_receivers])
    wall_s, cpu = time.perf_counter(), os.times()
    gain_db = np.stack([solver.gains(device_m, points_m) for device_m in scene.device_m])
    wall_s, cpu_s = time.perf_counter() - wall_s, sum(os.times()[:2]) - sum(cpu[:2])
    # A batch that is not full costs what a full one does; speeds are of full ones.
    solved = len(scene.device_m) * len(solver.batches(receivers)) * settings.batch_receivers
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    queue.put((gain_db, solved / wall_s, 2 * solved / cpu_s, peak_gib))


def measure_together(folder: Path, receivers: int, queue) -> None:
    """Seconds of processor time a link, with all devices as the transmitters of one call."""
    from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE
    from radiotwin.trace.sionna_scene import candidate_search, import_sionna, load_city

    scene = Scene.load(folder)
    rt, city = import_sionna(), load_city(scene.xml_path, scene.config.radio.frequency_hz)
    batch = max(1, DEFAULT.batch_receivers // len(scene.device_m))
    for i, position_m in enumerate(scene.device_m):
        city.add(rt.Transmitter(f"t{i}", position=position_m.tolist()))
    for i, position_m in enumerate(sample_points(scene, receivers)[:batch]):
        city.add(rt.Receiver(f"r{i}", position=position_m.tolist()))
    solve = rt.PathSolver(deterministic=True)
    with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY):
        for _ in range(6):
            start = sum(os.times()[:2])
            solve(city, max_depth=DEFAULT.max_depth, samples_per_src=DEFAULT.samples_per_src,
                  max_num_paths_per_src=DEFAULT.max_num_paths_per_src // len(scene.device_m), refraction=False,
                  diffraction=True, seed=DEFAULT.seed)
            seconds = sum(os.times()[:2]) - start
    queue.put(2 * batch * len(scene.device_m) / seconds)


def in_a_process(work, *arguments):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=work, args=(*arguments, queue))
    process.start()
    result = queue.get()
    process.join()
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path, default=Path(__file__).parents[1] / "scenes" / "rbm")
    parser.add_argument("--receivers", type=int, default=60)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--only", nargs="*", default=list(ROWS), help=f"of: {', '.join(ROWS)}")
    arguments = parser.parse_args()
    scene = Scene.load(arguments.scene)
    if arguments.reference and arguments.reference.is_file():
        reference_db = np.load(arguments.reference)
    else:
        reference_db = in_a_process(measure, arguments.scene, DEFAULT.finer(10), arguments.receivers)[0]
        if arguments.reference:
            np.save(arguments.reference, reference_db)
    detected = reference_db >= scene.config.gain_limit_db
    print(f"{arguments.scene.name}: {reference_db.size} links, {detected.sum()} detected")
    print(f"{'settings':22} links/s  2 cores    GiB  median     p90     RMS   lost")
    rates = {}
    for name in arguments.only:
        gain_db, per_wall_s, rates[name], peak_gib = in_a_process(
            measure, arguments.scene, ROWS[name], arguments.receivers)
        both = detected & np.isfinite(gain_db)
        error_db = np.abs(gain_db - reference_db)[both]
        print(f"{name:22} {per_wall_s:7.0f} {rates[name]:8.0f} {peak_gib:6.2f} {np.median(error_db):7.3f} "
              f"{np.quantile(error_db, 0.9):7.2f} {np.sqrt(np.mean(error_db**2)):7.2f} "
              f"{100 * (1 - both.sum() / detected.sum()):5.1f}%", flush=True)
    if "default" in rates:
        together = in_a_process(measure_together, arguments.scene, arguments.receivers)
        print(f"one device a call over all devices in a call: {rates['default'] / together:.2f} times the links/s")


if __name__ == "__main__":
    main()
