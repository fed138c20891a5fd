"""What two towers that no map shows cost a learner, and what closing the loop brings back.

    python benchmarks/closeloop_marl.py --folder runs/towers --seeds 3 -o docs/results/closeloop_marl.json

The truth is traced with two towers beside devices of `scenes/rbm`, which does not show them. Five flights are measured
in it; a twin is learnt from them, and corrected by `close-loop`. The learner trains in the twin, in the corrected twin
and in the truth, and flies in the truth. Tracing takes a quarter of an hour; what is there is not made again.
"""

import argparse
import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

from marl.algorithm1 import Reality
from marl.flights import evaluate
from marl.learner import make_learner
from marl.mission import Known
from marl.randomness import stream
from marl.settings import PRESETS, RunSettings
from marl.threads import keep_memory, limit_threads
from radiotwin.closeloop.corrected import corrected_twin
from radiotwin.closeloop.report import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.files import atomic_path
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.survey import fly_survey
from radiotwin.trace import SolverSettings, trace_map
from radiotwin.twin import Twin, fit_twin

SIDE_M, HEIGHT_M = 20.0, 52.0  # below the UAVs
NEAREST_M, FARTHEST_M = 18.0, 45.0  # from a device to the middle of a tower
FLIGHTS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=Path("scenes/rbm"))
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--algorithm", default="fedqmix")
    parser.add_argument("--episodes", type=int, default=8000, help="of training of each replica")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    limit_threads(1)
    keep_memory()
    scene = Scene.load(arguments.scene)
    towers_m = place_towers(scene)
    truth = trace_map(with_towers(scene, towers_m, arguments.folder / "truth"), SolverSettings.of_quality("default"),
                      arguments.folder / "truth.nc")
    truth.dataset.attrs["scene_hash"] = scene.content_hash()  # nobody knows that it is another city
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {
        "towers_m": towers_m, "algorithm": arguments.algorithm, "episodes": arguments.episodes, "runs": []}
    for seed in range(arguments.seeds):
        twins = learn_twins(scene, truth, seed, arguments.folder / f"twins-{seed}")
        for name, twin in twins.items():
            if any((run["seed"], run["trained_in"]) == (seed, name) for run in record["runs"]):
                continue
            record["runs"].append({"seed": seed, "trained_in": name}
                                  | train(scene, truth, twin, seed, arguments.algorithm, arguments.episodes))
            print(json.dumps(record["runs"][-1]), flush=True)
            with atomic_path(arguments.out) as temporary:
                temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")


def place_towers(scene: Scene) -> list[list[float]]:
    """Middles of two towers (2, 2) [m], each on free ground beside another device."""
    rng, found, used = np.random.default_rng(0), [], set()
    corner_m = 0.5 * SIDE_M * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    while len(found) < 2:
        device = int(rng.integers(len(scene.device_m)))
        angle, distance_m = rng.uniform(0, 2 * np.pi), rng.uniform(NEAREST_M, FARTHEST_M)
        middle_m = scene.device_m[device, :2] + distance_m * np.array([np.cos(angle), np.sin(angle)])
        points_m = np.column_stack([middle_m + corner_m, np.full(len(corner_m), 1.0)])
        apart_m = np.linalg.norm(scene.device_m[:, :2] - middle_m, axis=1)
        if device not in used and not scene.city.inside(points_m).any() and apart_m.min() > SIDE_M:
            found.append([round(float(value), 1) for value in middle_m])
            used.add(device)
    return found


def with_towers(scene: Scene, towers_m: list[list[float]], folder: Path) -> Scene:
    """A copy of a scene folder with towers of concrete in it."""
    if not (folder / "scene.toml").exists():
        shutil.copytree(scene.folder, folder, ignore=shutil.ignore_patterns("cache", "truth*.nc"), dirs_exist_ok=True)
        tree = ElementTree.parse(folder / "city.xml")
        for number, middle_m in enumerate(towers_m):
            box = trimesh.creation.box(extents=[SIDE_M, SIDE_M, HEIGHT_M])
            box.apply_translation([*middle_m, HEIGHT_M / 2])
            box.export(folder / "meshes" / f"tower_{number}.ply")
            shape = ElementTree.SubElement(tree.getroot(), "shape", type="ply", id=f"mesh-tower_{number}")
            ElementTree.SubElement(shape, "string", name="filename", value=f"meshes/tower_{number}.ply")
            ElementTree.SubElement(shape, "boolean", name="face_normals", value="true")
            ElementTree.SubElement(shape, "ref", id="mat-concrete", name="bsdf")
        tree.write(folder / "city.xml", encoding="utf-8", xml_declaration=True)
    return Scene.load(folder)


def learn_twins(scene: Scene, truth, seed: int, folder: Path) -> dict[str, Twin | None]:
    """The twin, the corrected one, and None for the truth; kept in a folder."""
    if not (folder / "corrected").exists():
        measurements = fly_survey(scene, truth, flights=FLIGHTS, pattern="random-waypoint", seed=seed)
        fit_twin(measurements, scene, seed=seed).save(folder / "twin")
        with progress("closing the loop", total=None) as advance:
            loop = close_loop(measurements, scene, "auto", seed, lambda text: advance(1, text))
        (folder / "closeloop.json").write_text(json.dumps(make_report(loop), indent=1), encoding="utf-8")
        corrected_twin(loop, scene).save(folder / "corrected")
    return {"twin": Twin.load(folder / "twin"), "corrected twin": Twin.load(folder / "corrected"), "truth": None}


def train(scene: Scene, truth, twin: Twin | None, seed: int, algorithm: str, episodes: int) -> dict:
    """Train in the map of a twin (or in the truth) and fly in the truth."""
    run = RunSettings(algorithm=algorithm, episodes=episodes, real_episodes=1, seed=seed)
    reality = Reality(scene, truth, run.assignment, 0.0, seed)
    known = Known.truth(scene) if twin is None else Known.of(twin.devices)
    mission = reality.mission(known) if twin is None else reality.twin_mission(twin, known)
    strategy = make_learner(run, PRESETS["fast"], mission, 1)
    try:
        with progress("training", total=episodes) as advance:
            strategy.prepare(mission, advance)
        policy = strategy.policy(stream(seed, "decisions", 0))
        ratios = [evaluate(where, policy, 16, stream(seed, purpose)).ratio(where).mean() for where, purpose in
                  ((mission, "twin evaluation"), (reality.mission(known), "truth evaluation"))]
    finally:
        strategy.close()
    error_db = np.nan if twin is None else _error_db(twin, scene, truth)
    return {"trained_ratio": round(float(ratios[0]), 4), "truth_ratio": round(float(ratios[1]), 4),
            "map_rmse_db": None if twin is None else round(error_db, 2)}


def _error_db(twin: Twin, scene: Scene, truth) -> float:
    found = twin.radio_map(scene)
    rows = [truth.devices.index(device) for device in found.devices]
    error = truth.gain_db[rows] - found.gain_db
    return float(np.sqrt(np.nanmean(error**2)))


if __name__ == "__main__":
    main()
