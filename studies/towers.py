"""What two towers that no map shows cost a learner, and what closing the loop brings back: `towers`.

The truth is traced with two towers beside devices of a scene that does not show them. Five flights
are measured in it; a twin is learnt from them, and corrected by `close-loop`. The learner trains in
the twin, in the corrected twin or in the truth, and flies in the truth. The traced map (a quarter of
an hour) and the twins are kept in `runs/towers`.
"""

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pandas as pd
import trimesh

from marl.mission import Known
from marl.randomness import stream
from marl.reality import Reality, known_by
from marl.settings import PRESETS, RunSettings
from marl.strategies import evaluate, make_strategy
from radiotwin import Scene, SolverSettings, Twin, close_loop, corrected_twin, fit_twin, fly_survey
from radiotwin import make_report, score_map, trace_map
from radiotwin.progress import progress
from studies.runner import Study
from studies.tables import markdown, scene_folder

FOLDER = Path("runs/towers")
SIDE_M, HEIGHT_M = 20.0, 52.0  # of a tower; below the UAVs
DISTANCE_M = (18.0, 45.0)  # from a device to the middle of a tower
FLIGHTS, EVALUATION_FLIGHTS = 5, 16
KINDS = ("twin", "corrected twin", "truth")


def towers_cases(seed: int) -> dict[str, dict]:
    """Return what FedQMIX trains in."""
    return {kind: {"scene": "rbm", "algorithm": "fedqmix", "episodes": 3000, "trained_in": kind} for kind in KINDS}


def train_with_towers(seed: int, settings: dict) -> dict:
    """Train in the map of a twin, or in the truth, and fly in the truth.

    Args:
        seed: of flights, noise, fits and training.
        settings: `scene`, `algorithm`, `episodes` of each replica, `trained_in`.

    Returns:
        Shares collected in the map that was trained in and in the truth, error of that map [dB].
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    towers_m = place_towers(scene)
    truth = trace_map(with_towers(scene, towers_m, FOLDER / "truth"), SolverSettings.of_quality("default"),
                      FOLDER / "truth.nc")
    truth.dataset.attrs["scene_hash"] = scene.content_hash()  # nobody knows that it is another city
    kind = settings["trained_in"]
    twin = None if kind == "truth" else learn_twin(scene, truth, seed, kind)
    run = RunSettings(algorithm=settings["algorithm"], episodes=settings["episodes"], real_episodes=1, seed=seed)
    reality = Reality(scene, truth, run.assignment, 0.0, seed)
    known = Known.truth(scene) if twin is None else known_by(twin)
    real = reality.mission(known)
    mission = real if twin is None else reality.twin_mission(twin, known)
    strategy = make_strategy(run, PRESETS["fast"], mission, 1, "cpu")
    try:
        with progress("training", total=run.episodes) as advance:
            strategy.prepare(mission, advance)
        policy = strategy.policy(stream(seed, "decisions", 0))
        trained, flown = (evaluate(where, policy, EVALUATION_FLIGHTS, stream(seed, purpose)).ratio(where).mean()
                          for where, purpose in ((mission, "twin evaluation"), (real, "truth evaluation")))
    finally:
        strategy.close()
    error_db = None if twin is None else score_map("twin", twin.radio_map(scene), truth)[0]["rmse_db"]
    return {"trained_ratio": trained, "truth_ratio": flown, "map_rmse_db": error_db, "towers_m": towers_m}


def place_towers(scene: Scene) -> list[list[float]]:
    """Return the middles of two towers [m], each on free ground beside another device."""
    rng, found, used = np.random.default_rng(0), [], set()
    corner_m = 0.5 * SIDE_M * np.array(
        [(1, 1), (1, -1), (-1, -1), (-1, 1), (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    while len(found) < 2:
        device = int(rng.integers(len(scene.device_m)))
        angle, distance_m = rng.uniform(0, 2 * np.pi), rng.uniform(*DISTANCE_M)
        middle_m = scene.device_m[device, :2] + distance_m * np.array([np.cos(angle), np.sin(angle)])
        points_m = np.column_stack([middle_m + corner_m, np.full(len(corner_m), 1.0)])
        apart_m = np.linalg.norm(scene.device_m[:, :2] - middle_m, axis=1)
        if device not in used and not scene.city.inside(points_m).any() and apart_m.min() > SIDE_M:
            found.append([round(float(value), 1) for value in middle_m])
            used.add(device)
    return found


def with_towers(scene: Scene, towers_m: list[list[float]], folder: Path) -> Scene:
    """Write a copy of a scene folder with towers of concrete in it, unless it is there."""
    if not (folder / "scene.toml").exists():
        shutil.copytree(scene.folder, folder, ignore=shutil.ignore_patterns("cache", "truth*.nc"), dirs_exist_ok=True)
        tree = ElementTree.parse(folder / "city.xml")
        for index, middle_m in enumerate(towers_m):
            box = trimesh.creation.box(extents=[SIDE_M, SIDE_M, HEIGHT_M])
            box.apply_translation([*middle_m, HEIGHT_M / 2])
            box.export(folder / "meshes" / f"tower_{index}.ply")
            shape = ElementTree.SubElement(tree.getroot(), "shape", type="ply", id=f"mesh-tower_{index}")
            ElementTree.SubElement(shape, "string", name="filename", value=f"meshes/tower_{index}.ply")
            ElementTree.SubElement(shape, "boolean", name="face_normals", value="true")
            ElementTree.SubElement(shape, "ref", id="mat-concrete", name="bsdf")
        tree.write(folder / "city.xml", encoding="utf-8", xml_declaration=True)
    return Scene.load(folder)


def learn_twin(scene: Scene, truth: RadioMap, seed: int, kind: str) -> Twin:
    """Return the twin or the corrected one; both are kept, with `closeloop.json`."""
    folder = FOLDER / f"twins-{seed}"
    if not (folder / "corrected twin").exists():
        measurements = fly_survey(scene, truth, flights=FLIGHTS, pattern="random-waypoint", seed=seed)
        fit_twin(measurements, scene, seed=seed).save(folder / "twin")
        with progress("closing the loop", total=None) as advance:
            loop = close_loop(measurements, scene, "auto", seed, lambda text: advance(1, text))
        (folder / "closeloop.json").write_text(json.dumps(make_report(loop), indent=1), encoding="utf-8")
        corrected_twin(loop, scene).save(folder / "corrected twin")
    return Twin.load(folder / kind)


def towers_table(rows: pd.DataFrame) -> str:
    """Return what is collected in the truth, by seed."""
    ratio, error_db = (rows.pivot(index="seed", columns="name", values=column)
                       for column in ("truth_ratio", "map_rmse_db"))
    lines = [[str(seed), *(f"{each[kind]:.3f}" for kind in KINDS),
              f"{error_db.loc[seed, 'twin']:.1f} → {error_db.loc[seed, 'corrected twin']:.1f}"]
             for seed, each in ratio.iterrows()]
    heads = ["seed", *KINDS, "error of the map, twin → corrected [dB]"]
    means = ", ".join(f"{ratio[kind].mean():.3f}" for kind in KINDS)
    return f"{markdown(heads, lines)}\n\nMean: {means}."


STUDIES = {"towers": Study("What do two towers that no map shows cost a learner?", train_with_towers, towers_cases,
                           towers_table)}
