"""How good a twin is, and how good it is to train in."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from marl.algorithm1 import Reality, location_errors_m
from marl.environment import Environment
from marl.experiments.learning import scene_folder
from marl.flights import Flights, Replayed, evaluate, fly
from marl.heuristics import PATTERN, HeuristicPolicy
from marl.learner import make_learner
from marl.mission import Known, Mission
from marl.planner import PlanPolicy, plan
from marl.randomness import stream
from marl.settings import LearnerSettings, RunSettings
from radiotwin.closeloop.corrected import corrected_twin
from radiotwin.closeloop.run import close_loop
from radiotwin.compare import score_map
from radiotwin.measurements import Measurements
from radiotwin.progress import progress
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey import fly_survey, read_truth
from radiotwin.twin import Twin, fit_twin

MODELS = {"nn": "segmented_nn", "segmented": "segmented_log_distance", "log-distance": "log_distance",
          "raytrace": "raytrace"}
"""Name of a twin in the study -> model of `fit_twin`; `corrected` and `truth` besides."""
SAMPLES = 10  # times that a sequence of actions is flown in a twin, whose shadowing differs from time to time


def judge_twin(settings: dict, seed: int, folder: Path, keep: Callable[[], None]) -> dict:
    """Learn a twin from more and more real flights, and hold it against the truth.

    Args:
        settings: `scene`, `truth`, `model` (of `fit_twin`), `survey_flights` (how many, a list),
            `noise_db`.
        seed: of flights, noise and fit.
        folder, keep: not used; a run takes a minute.

    Returns:
        `curve`: a row for each number of flights: error on the whole map, distance of each unknown device's estimate
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    truth = read_truth(scene, settings["truth"])
    rows = []
    with progress(settings["model"], total=len(settings["survey_flights"])) as advance:
        for flights in settings["survey_flights"]:
            measured = _survey(scene, truth, flights, settings["noise_db"], seed)
            twin = fit_twin(measured, scene, model=settings["model"], seed=seed)
            rows.append({"real_episodes": flights, "links": len(measured.table)} | _errors(twin, scene, truth))
            advance()
    return {"curve": rows}


