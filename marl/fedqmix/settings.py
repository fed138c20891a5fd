"""Settings of a federation, and the Flower App that carries them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marl.settings import LearnerSettings, RunSettings, check_together
from radiotwin import __version__
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_file

OWN = ("scene", "truth", "device")  # fields of `RunSettings` that each party sets for itself


class FederationSettings(BaseModel):
    """Settings of a federation, and the files of its parties."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    federation: Literal["in-process", "flower-app"] = Field(
        "in-process", description="where parties with scenes of their own train fedqmix: in this "
        "process; flower-app only writes the Flower App, which Flower runs between processes and "
        "machines")
    party_scenes: str = Field(
        "", max_length=10_000, description="scene folders of the parties, separated by commas; "
        "without: --scene once for each of its UAVs")
    party_measurements: str = Field(
        "", max_length=10_000, description="measurements of the parties, separated by commas, to "
        "learn their twins from; without: real flights are simulated in each scene's truth")
    min_clients: int = Field(
        2, ge=1, le=10_000, description="parties that a round of Flower needs; with fewer the mean "
        "stays as it was")
    round_timeout_s: float = Field(
        600.0, ge=1, le=10**6, description="seconds that a round of Flower waits for parties that "
        "do not answer")


class Shared(BaseModel):
    """Settings common to all parties, set by the coordinator."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    run: RunSettings = Field(description="what is in `OWN` is left at its default")
    learner: LearnerSettings
    clients: int = Field(ge=1, le=10_000, strict=True, description="parties to wait for")
    uavs: int = Field(ge=1, le=10_000, strict=True, description="in each party's scene")
    devices: int = Field(ge=1, le=10_000, strict=True, description="likewise")
    min_clients: int = Field(2, ge=1, le=10_000)
    round_timeout_s: float = Field(600.0, ge=1, le=10**6)
    out: str = Field("", description="folder of the coordinator's files")
    parties: str = Field("", description="file of parties, for Flower's simulation engine")

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Shared":
        """Validate the configuration of a Flower run, which may come from somebody else.

        Args:
            config: `Context.run_config`: keys such as `run.episodes`.

        Raises:
            BadInput: a key or value that is not allowed.
        """
        nested: dict[str, Any] = {}
        for name, value in config.items():
            group, _, field = name.rpartition(".")
            (nested.setdefault(group, {}) if group else nested)[field] = value
            if group == "run" and field in OWN:
                raise BadInput(f"{name} is not for the coordinator to decide")
        try:
            shared = cls.model_validate(nested)
        except ValidationError as error:
            first = error.errors()[0]
            raise BadInput(f"{'.'.join(map(str, first['loc']))} = {str(first['input'])[:60]} in "
                           f"the settings of the federation: {first['msg']}") from None
        check_together(shared.learner)
        if shared.min_clients > shared.clients:
            raise BadInput(f"--min-clients {shared.min_clients}: there are {shared.clients} "
                           "parties")
        return shared

    def config(self) -> dict[str, Any]:
        """Return the app's configuration, which `of` reads."""
        return self.model_dump(mode="json", exclude={"run": set(OWN)})


def write_app(shared: Shared, parties: list[dict[str, Any]], folder: Path) -> None:
    """Write a Flower App (`pyproject.toml` with settings) and the file of its parties.

    The app has no code: each party runs its installed package. The file of parties is only for
    Flower's simulation engine, and is not part of the app.
    """
    app = {"publisher": "radiotwin", "config": shared.config(),
           "components": {"serverapp": "marl.fedqmix.flower_app:server_app",
                          "clientapp": "marl.fedqmix.flower_app:client_app"}}
    project = {"name": "fedqmix", "version": __version__.partition("+")[0], "license": "Apache-2.0",
               "description": "Federated QMIX of radiotwin", "dependencies": []}
    with atomic_file(folder / "app" / "pyproject.toml") as file:
        file.write(tomli_w.dumps({"project": project, "tool": {"flwr": {"app": app}}}).encode())
    with atomic_file(folder / "parties.json") as file:
        file.write(json.dumps(parties, indent=1).encode())
