"""Policy, plan and re-planning in missions that are not what was thought: `pays`.

In the statistical truth. `volumes`: each device's data evenly from 0 to twice what the mission
says. `positions`: every device is 20 to 40 m from where the UAVs, and their map, have it. `loss`:
one UAV is lost in the first half of the flight. `everything`: all three. A policy is trained in
other draws of the same kind than those that it is judged in.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from marl.disturbances import Disturbance, DisturbedEnvironment
from marl.flights import AgentPolicy, HeuristicPolicy, Policy, fly
from marl.learner import Learner
from marl.mission import Known, Mission, make_mission
from marl.planner import PlanPolicy, plan
from marl.randomness import stream
from marl.replanning import ReplanPolicy
from marl.settings import PRESETS, LearnerSettings
from marl.trainer import Trainer
from radiotwin import Scene, segmented_truth
from radiotwin.progress import progress
from studies import tables
from studies.runner import Study

OFF_M = (20.0, 40.0)  # of a device from where it is thought to be
SILENT_DB = -1000.0  # SNR between UAVs without a link
BLOCK = 100  # episodes in one map
DISTURBANCES = {"nominal": Disturbance(), "volumes": Disturbance(volume_spread=1.0),
                "positions": Disturbance(), "loss": Disturbance(loss=1.0),
                "everything": Disturbance(1.0, 1.0)}
SCENARIOS = {"nominal": "as thought", "volumes": "data 0–2 × nominal",
             "positions": "devices 20–40 m off", "loss": "a UAV is lost",
             "everything": "all three"}
METHODS = {"plan": "open-loop plan", "replan": "re-planning, link",
           "replan-no-link": "re-planning, no link", "policy": "policy, link",
           "policy-no-link": "policy, no link", "taught": "policy taught by the plan, link",
           "taught-no-link": "the same, no link", "greedy": "greedy"}


def pays_cases(seed: int) -> dict[str, dict]:
    """Return every method in every scenario."""
    learner = PRESETS["fast"].model_copy(update={"epsilon_slots": 87_500}).model_dump(mode="json")
    trained, planner = {"episodes": 4000, "learner": learner}, {"planner_iterations": 60_000}
    needs: dict[str, dict[str, Any]] = {
        "plan": planner, "policy": trained, "taught": trained | planner, "greedy": {},
        "replan": planner | {"replan_every": 10, "replan_iterations": 1500}}
    return {f"{scene}-{scenario}-{method}": {
        "truth": "segmented", "scene": scene, "scenario": scenario, "flights": 64, "truths": 8,
        "method": method} | needs[method.removesuffix("-no-link")]
        for scene in ("rbm", "rdm") for scenario in SCENARIOS for method in METHODS}


@dataclass(frozen=True, eq=False)
class World:
    """Missions that may turn out to be the real one, and what happens in them.

    Attributes:
        believed: the mission as it is thought to be before take-off.
        real: those that it may be.
        disturbance: what happens.
    """

    believed: Mission
    real: list[Mission]
    disturbance: Disturbance

    def fly(self, policy: Policy, flights: int, rng: np.random.Generator) -> np.ndarray:
        """Return the share of the data, `(flights,)`, as many flights in each real mission."""
        each = -(-flights // len(self.real))
        return np.concatenate([
            fly(DisturbedEnvironment(mission, each, rng, self.disturbance), policy).ratio(mission)
            for mission in self.real])[:flights]


def fly_disturbed(seed: int, settings: dict) -> dict:
    """Prepare a method and fly it in one scenario.

    Args:
        seed: of everything random.
        settings: `scene`, `scenario`, `method`, `flights`, `truths` (draws of the devices'
            positions), and what the method needs: see `pays_cases`.

    Returns:
        `curve`: of a policy, its checks during training; `ratios`: of every flight.
    """
    method = settings["method"].removesuffix("-no-link")
    linked, flights = method == settings["method"], settings["flights"]
    scene = Scene.load(tables.scene_folder(settings["scene"]))
    drawn = scene, settings["scenario"], linked, settings["truths"]
    world, learned = (make_world(*drawn, stream(seed, purpose, 1))
                      for purpose in ("truth evaluation", "learning"))
    curve: dict[str, list] = {}
    policy: Policy
    actions = None
    if method in ("plan", "taught"):
        actions = plan(world.believed, settings["planner_iterations"], seed).actions
    if method == "plan":
        policy = PlanPolicy(actions)
    elif method == "replan":
        policy = ReplanPolicy(world.believed, linked, settings["replan_every"],
                              settings["replan_iterations"], settings["planner_iterations"], seed,
                              stream(seed, "planning", 1))
    elif method == "greedy":
        policy = HeuristicPolicy(method, stream(seed, "decisions"))
    else:
        learner = LearnerSettings.model_validate(settings["learner"])
        policy, curve = train(learned, settings["episodes"], learner, flights, seed, actions)
    ratios = world.fly(policy, flights, stream(seed, "truth evaluation"))
    return {"curve": curve, "truth_ratio": ratios.mean(), "truth_ratio_std": ratios.std(),
            "ratios": ratios.tolist()}


def make_world(scene: Scene, scenario: str, linked: bool, truths: int,
               rng: np.random.Generator) -> World:
    """Return the missions of a scenario.

    Args:
        scene: the city, in the statistical truth.
        scenario: a key of `DISTURBANCES`.
        linked: whether UAVs see each other.
        truths: draws of the devices' positions, where these are not what is thought.
        rng: of these.
    """
    known = Known.truth(scene)

    def mission(drawn: Scene) -> Mission:
        made = make_mission(drawn, segmented_truth(drawn), known)
        return made if linked else made._replace(uav_link_db=np.array([SILENT_DB, 0.0]))

    believed = mission(scene)
    real = [believed]
    if scenario in ("positions", "everything"):
        real = [mission(displaced(scene, rng)) for _ in range(truths)]
    return World(believed, real, DISTURBANCES[scenario])


def displaced(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with every device 20 to 40 m away, on free ground inside the extent."""
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    devices = []
    for device in scene.config.devices:
        while True:
            angle, off_m = rng.uniform(0, 2 * np.pi), rng.uniform(*OFF_M)
            x_m, y_m = device.x_m + off_m * np.cos(angle), device.y_m + off_m * np.sin(angle)
            if x_min <= x_m <= x_max and y_min <= y_m <= y_max and \
                    not scene.city.inside(np.array([[x_m, y_m, device.z_m]]))[0]:
                break
        devices.append(device.model_copy(update={"x_m": float(x_m), "y_m": float(y_m)}))
    return replace(scene, config=scene.config.model_copy(update={"devices": devices}))


