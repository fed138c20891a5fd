"""Settings of a federation, checked when they are given; each becomes an option."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from marl.settings import LearnerSettings
from radiotwin.errors import BadInput


class FederationSettings(BaseModel):
    """Settings of a federation over Flower."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    strategy: Literal["fedavg", "fedavgm", "fedprox"] = Field(
        "fedavg", description="Flower's strategy: mean weighted by episodes, the same with "
        "momentum, or with a proximal term in the replicas' loss")
    server_momentum: float = Field(0.5, ge=0, lt=1, description="momentum of fedavgm")
    proximal_mu: float = Field(0.01, gt=0, le=1e6, description="weight of fedprox's term")
    min_clients: int = Field(
        2, ge=1, le=10_000, description="parties that a round needs; with fewer the mean stays "
        "as it was")
    round_timeout_s: float = Field(
        600.0, ge=1, le=10**6, description="seconds that a round waits for parties that do not "
        "answer")


def check_federation(federation: FederationSettings, learner: LearnerSettings,
                     clients: int) -> None:
    """Refuse settings that are allowed one by one, but not together.

    Raises:
        BadInput: momentum over the optimiser's squares, or more parties needed than there are.
    """
    if federation.strategy == "fedavgm" and learner.federate_all:
        raise BadInput("strategy fedavgm: momentum can make the optimiser's mean squares negative; "
                       "give --federate-all false with it, so that only weights are averaged")
    if federation.min_clients > clients:
        raise BadInput(f"--min-clients {federation.min_clients}: there are {clients} parties")


class EngineSettings(BaseModel):
    """Settings of the means, and data of the parties."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    federation: Literal["in-process", "flower", "flower-processes", "flower-app"] = Field(
        "in-process", description="what averages replicas of fedqmix: this process; Flower in its "
        "simulation engine; Flower's SuperLink and SuperNodes as processes of this machine, with "
        "TLS and keys; flower-app only writes the Flower App, for parties on several machines")
    party_scenes: str = Field(
        "", max_length=10_000, description="scene folders of the parties, separated by commas; "
        "without: --scene once for each of its UAVs")
    party_measurements: str = Field(
        "", max_length=10_000, description="measurements of the parties, separated by commas, to "
        "learn their twins from; without: real flights are simulated in each scene's truth")
