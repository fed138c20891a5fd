"""Federation over Flower's processes against means in one process: `flower`.

Three parties: two cities whose flights are simulated, and one that has measurements of flights that
were flown before. Rewards are shares of all data that each party's policy collects in the truth of
its own city. Needs the extra `flower`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marl.checkpoint import load_checkpoint
from marl.fedqmix.client import Party, rounds_of
from marl.fedqmix.federation import Weights
from marl.fedqmix.session import federate
from marl.fedqmix.settings import FederationSettings, Shared, write_app
from marl.settings import PRESETS, RunSettings
from radiotwin import Scene, fly_survey
from radiotwin.io.files import scratch_folder
from radiotwin.maps.survey import read_truth
from studies.runner import Study
from studies.tables import markdown, number, scene_folder, with_sd

CITIES, MEASURED = ("rbm", "rdm", "rbm"), 2
KILLED = 1  # party


def measure(seed: int, settings: dict) -> dict[str, Any]:
    """Run a federation of three parties.

    Args:
        seed: of all parties.
        settings: `engine`: `in-process` or `flower`; `killed_after`: round after which the
            SuperNode of a party is killed, 0 for none; `compare_means`: with those of one process;
            the rest are fields of the run.

    Returns:
        `reward` of each party, and its mean; `heard` parties and `seconds` of each round;
        `largest_difference` of a weight from the mean in one process, over all rounds.
    """
    run = RunSettings(seed=seed, device="cpu", real_episodes=settings["real_episodes"],
                      episodes=settings["episodes"], flights=settings["flights"])
    learner = PRESETS["fast"].model_copy(update={
        name: settings[name] for name in ("epsilon_slots", "federate_every", "hidden")})
    shared = Shared(run, learner, FederationSettings(round_timeout_s=settings["timeout_s"]),
                    len(CITIES), 3, 10)
    result: dict[str, Any] = {}
    with scratch_folder() as folder:
        parties = _parties(folder, seed, settings["survey_flights"])
        means: list[Weights] = []
        if settings["engine"] == "in-process" or settings["compare_means"]:
            means = federate(shared, parties, lambda _: None)
        if settings["engine"] == "flower":
            result |= _over_flower(shared, parties, folder, settings["killed_after"])
        if settings["engine"] == "flower" and settings["compare_means"]:
            result["largest_difference"] = f"{_difference(folder / 'out', means):.1e}"
        tables = [pd.read_csv(sorted(party.folder.glob("run-*/metrics.csv"),
                                     key=lambda path: path.stat().st_mtime)[-1])
                  for party in parties]
    rewards = [float(table["truth_ratio"].iloc[-1]) for table in tables]
    return result | {"reward": rewards, "mean_reward": float(np.mean(rewards)),
                     "rounds": len(rounds_of(run, learner))}


def _parties(folder: Path, seed: int, flights: int) -> list[Party]:
    scenes = [scene_folder(name).absolute() for name in CITIES]
    scene = Scene.load(scenes[MEASURED])
    measured = fly_survey(scene, read_truth(scene, "traced"), flights=flights,
                          pattern="random-waypoint", seed=1000 + seed)
    path = folder / "survey" / "measurements.csv"
    path.parent.mkdir()
    measured.write(path)
    return [Party(each, folder / "parties" / str(index), index, "traced",
                  path if index == MEASURED else None) for index, each in enumerate(scenes)]


def _over_flower(shared: Shared, parties: list[Party], folder: Path,
                 killed_after: int) -> dict[str, Any]:
    from marl.fedqmix.flower_run import Federation  # Flower is an extra

    out, home = folder / "out", folder / "home"
    home.mkdir()
    write_app(shared, out / "app")
    federation = Federation(parties, out, home, simulation=False)
    try:
        federation.open()
        federation.watch(federation.run(out / "app"), _killer(federation, killed_after))
    finally:
        federation.close()
    rounds = pd.read_csv(out / "rounds.csv")
    return {"heard": rounds["parties"].tolist(), "seconds": rounds["seconds"].round(1).tolist()}


def _killer(federation: Any, killed_after: int) -> Callable[[int], None]:
    done = 0

    def on_progress(rounds: int) -> None:
        nonlocal done
        if done < killed_after <= done + rounds:
            federation.processes.kill(f"supernode-{KILLED}")
        done += rounds

    return on_progress


def _difference(out: Path, means: list[Weights]) -> float:
    """Return the largest difference of any weight in any round."""
    largest = 0.0
    for number_, mean in enumerate(means):
        state = load_checkpoint(out / "weights" / f"round-{number_:05d}.safetensors")
        largest = max([largest, *(float(np.abs(state["weights"][name] - mean[name]).max())
                                  for name in mean)])
    return largest


def _cases(seed: int) -> dict[str, dict]:
    base: dict[str, Any] = {
        "real_episodes": 2, "episodes": 200, "federate_every": 40, "hidden": 32, "flights": 32,
        "epsilon_slots": 10_000, "survey_flights": 3, "timeout_s": 900, "killed_after": 0,
        "compare_means": False}
    cases = {"in-process": base | {"engine": "in-process"},
             "flower, one killed": base | {"engine": "flower", "killed_after": 3}}
    if seed == 0:
        cases["flower"] = base | {"engine": "flower", "compare_means": True}
    return cases


def _table(rows: pd.DataFrame) -> str:
    lines = []
    for name, group in rows.groupby("name", sort=False):
        each = np.array(group["reward"].tolist())
        first = group.iloc[0]
        heard, seconds, difference = (
            first.get(key) for key in ("heard", "seconds", "largest_difference"))
        lines.append([str(name), str(len(group)), *(with_sd(each[:, party]) for party in range(3)),
                      with_sd(group["mean_reward"].to_numpy()),
                      " ".join(map(str, heard)) if isinstance(heard, list) else "–",
                      number(float(np.median(seconds)), 0) if isinstance(seconds, list) else "–",
                      difference if isinstance(difference, str) else "–"])
    return markdown(["", "seeds", "RBM", "RDM", "RBM, measured", "mean of the parties",
                     "parties heard in each round (seed 0)", "seconds a round, median",
                     "largest difference of a weight"], lines)


STUDIES = {"flower": Study(
    "Does a federation over Flower's processes collect what one in a single process does?",
    measure, _cases, _table)}