def train_in(settings: dict, seed: int, folder: Path, keep: Callable[[], None]) -> dict:
    """Learn a twin from real flights, train and plan in it, fly in the truth.

    Args:
        settings: `scene`, `truth`, `twin` (of `MODELS`, or `corrected`, `truth`), `survey_flights`, `noise_db`,
            `episodes`, `learner` (fields of `LearnerSettings`), `planner_iterations`, `flights` of an evaluation,
            `replayed_flights`.
        seed: of everything random.
        folder: the twin is kept in it; closing the loop takes minutes.
        keep: called when it is there.

    Returns:
        `curve`: looks at the policy; shares of policy and plan in the map that they were made in and in the truth;
        `fidelity`: what the same actions collect in both; errors of the twin
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    truth = read_truth(scene, settings["truth"])
    name, flights = settings["twin"], settings["flights"]
    measured = _survey(scene, truth, settings["survey_flights"], settings["noise_db"], seed)
    twin = None if name == "truth" else _learnt(name, seed, scene, measured, folder)
    keep()
    reality = Reality(scene, truth, "matching", settings["noise_db"], seed)
    known = Known.truth(scene) if twin is None else Known.of(twin.devices)
    real = reality.mission(known)
    inside = real if twin is None else reality.twin_mission(twin, known, measured)
    run = RunSettings(algorithm="qmix", episodes=settings["episodes"], real_episodes=1, seed=seed)
    strategy = make_learner(run, LearnerSettings.model_validate(settings["learner"]), inside, 1)
    try:
        with progress(f"training, {name}", total=run.episodes) as advance:
            looks = strategy.prepare(inside, advance)
        policy = strategy.policy(stream(seed, "decisions", 0))
        policies = {"trained": policy, "plan": PlanPolicy(plan(inside, settings["planner_iterations"], seed).actions)}
        result = {f"{who}_{where}_ratio": evaluate(mission, each, flights, stream(seed, purpose)).ratio(mission).mean()
                  for who, each in policies.items()
                  for where, mission, purpose in (("twin", inside, "twin evaluation"),
                                                  ("truth", real, "truth evaluation"))}
    finally:
        strategy.close()
    result["curve"] = [{"episodes": look["episodes"], "ratio": look["twin_ratio"]} for look in looks]
    if twin is not None:
        result["fidelity"] = fidelity(reality.mission(Known.truth(scene)), inside, settings["replayed_flights"], seed)
        result |= _errors(twin, scene, truth)
        result["effects"] = sorted({part["name"] for part in twin.effects.get("parts", [])})
    return result


class Mixed:
    """Greedy flights with true positions, each with its own share of random actions: bad ones and good ones."""

    def __init__(self, rng: np.random.Generator):
        self._greedy, self._random, self._rng = HeuristicPolicy("greedy", rng), HeuristicPolicy("random", rng), rng

    def start(self, mission: Mission, flights: int) -> None:
        for policy in (self._greedy, self._random):
            policy.start(mission, flights)
        self._share = np.linspace(0, 1, flights)[:, None]

    def act(self, frame):
        explores = self._rng.random(frame.battery.shape) < self._share
        return np.where(explores, self._random.act(frame), self._greedy.act(frame))


def fidelity(real: Mission, twin: Mission, flights: int, seed: int) -> dict[str, float]:
    """What the same actions collect in a twin and in the truth.

    Args:
        real, twin: the mission in both.
        flights: sequences of actions, from greedy to random.
        seed: of these.

    Returns:
        over the sequences: `correlation` of the collected shares, `bias` (twin less truth), `rmse`; the same for the
        share collected from each device, with `device_`
    """
    flown = fly(Environment(real, flights, stream(seed, "real flight")), Mixed(stream(seed, "decisions", 1)))
    replays = [fly(Environment(twin, flights, stream(seed, "twin evaluation", number)), Replayed(flown.action))
               for number in range(SAMPLES)]
    there, here = _by_device(flown), np.mean([_by_device(each) for each in replays], axis=0)
    found = {}
    for prefix, one, other in (("", there.mean(axis=1), here.mean(axis=1)), ("device_", there.ravel(), here.ravel())):
        found[f"{prefix}correlation"] = float(np.corrcoef(one, other)[0, 1])
        found[f"{prefix}bias"] = float((other - one).mean())
        found[f"{prefix}rmse"] = float(np.sqrt(np.mean((other - one) ** 2)))
    return found


def _by_device(flights: Flights) -> np.ndarray:
    """(E, K) share of each device's data that was collected."""
    taken, served = np.zeros(flights.frames.data_units.shape[::2]), flights.frames.assigned
    flight, slot, uav = np.nonzero(served >= 0)
    np.add.at(taken, (flight, served[flight, slot, uav]), flights.collected[flight, slot, uav])
    return taken / flights.frames.data_units[:, 0]


def _survey(scene: Scene, truth: RadioMap, flights: int, noise_db: float, seed: int) -> Measurements:
    return fly_survey(scene, truth, flights=flights, pattern=PATTERN, seed=seed,
                      noise_db=0.0 if "sigma_db" in truth.dataset else noise_db)


def _learnt(name: str, seed: int, scene: Scene, measured: Measurements, folder: Path) -> Twin:
    if (folder / "twin" / "twin.json").is_file():
        return Twin.load(folder / "twin")
    if name == "corrected":
        with progress("closing the loop", total=None) as advance:
            loop = close_loop(measured, scene, "auto", seed, lambda text: advance(1, text))
        twin = corrected_twin(loop, scene)
    else:
        twin = fit_twin(measured, scene, model=MODELS[name], seed=seed)
    twin.save(folder / "twin")
    return twin


def _errors(twin: Twin, scene: Scene, truth: RadioMap) -> dict:
    """Of the map and of the unknown devices' positions."""
    scores = {row["links"]: row["rmse_db"] for row in score_map("twin", twin.radio_map(scene), truth)}
    return {"map_rmse_db": scores["all"], "map_rmse_los_db": scores["LoS"], "map_rmse_nlos_db": scores["NLoS"],
            "location_errors_m": location_errors_m(scene, Known.of(twin.devices))}
