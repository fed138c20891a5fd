"""Settings of a run and of learning, checked when they are given; each becomes an option.

Random numbers: an independent stream for every purpose, all from one seed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from marl.registry import LEARNERS, learner_class
from radiotwin.errors import BadInput
from radiotwin.scene.folder import published_scene

PURPOSES = ("learning", "real flight", "decisions", "choice", "twin evaluation",
            "truth evaluation", "planning")


class LearnerSettings(BaseModel):
    """Settings of learning. The defaults are the preset `fast`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    hidden: int = Field(64, ge=1, le=4096, description="width of the agents' recurrent layer")
    mixing_width: int = Field(32, ge=1, le=4096, description="width of the mixing layer")
    learning_rate: float = Field(2e-3, gt=0, le=1, description="of Adam, at the start")
    last_learning_rate: float = Field(
        2e-4, ge=0, le=1, description="of Adam, at the end; linear in between")
    discount: float = Field(0.99, ge=0, le=1, description="discount per slot, gamma")
    td_lambda: float = Field(
        0.8, ge=0, le=1, description="TD(lambda): 0 looks one slot ahead, 1 to the flight's end")
    double_q: bool = Field(
        True, description="choose the target's action with the online network")
    batch: int = Field(32, ge=1, le=10_000, description="flights in an update")
    replay: int = Field(2000, ge=1, le=1_000_000, description="flights in the replay memory")
    target_every: int = Field(
        50, ge=1, le=10**9, description="updates between copies to the target network")
    episodes_per_update: int = Field(4, ge=1, le=10_000, description="flights between updates")
    parallel: int = Field(20, ge=1, le=10_000, description="flights flown side by side")
    first_epsilon: float = Field(
        1.0, ge=0, le=1, description="share of the slots that a UAV explores, at the start")
    last_epsilon: float = Field(0.05, ge=0, le=1, description="the same at the end")
    excursion_slots: float = Field(
        4.0, ge=1, le=1000, description="mean slots that exploration keeps a random action")
    epsilon_slots: int = Field(
        175_000, ge=0, le=10**12, description="slots over which the share falls linearly")
    federate_every: int = Field(
        100, ge=1, le=10**9, description="episodes of a replica between averages (fedqmix), and "
        "between evaluations of the policy")
    selection_flights: int = Field(
        64, ge=0, le=100_000, description="flights of such an evaluation, in the map that is "
        "trained in; the best policy of a round flies. 0: the last one flies")
    federate_all: bool = Field(
        True, description="average target networks and the optimiser's moments, too (fedqmix)")
    reward_scale: float = Field(
        1000.0, ge=1e-6, le=1e12, description="data units that make a reward of 1")


PRESETS = {
    "fast": LearnerSettings(),
    # Chen et al. 2023 and the code published with it; ten flights side by side and the reward's
    # scale are ours.
    "paper": LearnerSettings(
        learning_rate=5e-4, last_learning_rate=5e-4, td_lambda=0.0, double_q=False, replay=5000,
        target_every=200, episodes_per_update=1, parallel=10, excursion_slots=1.0,
        epsilon_slots=50_000, federate_every=50, selection_flights=0, federate_all=False),
}
RUNS: dict[str, dict[str, Any]] = {
    "fast": {},
    "paper": {"real_episodes": 30, "episodes": 1000, "first_flight": "random",
              "measure": "policy", "twin_shadowing": "slot"},
}
"""Settings of the run that a preset changes."""


@dataclass(frozen=True)
class Choices:
    """Annotation of a text setting whose allowed values are listed when they are needed."""

    values: Callable[[], list[str]]


def _registered(name: str) -> str:
    if name not in LEARNERS:
        *others, last = (repr(each) for each in LEARNERS)
        raise PydanticCustomError("literal_error", f"Input should be {', '.join(others)} or {last}")
    return name


