"""Policy, plan and replanning in missions that differ from the assumptions: `pays`.

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

from marl.flights import Policy, fly
from marl.heuristics import HeuristicPolicy
from marl.mission import Known, Mission, make_mission
from marl.planner import PlanPolicy, plan
from marl.qmix import AgentPolicy, QNetworks, Trainer
from marl.replanning import ReplanPolicy
from marl.settings import LearnerSettings, stream
from radiotwin import Scene, segmented_truth
from radiotwin.runtime.console import progress
from studies import tables
from studies.disturbed import Disturbance, DisturbedEnvironment
from studies.runner import Study
from studies.twins import LONG

OFF_M = (20.0, 40.0)  # of a device from where it is thought to be
SILENT_DB = -1000.0  # SNR between UAVs without a link
BLOCK = 100  # episodes in one map
SCENARIOS = {"nominal": ("as thought", Disturbance()),
             "volumes": ("data 0–2 × nominal", Disturbance(volume_spread=1.0)),
             "positions": ("devices 20–40 m off", Disturbance()),
             "loss": ("a UAV is lost", Disturbance(loss=1.0)),
             "everything": ("all three", Disturbance(1.0, 1.0))}
METHODS = {"plan": "open-loop plan", "replan": "re-planning, link",
           "replan-no-link": "re-planning, no link", "policy": "policy, link",
           "policy-no-link": "policy, no link", "greedy": "greedy"}


def pays_cases(seed: int) -> dict[str, dict]:
    """Return every method in every scenario."""
    planner = {"planner_iterations": 60_000}
    needs: dict[str, dict[str, Any]] = {
        "plan": planner, "policy": LONG, "greedy": {},
        "replan": planner | {"replan_every": 10, "replan_iterations": 1500}}
    return {f"{scene}-{scenario}-{method}": {
        "truth": "segmented", "scene": scene, "scenario": scenario, "flights": 64, "truths": 8,
        "method": method} | needs[method.removesuffix("-no-link")]
        for scene in ("rbm", "rdm") for scenario in SCENARIOS for method in METHODS}


@dataclass(frozen=True, eq=False)
class World:
    """A mission as it is thought to be, those that it may be, and what happens in them."""

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
    """Prepare a method and fly it in one scenario, with settings as in `pays_cases`.

    Returns:
        `curve`: of a policy, its checks during training; `ratios`: of every flight.
    """
    method = settings["method"].removesuffix("-no-link")
    linked, flights = method == settings["method"], settings["flights"]
    scene = Scene.load(tables.scene_folder(settings["scene"]))
    world, learned = (make_world(scene, settings["scenario"], linked, settings["truths"],
                                 stream(seed, purpose, 1))
                      for purpose in ("truth evaluation", "learning"))
    curve: dict[str, list] = {}
    policy: Policy
    if method == "replan":
        policy = ReplanPolicy(world.believed, None, linked, settings["replan_every"],
                              settings["replan_iterations"], settings["planner_iterations"], seed,
                              stream(seed, "planning", 1))
    elif method == "greedy":
        policy = HeuristicPolicy(method, stream(seed, "decisions"))
    elif method == "plan":
        policy = PlanPolicy(plan(world.believed, settings["planner_iterations"], seed).actions)
    else:
        policy, curve = train(learned, settings["episodes"], LearnerSettings.model_validate(
            settings["learner"]), flights, seed)
    ratios = world.fly(policy, flights, stream(seed, "truth evaluation"))
    return {"curve": curve, "truth_ratio": ratios.mean(), "truth_ratio_std": ratios.std(),
            "ratios": ratios.tolist()}


def make_world(scene: Scene, scenario: str, linked: bool, truths: int,
               rng: np.random.Generator) -> World:
    """Return the missions of a scenario, with or without a link between UAVs.

    `truths` is how often positions are drawn, where these are not what is thought.
    """
    known = Known.truth(scene)

    def mission(drawn: Scene) -> Mission:
        made = make_mission(drawn, segmented_truth(drawn), known)
        return made if linked else made._replace(uav_link_db=np.array([SILENT_DB, 0.0]))

    believed = mission(scene)
    real = [believed]
    if scenario in ("positions", "everything"):
        real = [mission(displaced(scene, rng)) for _ in range(truths)]
    return World(believed, real, SCENARIOS[scenario][1])


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


def train(world: World, episodes: int, settings: LearnerSettings, flights: int,
          seed: int) -> tuple[AgentPolicy, dict[str, list]]:
    """Train QMIX over the missions of a world in turn, a block of episodes each.

    Returns:
        the policy that collected most in the checks after the blocks; the checks.
    """
    trainer = DisturbedTrainer(QNetworks, settings, world.believed, episodes, seed)
    trainer.disturbance, agent = world.disturbance, trainer.networks.agent
    best = QNetworks(settings, world.believed, seed).agent
    checks: list[dict[str, float]] = []
    with progress("training", total=episodes) as advance:
        while trainer.episodes < episodes:
            trainer.enter(world.real[len(checks) % len(world.real)])
            record = trainer.train(min(BLOCK, episodes - trainer.episodes))
            ratio = float(world.fly(AgentPolicy(agent), flights, stream(seed, "choice")).mean())
            if ratio > max((check["ratio"] for check in checks), default=-1.0):
                with torch.no_grad():
                    best.load_state_dict(agent.state_dict())
            checks.append({"episodes": trainer.episodes, "ratio": ratio,
                           "train_ratio": record["train_ratio"]})
            advance(BLOCK)
    return AgentPolicy(best), pd.DataFrame(checks).to_dict("list")


def _ratios(runs: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Return shares of the data of all flights: scenarios by methods that have been flown."""
    cells = {METHODS[method]: {label: np.concatenate([*runs[f"{scenario}-{method}"]["ratios"]])
                               for scenario, (label, _) in SCENARIOS.items()
                               if f"{scenario}-{method}" in runs} for method in METHODS}
    order = [label for label, _ in SCENARIOS.values()]
    frame = pd.DataFrame({name: cell for name, cell in cells.items() if cell}, dtype=object)
    return frame.reindex([label for label in order if label in frame.index]).map(
        lambda cell: cell if isinstance(cell, np.ndarray) else np.array([]))


