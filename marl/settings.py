"""Settings of a run and of learning, with a line of help each, checked when they are given."""

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from radiotwin.errors import BadInput
from radiotwin.published import published_scene


class LearnerSettings(BaseModel):
    """How a policy is learned. The defaults are the preset `fast`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mix: bool = Field(True, description="learn a joint value with the monotonic mixer (QMIX), or each UAV alone (IQL)")
    hidden: int = Field(64, ge=1, le=4096, description="width of the agents' recurrent layer")
    mixing_width: int = Field(32, ge=1, le=4096, description="width of the mixing layer")
    learning_rate: float = Field(2e-3, gt=0, le=1, description="of Adam, at the start")
    last_learning_rate: float = Field(2e-4, ge=0, le=1, description="of Adam, at the end; linear in between")
    discount: float = Field(0.99, ge=0, le=1, description="worth of the next slot's value, gamma")
    td_lambda: float = Field(0.8, ge=0, le=1, description="TD(lambda): 0 looks one slot ahead, 1 to the flight's end")
    double_q: bool = Field(True, description="choose the target's action with the present network")
    batch: int = Field(32, ge=1, le=10_000, description="flights in an update")
    replay: int = Field(2000, ge=1, le=1_000_000, description="flights that are remembered")
    fly_again: bool = Field(False, description="in a new map, fly what is remembered again, action by action")
    target_every: int = Field(50, ge=1, description="updates between copies to the target network")
    episodes_per_update: int = Field(4, ge=1, le=10_000, description="flights between updates")
    parallel: int = Field(20, ge=1, le=10_000, description="flights flown side by side")
    first_epsilon: float = Field(1.0, ge=0, le=1, description="share of the slots that a UAV explores, at the start")
    last_epsilon: float = Field(0.05, ge=0, le=1, description="the same at the end")
    excursion_slots: float = Field(4.0, ge=1, le=1000, description="mean slots that exploration keeps a random action")
    epsilon_slots: int = Field(175_000, ge=0, description="slots over which it falls linearly")
    restart_epsilon: float = Field(0.0, ge=0, le=1, description="share that a new map starts with, at least")
    restart_slots: int = Field(25_000, ge=1, description="slots over which it falls to 0 linearly")
    federate_every: int = Field(100, ge=1, description="episodes of a replica between averages (fedqmix), and between "
                                "looks at the policy")
    selection_flights: int = Field(64, ge=0, le=100_000, description="flights of a look at the policy, in the map that "
                                   "it is trained in; the best of a round flies. 0: the last one flies")
    federate_all: bool = Field(True, description="average target networks and the optimiser's moments, too (fedqmix)")
    reward_scale: float = Field(1000.0, gt=0, description="data units that make a reward of 1")


PRESETS = {
    "fast": LearnerSettings(),
    # Chen et al. 2023 and the code published with it; ten flights side by side are ours, and so is the reward's scale.
    "paper": LearnerSettings(learning_rate=5e-4, last_learning_rate=5e-4, td_lambda=0.0, double_q=False, replay=5000,
                             target_every=200, episodes_per_update=1, parallel=10, excursion_slots=1.0,
                             epsilon_slots=50_000, federate_every=50, selection_flights=0, federate_all=False),
}
RUNS: dict[str, dict[str, Any]] = {
    "fast": {},
    "paper": {"real_episodes": 30, "episodes": 1000, "first_flight": "random", "measure": "policy",
              "twin_shadowing": "slot"},
}
"""What the presets change in a run."""
LEARNERS = ("fedqmix", "qmix", "iql")


class RunSettings(BaseModel):
    """What is run."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scene: Path = Field(published_scene("rbm"), description="scene folder")
    truth: Literal["traced", "segmented"] = Field(
        "traced", description="what real flights meet: SCENE/truth.nc, or the statistical truth of the paper")
    twin: Literal["nn", "log-distance", "kriging", "raytrace", "truth"] = Field(
        "nn", description="model of the twin that is trained in; raytrace: paths over the 3D map, minutes a round; "
        "truth: a perfect twin, no flight is needed")
    twin_shadowing: Literal["fitted", "slot"] = Field(
        "fitted", description="how long a simulated flight is off the twin's map by the same: as its errors say, or "
        "for a slot; preset paper: slot")
    algorithm: Literal["fedqmix", "qmix", "iql", "greedy", "planner", "random"] = Field(
        "fedqmix", description="what decides where the UAVs fly")
    preset: Literal["fast", "paper"] = Field("fast", description="settings of learning")
    real_episodes: int = Field(10, ge=1, le=10_000,
                               description="rounds, of one real flight each to learn the twin from; preset paper: 30")
    episodes: int = Field(800, ge=1, le=10_000_000,
                          description="episodes of training of each replica in a round; preset paper: 1000")
    guide: Literal["none", "planner"] = Field(
        "none", description="planner: some of the flights that a learner learns from follow a plan")
    first_flight: Literal["waypoints", "random"] = Field(
        "waypoints", description="what flies the first real episode, when nothing is known: from one random cell to "
        "the next, or any feasible action in every slot; preset paper: random")
    measure: Literal["policy", "planner", "waypoints"] = Field(
        "waypoints", description="what flies the other real episodes that a twin is learnt from: the present policy, "
        "a plan made in the twin, or from one random cell to the next; preset paper: policy")
    assignment: Literal["matching", "max-rate"] = Field(
        "matching", description="matching: strongest remaining pair first; max-rate: strictly each UAV's best device")
    privileged: bool = Field(False, description="agents see the true positions of the unknown devices")
    compare: bool = Field(True, description="afterwards train in the other twins and in the truth, too, for the table")
    planner_iterations: int = Field(60_000, ge=1, le=10**9, description="plans that the planner tries")
    noise_db: float = Field(1.0, ge=0, le=50, description="standard deviation of the receivers' measurement error; a "
                            "truth with shadowing has no other")
    flights: int = Field(64, ge=1, le=100_000, description="flights of an evaluation")
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where networks are trained; auto: on a GPU if there is one. Only cpu repeats to the bit")
    seed: int = Field(0, ge=0, le=2**31, description="of everything random")


def check_together(run: RunSettings, learner: LearnerSettings) -> None:
    """Refuse settings that are allowed each, and not together.

    Raises:
        BadInput: a memory that is too small, or a guide for what does not learn.
    """
    if learner.batch > learner.replay or learner.parallel > learner.replay:
        raise BadInput(f"replay {learner.replay}: it must hold a batch ({learner.batch} flights) and what is flown "
                       f"side by side ({learner.parallel}); raise it, or lower batch or parallel")
    if run.guide != "none" and run.algorithm not in LEARNERS:
        raise BadInput(f"guide {run.guide}: {run.algorithm} does not learn, so nothing can be guided; it is for "
                       f"algorithm {', '.join(LEARNERS)} only")