class RunSettings(BaseModel):
    """Settings of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scene: Path = Field(published_scene("rbm"), description="scene folder")
    truth: Literal["traced", "segmented"] = Field(
        "traced", description="map of the real flights: SCENE/truth.nc, or the paper's "
        "statistical truth")
    twin: Literal["nn", "log-distance", "kriging", "raytrace", "path-kriging", "truth"] = Field(
        "nn", description="model of the twin that is trained in; raytrace: paths over the 3D map, "
        "minutes a round; path-kriging: the same over a map that may be wrong; truth: a perfect "
        "twin, in which training flights count as real ones")
    twin_shadowing: Literal["fitted", "slot"] = Field(
        "fitted", description="how long the twin's error lasts in a simulated flight: fitted to "
        "its residuals, or one slot; preset paper: slot")
    algorithm: Annotated[str, Choices(lambda: list(LEARNERS)), AfterValidator(_registered)] = Field(
        "fedqmix", description="learner, planner or heuristic that flies")
    preset: Literal["fast", "paper"] = Field("fast", description="settings of learning")
    real_episodes: int = Field(
        10, ge=1, le=10_000, description="rounds, each with one real flight of all UAVs to learn "
        "the twin from; preset paper: 30")
    episodes: int = Field(
        800, ge=1, le=10_000_000, description="training episodes of each replica in a round; "
        "preset paper: 1000")
    guide: Literal["none", "planner"] = Field(
        "none", description="planner: some of the training flights follow a plan")
    first_flight: Literal["waypoints", "random"] = Field(
        "waypoints", description="the first real flight, when nothing is known: from one random "
        "cell to the next, or a random feasible action in every slot; preset paper: random")
    measure: Literal["policy", "waypoints"] = Field(
        "waypoints", description="the other real flights, which the twin is learned from: the "
        "current policy, or from one random cell to the next; preset paper: policy")
    assignment: Literal["matching", "max-rate"] = Field(
        "matching", description="matching: strongest remaining pair first; max-rate: strictly "
        "each UAV's best device")
    privileged: bool = Field(
        False, description="agents see the true positions of the unknown devices")
    compare: bool = Field(
        True, description="afterwards train in the other twins and in the truth, too, for the "
        "table")
    planner_iterations: int = Field(
        60_000, ge=1, le=10**9, description="plans that the planner tries")
    noise_db: float = Field(
        1.0, ge=0, le=50, description="standard deviation of the receivers' measurement error; "
        "not used in a truth with shadowing")
    flights: int = Field(64, ge=1, le=100_000, description="flights of an evaluation")
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where networks are trained; auto: on a GPU if there is one. Only "
        "cpu repeats to the bit")
    seed: int = Field(0, ge=0, le=2**31, description="of all random numbers")


def check_together(run: RunSettings, learner: LearnerSettings) -> None:
    """Refuse settings that are allowed one by one, but not together.

    Raises:
        BadInput: a replay memory that is too small, or a guide for something that does not learn.
    """
    if learner.batch > learner.replay or learner.parallel > learner.replay:
        raise BadInput(
            f"replay {learner.replay}: it must hold a batch ({learner.batch} flights) and what is "
            f"flown side by side ({learner.parallel}); raise it, or lower batch or parallel")
    if run.guide != "none" and not learner_class(run.algorithm).learns:
        able = ", ".join(name for name in LEARNERS if learner_class(name).learns)
        raise BadInput(f"guide {run.guide}: {run.algorithm} does not learn, so nothing can be "
                       f"guided; it is for algorithm {able} only")


def stream(seed: int, purpose: str, number: int = 0) -> np.random.Generator:
    """Return the generator of a purpose.

    Args:
        seed: of the run.
        purpose: one of `PURPOSES`.
        number: of the replica, flight or round, where there are several.
    """
    # Counted from 1, because numpy takes [1, 2, 0] for [1, 2].
    return np.random.default_rng([seed, PURPOSES.index(purpose) + 1, number + 1])