def pays_table(rows: pd.DataFrame) -> str:
    """Return scenarios against methods."""
    parts = []
    for title, _, runs in tables.worlds(rows):
        ratios, lines = _ratios(runs), []
        for label, cells in ratios.iterrows():
            texts = [tables.with_sd(cell) for cell in cells]
            best = int(np.argmax([cell.mean() if len(cell) else -1 for cell in cells]))
            texts[best] = f"**{texts[best]}**"
            lines.append([label, *texts])
        seeds = ", ".join(map(str, sorted({len(group) for group in runs.values()})))
        parts.append(tables.markdown(["", *ratios], lines, title,
                                     f" (64 flights a seed; seeds: {seeds})"))
    return "\n\n".join(parts) + "\n\nMean ± standard deviation over flights."


def pays_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw scenarios, a bar for each method; lines are the standard error of the mean."""
    found = list(tables.worlds(rows))
    figure, panels = tables.make_panels(len(found), 1, 3.8)
    for axes, (title, _, runs) in zip(panels, found):
        ratios = _ratios(runs)
        errors = ratios.map(lambda cell: cell.std() / np.sqrt(len(cell)) if len(cell) else 0)
        tables.draw_bars(axes, ratios.to_dict("list"), errors.to_dict("list"), list(ratios.index),
                         title=title, xlabel="what is not as it was thought")
    return {"pays": tables.with_legend(figure, panels, 3)}


STUDIES = {"pays": Study("Where does learning pay?", fly_disturbed, pays_cases, pays_table,
                         pays_figures)}
