"""Where learning pays: policy, plan and re-planning in missions that are not what was thought before take-off.

In the statistical truth. `volumes`: each device's data evenly from 0 to twice what the mission says. `positions`: every
device stands 20 to 40 m from where the UAVs, and their map, have it. `loss`: one UAV is lost in the first half of the
flight. `everything`: all three. A policy is trained in other draws of the same kind than those that it is judged in.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from marl.disturbances import Disturbance, DisturbedEnvironment
from marl.experiments.learning import scene_folder
from marl.flights import Policy, fly
from marl.heuristics import HeuristicPolicy
from marl.mission import Known, Mission, make_mission
from marl.planner import PlanPolicy, plan
from marl.qmix import QNetworks
from marl.randomness import stream
from marl.replanning import ReplanPolicy
from marl.settings import LearnerSettings
from marl.training import AgentPolicy, Trainer
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.survey import segmented_truth

OFF_M = (20.0, 40.0)  # of a device from where it is thought
SILENT_DB = -1000.0  # SNR between UAVs without a link
BLOCK = 100  # episodes in one map
DISTURBANCES = {"nominal": Disturbance(), "volumes": Disturbance(volume_spread=1.0), "positions": Disturbance(),
                "loss": Disturbance(loss=1.0), "everything": Disturbance(1.0, 1.0)}


@dataclass(frozen=True, eq=False)
class World:
    """Missions that may turn out to be the real one, and what happens in them.

    Attributes:
        believed: the mission as it is thought before take-off.
        real: those that it may be.
        disturbance: what happens.
    """

    believed: Mission
    real: list[Mission]
    disturbance: Disturbance

    def fly(self, policy: Policy, flights: int, rng: np.random.Generator) -> np.ndarray:
        """(flights,) share of the data, as many flights in each of the real missions."""
        each = -(-flights // len(self.real))
        return np.concatenate([
            fly(DisturbedEnvironment(mission, each, rng, self.disturbance), policy).ratio(mission)
            for mission in self.real])[:flights]


def fly_disturbed(settings: dict, seed: int, folder: Path, keep: Callable[[], None]) -> dict:
    """Prepare a method and fly it in one scenario; see the module.

    Args:
        settings: `scene`, `scenario`, `method`, `flights`, `truths` (places of the devices that are drawn, where they
            are not what is thought), and of a policy `episodes`, `learner` (fields of `LearnerSettings`), of a plan and
            of a policy that one teaches `planner_iterations`, of re-planning `replan_every`, `replan_iterations`.
        seed: of everything random.
        folder, keep: not used; a run takes minutes.

    Returns:
        `curve`: of a policy, its looks; `ratios`: of every flight
    """
    linked = not settings["method"].endswith("-no-link")
    method = settings["method"].removesuffix("-no-link")
    scene = Scene.load(scene_folder(settings["scene"]))
    judged = make_world(scene, settings["scenario"], linked, settings["truths"], stream(seed, "truth evaluation", 1))
    curve: list[dict] = []
    rng = stream(seed, "decisions")
    policy: Policy
    if method in ("policy", "taught"):
        teacher = None if method == "policy" else plan(judged.believed, settings["planner_iterations"], seed).actions
        learned = make_world(scene, settings["scenario"], linked, settings["truths"], stream(seed, "learning", 1))
        policy, curve = train(learned, settings["episodes"], LearnerSettings.model_validate(settings["learner"]),
                              settings["flights"], seed, teacher)
    elif method == "plan":
        policy = PlanPolicy(plan(judged.believed, settings["planner_iterations"], seed).actions)
    elif method == "replan":
        policy = ReplanPolicy(judged.believed, linked, settings["replan_every"], settings["replan_iterations"],
                              settings["planner_iterations"], seed, stream(seed, "planning", 1))
    else:
        policy = HeuristicPolicy(method, rng)
    ratios = judged.fly(policy, settings["flights"], stream(seed, "truth evaluation"))
    return {"curve": curve, "truth_ratio": ratios.mean(), "truth_ratio_std": ratios.std(), "ratios": ratios}


def make_world(scene: Scene, scenario: str, linked: bool, truths: int, rng: np.random.Generator) -> World:
    """The missions of a scenario.

    Args:
        scene: the city, in the statistical truth.
        scenario: a key of `DISTURBANCES`.
        linked: whether UAVs see each other.
        truths: draws of the devices' places, where these are not what is thought.
        rng: of these.
    """
    known = Known.truth(scene)

    def mission(place: Scene) -> Mission:
        made = make_mission(place, segmented_truth(place), known)
        return made if linked else made._replace(uav_link_db=np.array([SILENT_DB, 0.0]))

    believed = mission(scene)
    real = [believed]
    if scenario in ("positions", "everything"):
        real = [mission(displaced(scene, rng)) for _ in range(truths)]
    return World(believed, real, DISTURBANCES[scenario])


def displaced(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with every device 20 to 40 m away in any direction, on free ground inside the extent."""
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    devices = []
    for device in scene.config.devices:
        while True:
            angle, off_m = rng.uniform(0, 2 * np.pi), rng.uniform(*OFF_M)
            place_m = np.array([device.x_m + off_m * np.cos(angle), device.y_m + off_m * np.sin(angle), device.z_m])
            if x_min <= place_m[0] <= x_max and y_min <= place_m[1] <= y_max and \
                    not scene.city.inside(place_m[None])[0]:
                break
        devices.append(device.model_copy(update={"x_m": float(place_m[0]), "y_m": float(place_m[1])}))
    return replace(scene, config=scene.config.model_copy(update={"devices": devices}))


class DisturbedTrainer(Trainer):
    """A trainer that flies with a disturbance."""

    disturbance = Disturbance()

    def _environment(self, count: int) -> DisturbedEnvironment:
        return DisturbedEnvironment(self.mission, count, self._rng, self.disturbance)


def train(world: World, episodes: int, settings: LearnerSettings, flights: int, seed: int,
          teacher: np.ndarray | None = None) -> tuple[AgentPolicy, list[dict]]:
    """QMIX over the missions of a world, one after the other, a block each.

    Args:
        world: what is trained in, and looked at.
        episodes: of training.
        settings: of the learner.
        flights: of a look.
        seed: of everything random.
        teacher: (T, U) actions of a plan that some flights follow (`Trainer.enter`).

    Returns:
        the policy that collected most at the looks after the blocks, and these
    """
    trainer = DisturbedTrainer(QNetworks, settings, world.believed, episodes, seed)
    trainer.disturbance = world.disturbance
    best = QNetworks(settings, world.believed, seed).agent
    highest = -1.0
    curve: list[dict] = []
    with progress("training", total=episodes) as advance:
        while trainer.episodes < episodes:
            trainer.enter(world.real[len(curve) % len(world.real)], teacher)
            block = min(BLOCK, episodes - trainer.episodes)
            record = trainer.train(block)
            present = AgentPolicy(trainer.networks.agent)
            ratio = float(world.fly(present, flights, stream(seed, "choice")).mean())
            if ratio > highest:
                highest = ratio
                with torch.no_grad():
                    best.load_state_dict(trainer.networks.agent.state_dict())
            curve.append({"episodes": trainer.episodes, "ratio": ratio, "train_ratio": record["train_ratio"]})
            advance(block)
    return AgentPolicy(best), curve
