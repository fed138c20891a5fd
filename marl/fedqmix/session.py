"""Execute a federation of parties with their own scenes, and write its folder."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from marl.fedqmix.client import Client, Party
from marl.fedqmix.federation import Weights, average, initial_weights, rounds_of
from marl.fedqmix.settings import FederationSettings, Shared, write_app
from marl.figures import draw_curve
from marl.replicas import keep_memory, limit_threads
from marl.session import FLIGHTS_SAY, flights_text, require_free
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_file
from radiotwin.runtime.console import print_rows, progress, say
from radiotwin.runtime.cuda import torch_device
from radiotwin.scene import Scene


@dataclass(frozen=True)
class FederatedSession:
    """A federation and the folder of its results.

    Without `--party-scenes` all parties have the run's scene.
    """

    run: RunSettings
    learner: LearnerSettings
    federation: FederationSettings
    out: Path

    def execute(self) -> None:
        """Run the federation, write the folder, and print the table; or only write the Flower App.

        Raises:
            BadInput: scenes of different sizes, contradictory settings, or a folder that is not
                empty.
        """
        limit_threads(1)
        keep_memory()
        require_free(self.out, "--out names another one")
        parties = self._parties()
        if self.federation.federation == "flower-app":
            scenes = [Scene.load(party.scene).config for party in parties]
            shared = self._shared(parties, [(len(scene.uavs), len(scene.devices))
                                            for scene in scenes])
            write_app(shared, [node_config(party) for party in parties], self.out)
            say(f"wrote {self.out / 'app'}; `flwr run {self.out / 'app'}` submits it to Flower")
            return
        clients = [Client(self.run, self.learner, party) for party in parties]
        shared = self._shared(parties, [client.sizes for client in clients])
        config = {name: getattr(self, name).model_dump(mode="json")
                  for name in ("run", "learner", "federation")}
        with atomic_file(self.out / "config.json") as file:
            file.write(json.dumps(config, indent=1).encode())
        federate(shared, clients)
        self._show(parties)

    def _parties(self) -> list[Party]:
        """Return the parties named by the settings."""
        scenes = _listed(self.federation.party_scenes)
        measured = _listed(self.federation.party_measurements)
        if not scenes:
            count = len(measured) or len(Scene.load(self.run.scene).config.uavs)
            scenes = [self.run.scene] * count
        if measured and len(measured) != len(scenes):
            raise BadInput(f"--party-measurements: {len(measured)} files for {len(scenes)} "
                           "parties; give one for each")
        device = torch_device(self.run.device)
        return [Party(scene, self.out / "parties" / str(number), number, self.run.truth,
                      measured[number] if measured else None, device)
                for number, scene in enumerate(scenes)]

    def _shared(self, parties: list[Party], sizes: list[tuple[int, int]]) -> Shared:
        """Return the common settings; refuse parties whose numbers of UAVs or devices differ."""
        for party, size in zip(parties, sizes):
            if size != sizes[0]:
                raise BadInput(f"{parties[0].scene} has {sizes[0][0]} UAVs and {sizes[0][1]} "
                               f"devices, {party.scene} has {size[0]} and {size[1]}; networks can "
                               "be averaged only where these numbers are equal")
        if self.federation.min_clients > len(parties):
            raise BadInput(f"--min-clients {self.federation.min_clients}: there are "
                           f"{len(parties)} parties")
        return Shared(run=self.run, learner=self.learner, clients=len(parties), uavs=sizes[0][0],
                      devices=sizes[0][1], min_clients=self.federation.min_clients,
                      round_timeout_s=self.federation.round_timeout_s)

    def _show(self, parties: list[Party]) -> None:
        """Draw and print the share that each party's policy collects."""
        curves, rows = {}, []
        for party in parties:
            table = pd.read_csv(party.folder / "metrics.csv")
            last = table.iloc[-1]
            curves[f"party {party.number}, {party.scene.name}"] = table.to_dict("records")
            rows.append([str(party.number), party.scene.name, flights_text(last),
                         f"{last['simulated_episodes']:,.0f}", f"{last['twin_ratio']:.3f}",
                         f"{last['truth_ratio']:.3f}", f"{last['truth_ratio_std']:.3f}"])
        draw_curve(curves, {}, self.out / "curve.png")
        print_rows(f"Collected by each party's policy, of all data; mean and standard deviation of "
                   f"{self.run.flights} flights. {FLIGHTS_SAY}",
                   {"party": "left", "scene": "left", "real flights": "right",
                    "simulated": "right", "in its twin": "right", "in its truth": "right",
                    "±": "right"}, rows)


def federate(shared: Shared, clients: list[Client]) -> list[Weights]:
    """Run all rounds of a federation in this process; return the mean weights after each.

    Every party trains in every round, so the means are those of `FedQMIX`.
    """
    means = [initial_weights(shared)]
    rounds = len(rounds_of(shared.run, shared.learner))
    with progress("rounds", total=rounds, lines=True) as advance:
        for number in range(1, rounds + 1):
            means.append(average([client.train(number, means[-1])[0] for client in clients]))
            advance()
    for client in clients:
        client.finish(means[-1])
    return means


def _listed(text: str) -> list[Path]:
    """Split a comma-separated text into paths."""
    return [Path(each.strip()) for each in text.split(",") if each.strip()]


def node_config(party: Party) -> dict[str, str | int]:
    """Return the `--node-config` of a party's Flower SuperNode."""
    given = {name: value for name, value in asdict(party).items() if value is not None}
    given["out"] = given.pop("folder")
    return {name: str(value.absolute()) if isinstance(value, Path) else value
            for name, value in given.items()}
