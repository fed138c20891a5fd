"""What two towers that no map shows cost a learner, and `close-loop` brings back: `towers`.

The truth is traced with towers beside devices of a scene that does not show them. Five flights are
measured in it; a twin is learnt from them, and corrected by `close-loop`. The learner trains in the
twin, in the corrected twin or in the truth, and flies in the truth. The traced map (a quarter of an
hour) and the twins are kept in `runs/towers`.
"""

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pandas as pd
import trimesh

from marl.reality import Reality
from marl.settings import PRESETS, RunSettings
from radiotwin import (
    RadioMap,
    Scene,
    SolverSettings,
    Twin,
    close_loop,
    corrected_twin,
    fit_twin,
    fly_survey,
    make_report,
    score_map,
    trace_map,
)
from radiotwin.progress import progress
from studies.runner import Study
from studies.tables import markdown, scene_folder
from studies.twins import train_and_fly

FOLDER = Path("runs/towers")
SIDE_M, HEIGHT_M = 20.0, 52.0  # of a tower; below the UAVs
TOWERS_M = [[496.9, 207.9], [51.0, 348.0]]  # drawn once: free ground 18 to 45 m from devices
KINDS = ("twin", "corrected twin", "truth")


def towers_cases(seed: int) -> dict[str, dict]:
    """Return what FedQMIX trains in."""
    return {kind: {"scene": "rbm", "algorithm": "fedqmix", "episodes": 3000, "trained_in": kind}
            for kind in KINDS}


def train_with_towers(seed: int, settings: dict) -> dict:
    """Train in the map of a twin, or in the truth, and fly in the truth.

    Args:
        seed: of flights, noise, fits and training.
        settings: `scene`, `algorithm`, `episodes` of each replica, `trained_in`.

    Returns:
        Shares collected in the map that was trained in and in the truth, error of that map [dB].
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    truth = trace_map(with_towers(scene, FOLDER / "truth"), SolverSettings(), FOLDER / "truth.nc")
    truth.dataset.attrs["scene_hash"] = scene.content_hash()  # nobody knows that it is another city
    kind = settings["trained_in"]
    twin = None if kind == "truth" else learn_twin(scene, truth, seed, kind)
    run = RunSettings(algorithm=settings["algorithm"], episodes=settings["episodes"], seed=seed,
                      real_episodes=1, flights=16)
    reality = Reality(scene, truth, run.assignment, 0.0, seed)
    result = train_and_fly(reality, twin, run, PRESETS["fast"])[0]
    scores = [] if twin is None else score_map("twin", twin.radio_map(scene), truth)
    return {"trained_ratio": result["trained_twin_ratio"],
            "truth_ratio": result["trained_truth_ratio"],
            "map_rmse_db": scores[0]["rmse_db"] if scores else None, "towers_m": TOWERS_M}


def with_towers(scene: Scene, folder: Path) -> Scene:
    """Write a copy of a scene folder with towers of concrete in it, unless it is there."""
    if not (folder / "scene.toml").exists():
        shutil.copytree(scene.folder, folder, ignore=shutil.ignore_patterns("cache", "truth*.nc"),
                        dirs_exist_ok=True)
        tree = ElementTree.parse(folder / "city.xml")
        for index, middle_m in enumerate(TOWERS_M):
            box = trimesh.creation.box(extents=[SIDE_M, SIDE_M, HEIGHT_M])
            box.apply_translation([*middle_m, HEIGHT_M / 2])
            box.export(folder / "meshes" / f"tower_{index}.ply")
            tree.getroot().append(ElementTree.fromstring(
                f'<shape type="ply" id="mesh-tower_{index}"><string name="filename" '
                f'value="meshes/tower_{index}.ply"/><boolean name="face_normals" value="true"/>'
                '<ref id="mat-concrete" name="bsdf"/></shape>'))
        tree.write(folder / "city.xml", encoding="utf-8", xml_declaration=True)
    return Scene.load(folder)


def learn_twin(scene: Scene, truth: RadioMap, seed: int, kind: str) -> Twin:
    """Return the twin or the corrected one; both are kept, with `closeloop.json`."""
    folder = FOLDER / f"twins-{seed}"
    if not (folder / "corrected twin").exists():
        measurements = fly_survey(scene, truth, flights=5, pattern="random-waypoint", seed=seed)
        fit_twin(measurements, scene, seed=seed).save(folder / "twin")
        with progress("closing the loop", total=None) as advance:
            loop = close_loop(measurements, scene, "auto", seed, lambda text: advance(1, text))
        (folder / "closeloop.json").write_text(json.dumps(make_report(loop)), encoding="utf-8")
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


STUDIES = {"towers": Study("What do two towers that no map shows cost a learner?",
                           train_with_towers, towers_cases, towers_table)}
