"""A run of Algorithm 1, or of what it is held against."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from marl.algorithm1 import run_algorithm
from marl.figures import choose_flight
from marl.flights import Flights
from marl.mission import Mission, make_mission
from marl.settings import LearnerSettings, RunSettings
from marl.threads import torch_device
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.survey import read_truth

SCENES = Path("scenes")


def scene_folder(name: str) -> Path:
    """A scene that ships has no path in a record, which is read on other machines; others have theirs."""
    return SCENES / name if name == Path(name).name else Path(name)


def learn(settings: dict, seed: int, folder: Path, keep: Callable[[], None]) -> dict:
    """Run Algorithm 1.

    Args:
        settings: `run` and `learner`, fields of `RunSettings` and `LearnerSettings`.
        seed: of everything random.
        folder: for the checkpoint, which the run goes on from.
        keep: called after every checkpoint.

    Returns:
        `curve`: a row for every round; `looks`: (round, episodes so far, share in the map that is trained in) at each
        look at the policy; `flight`: the middle one of the last evaluation.
    """
    run = RunSettings.model_validate(settings["run"] | {"scene": scene_folder(settings["run"]["scene"]), "seed": seed})
    learner = LearnerSettings.model_validate(settings["learner"])
    scene = Scene.load(run.scene)
    truth = read_truth(scene, run.truth)
    scene.check_map(truth)
    with progress(f"{run.algorithm}, seed {seed}", total=run.real_episodes * run.episodes) as advance:
        outcome = run_algorithm(run, learner, scene, truth, folder, True, lambda rows, blocks: keep(), advance,
                                torch_device(run.device))
    real = make_mission(scene, truth, outcome.known, run.assignment)
    return {"curve": outcome.rows,
            "looks": [[block["round"], block["episodes"], block["twin_ratio"]] for block in outcome.blocks],
            "known_m": outcome.known.position_m, "flight": flight_record(outcome.flights, real)}


def flight_record(flights: Flights, mission: Mission) -> dict:
    """The flight nearest the median, slot by slot: what `figures.draw_trajectories` needs."""
    which = choose_flight(flights, mission)
    slots = int(flights.length[which])
    frames = flights.frames
    return {"cell": frames.cell[which, :slots], "battery": frames.battery[which, :slots],
            "assigned": frames.assigned[which, :slots],
            "collected": np.round(flights.collected[which, :slots].astype(float), 1)}
