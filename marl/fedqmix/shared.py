"""Flower App that all parties of a federation run, and its settings."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w
from pydantic import BaseModel, ValidationError

from marl.fedqmix.federation import Weights
from marl.fedqmix.settings import FederationSettings, check_federation
from marl.mission import Mission
from marl.qmix import QNetworks
from marl.settings import LearnerSettings, RunSettings, check_together
from radiotwin import __version__
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_file

OWN = ("scene", "truth", "device")  # of `RunSettings`: each party has its own
_Settings = TypeVar("_Settings", bound=BaseModel)


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
    """Write a Flower App: settings only, no code; every party runs what it has installed.

    Args:
        shared: its settings.
        folder: to be made, with a `pyproject.toml`.
    """
    app = {"publisher": "radiotwin", "config": shared.config(),
           "components": {"serverapp": "marl.fedqmix.flower_server:app",
                          "clientapp": "marl.fedqmix.flower_client:app"}}
    project = {"name": "fedqmix", "version": __version__, "license": "Apache-2.0",
               "description": "Federated QMIX of radiotwin", "dependencies": []}
    with atomic_file(folder / "pyproject.toml") as file:
        file.write(tomli_w.dumps({"project": project, "tool": {"flwr": {"app": app}}}).encode())


def initial_weights(shared: Shared) -> Weights:
    """Return the weights that `FedQMIX` begins with, from the sizes alone."""
    links = np.zeros((shared.uavs, shared.devices, 1, 1), np.float32)
    each = np.zeros(shared.uavs, np.int64)
    sizes = Mission(links, links, np.zeros((shared.uavs, 1, 1), np.int64),
                    np.zeros((shared.uavs, 2), np.int64), each, each.astype(float),
                    np.zeros(shared.devices), np.zeros((shared.devices, 2)), 1.0, 1.0, 0.0, 0.0,
                    np.zeros(2), False)
    return QNetworks(shared.learner, sizes, shared.run.seed).weights()


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
