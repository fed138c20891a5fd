"""Settings of a federation, checked when they are given, and the Flower App that carries them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marl.settings import LearnerSettings, RunSettings, check_together
from radiotwin import __version__
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_file

OWN = ("scene", "truth", "device")  # of `RunSettings`: each party has its own
_Settings = TypeVar("_Settings", bound=BaseModel)


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


@dataclass(frozen=True)
class Shared:
    """Settings that the coordinator decides.

    Attributes:
        run: what is in `OWN` is left at its default.
        learner: settings of learning.
        federation: how means are made.
        clients: number of parties that the first round waits for.
        uavs: in each party's scene.
        devices: in each party's scene.
    """

    run: RunSettings
    learner: LearnerSettings
    federation: FederationSettings
    clients: int
    uavs: int
    devices: int

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Shared":
        """Return the settings of a Flower run, which come from somebody else.

        Args:
            config: `Context.run_config`: keys such as `run.episodes`.

        Raises:
            BadInput: names what is not allowed.
        """
        numbers: dict[str, Any] = {name: config.get(name)
                                   for name in ("clients", "uavs", "devices")}
        for name, value in numbers.items():
            if type(value) is not int or not 1 <= value <= 10_000:
                raise BadInput(f"{name} = {str(value)[:40]} in the settings of the federation; "
                               "allowed are 1 to 10000")
        shared = cls(_checked(RunSettings, "run", config, without=OWN),
                     _checked(LearnerSettings, "learner", config),
                     _checked(FederationSettings, "federation", config), **numbers)
        check_together(shared.run, shared.learner)
        check_federation(shared.federation, shared.learner, shared.clients)
        return shared

    @property
    def proximal_mu(self) -> float:
        """Weight of the proximal term; 0: there is none."""
        federation = self.federation
        return federation.proximal_mu if federation.strategy == "fedprox" else 0.0

    def config(self) -> dict[str, Any]:
        """Return the tables of the app's configuration."""
        return {"clients": self.clients, "uavs": self.uavs, "devices": self.devices,
                "run": self.run.model_dump(mode="json", exclude=set(OWN)),
                "learner": self.learner.model_dump(mode="json"),
                "federation": self.federation.model_dump(mode="json")}


def write_app(shared: Shared, folder: Path) -> None:
    """Write a Flower App, a `pyproject.toml` with settings only.

    No code is in it: every party runs what it has installed.
    """
    app = {"publisher": "radiotwin", "config": shared.config(),
           "components": {"serverapp": "marl.fedqmix.flower_app:server_app",
                          "clientapp": "marl.fedqmix.flower_app:client_app"}}
    project = {"name": "fedqmix", "version": __version__, "license": "Apache-2.0",
               "description": "Federated QMIX of radiotwin", "dependencies": []}
    with atomic_file(folder / "pyproject.toml") as file:
        file.write(tomli_w.dumps({"project": project, "tool": {"flwr": {"app": app}}}).encode())


def _checked(model: type[_Settings], group: str, config: Mapping[str, Any],
             without: tuple[str, ...] = ()) -> _Settings:
    given = {name.removeprefix(f"{group}."): value for name, value in config.items()
             if name.startswith(f"{group}.")}
    try:
        for name in without:
            if name in given:
                raise BadInput(f"{group}.{name} is not for the coordinator to decide")
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise BadInput(f"{group}.{'.'.join(map(str, first['loc']))} = {str(first['input'])[:60]} "
                       f"in the settings of the federation: {first['msg']}") from None