class DisturbedTrainer(Trainer):
    """A trainer that flies with a disturbance."""

    disturbance = Disturbance()

    def _environment(self, count: int) -> DisturbedEnvironment:
        return DisturbedEnvironment(self.mission, count, self._rng, self.disturbance)


def train(world: World, episodes: int, settings: LearnerSettings, flights: int, seed: int,
          teacher: np.ndarray | None = None) -> tuple[AgentPolicy, dict[str, list]]:
    """Train QMIX over the missions of a world, one after the other, a block each.

    Args:
        world: what is trained in, and checked in.
        episodes: of training.
        settings: of the learner.
        flights: of a check.
        seed: of everything random.
        teacher: `(slots, uavs)` actions of a plan that some flights follow (`Trainer.enter`).

    Returns:
        The policy that collected most at the checks after the blocks, and these.
    """
    trainer = DisturbedTrainer(settings, world.believed, episodes, seed)
    trainer.disturbance = world.disturbance
    best, highest = Learner(settings, world.believed, seed).agent, -1.0
    curve: dict[str, list] = {"episodes": [], "ratio": [], "train_ratio": []}
    with progress("training", total=episodes) as advance:
        while trainer.episodes < episodes:
            trainer.enter(world.real[len(curve["ratio"]) % len(world.real)], teacher)
            block = min(BLOCK, episodes - trainer.episodes)
            record = trainer.train(block)
            policy = AgentPolicy(trainer.learner.agent)
            ratio = float(world.fly(policy, flights, stream(seed, "choice")).mean())
            if ratio > highest:
                highest = ratio
                with torch.no_grad():
                    best.load_state_dict(trainer.learner.agent.state_dict())
            for name, value in (("episodes", trainer.episodes), ("ratio", ratio),
                                ("train_ratio", record["train_ratio"])):
                curve[name].append(value)
            advance(block)
    return AgentPolicy(best), curve


def _scenarios(runs: dict[str, pd.DataFrame]) -> dict[str, dict[str, np.ndarray]]:
    """Return label of a scenario -> label of a method -> share of the data of all flights."""
    names = [name for name in METHODS if any(run.endswith(f"-{name}") for run in runs)]
    return {label: {METHODS[name]: np.concatenate([*runs[f"{scenario}-{name}"]["ratios"]])
                    if f"{scenario}-{name}" in runs else np.array([]) for name in names}
            for scenario, label in SCENARIOS.items()
            if any(run.startswith(scenario) for run in runs)}


def pays_table(rows: pd.DataFrame) -> str:
    """Return scenarios against methods."""
    parts = []
    for _, scene, runs in tables.worlds(rows):
        lines, cells = [], {}
        for label, cells in _scenarios(runs).items():
            means = [cell.mean() if len(cell) else -1 for cell in cells.values()]
            texts = [tables.with_sd(cell) for cell in cells.values()]
            texts[int(np.argmax(means))] = f"**{texts[int(np.argmax(means))]}**"
            lines.append([label, *texts])
        seeds = ", ".join(map(str, sorted({len(group) for group in runs.values()})))
        parts.append(f"**{scene}, statistical truth** (64 flights a seed; seeds: {seeds})\n\n"
                     + tables.markdown(["", *cells], lines))
    return "\n\n".join(parts) + "\n\nMean ± standard deviation over flights."


def pays_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw scenarios, a bar for each method; lines are the standard error of the mean."""
    found = list(tables.worlds(rows))
    figure, panels = tables.make_panels(len(found), 1, 3.8)
    for axes, (_, scene, runs) in zip(panels, found):
        scenarios = _scenarios(runs)
        cells = {name: [each[name] for each in scenarios.values()]
                 for name in next(iter(scenarios.values()))}
        errors = {name: [each.std() / np.sqrt(len(each)) if len(each) else 0 for each in values]
                  for name, values in cells.items()}
        tables.draw_bars(axes, cells, errors, list(scenarios), title=f"{scene}, statistical truth",
                         xlabel="what is not as it was thought")
    return {"pays": tables.with_legend(figure, panels, 3)}


STUDIES = {"pays": Study("Where does learning pay?", fly_disturbed, pays_cases, pays_table,
                         pays_figures)}
