"""Settings of learning, with a line of help each, and the presets."""

from pydantic import BaseModel, ConfigDict, Field


class LearnerSettings(BaseModel):
    """How a policy is learned. The defaults are the preset `fast`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mix: bool = Field(True, description="learn a joint value with the monotonic mixer (QMIX); false: independently (IQL)")
    hidden: int = Field(64, ge=1, le=4096, description="width of the agents' recurrent layer")
    mixing_width: int = Field(32, ge=1, le=4096, description="width of the mixing layer")
    learning_rate: float = Field(2e-3, gt=0, le=1, description="of Adam, at the start")
    last_learning_rate: float = Field(2e-4, ge=0, le=1, description="of Adam, at the end; linear in between")
    discount: float = Field(0.99, ge=0, le=1, description="worth of the next slot's value, gamma")
    td_lambda: float = Field(0.8, ge=0, le=1, description="TD(lambda): 0 looks one slot ahead, 1 to the flight's end")
    double_q: bool = Field(True, description="choose the target's action with the present network")
    batch: int = Field(32, ge=1, le=10_000, description="flights in an update")
    replay: int = Field(2000, ge=1, le=1_000_000, description="flights that are remembered")
    target_every: int = Field(50, ge=1, description="updates between copies to the target network")
    episodes_per_update: int = Field(4, ge=1, le=10_000, description="flights between updates")
    parallel: int = Field(20, ge=1, le=10_000, description="flights flown side by side")
    first_epsilon: float = Field(1.0, ge=0, le=1, description="chance of a random action at the start")
    last_epsilon: float = Field(0.05, ge=0, le=1, description="chance of a random action at the end")
    epsilon_slots: int = Field(175_000, ge=0, description="slots over which it falls linearly")
    federate_every: int = Field(100, ge=1, description="episodes of a replica between averages (FedQMIX)")
    federate_all: bool = Field(True, description="average target networks and the optimiser's moments, too (FedQMIX)")
    reward_scale: float = Field(1000.0, gt=0, description="data units that make a reward of 1")


PRESETS = {
    "fast": LearnerSettings(),
    # Chen et al. 2023 and the code published with it.
    "paper": LearnerSettings(learning_rate=5e-4, last_learning_rate=5e-4, td_lambda=0.0, double_q=False, replay=5000,
                             target_every=200, episodes_per_update=1, parallel=10, epsilon_slots=50_000, federate_every=50, federate_all=False),
}
