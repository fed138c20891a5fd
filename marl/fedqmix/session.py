"""A federation of parties with scenes of their own, and its folder: one command for any engine."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import pandas as pd

from marl.fedqmix.client import Client, Party, rounds_of
from marl.fedqmix.federation import Weights, average, initial_weights
from marl.fedqmix.settings import (
    EngineSettings,
    FederationSettings,
    Shared,
    check_federation,
    write_app,
)
from marl.figures import draw_curve
from marl.mission import Known, make_mission
from marl.replicas import check_sizes, keep_memory, limit_threads
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.files import atomic_file, is_temporary, scratch_folder
from radiotwin.links.alignment import in_scene_frame
from radiotwin.links.measurements import read_measurements
from radiotwin.maps.survey import read_truth, segmented_truth
from radiotwin.runtime.console import notice, print_rows, progress, say
from radiotwin.runtime.cuda import torch_device
from radiotwin.scene import Scene


@dataclass(frozen=True)
class FederatedSession:
    """A federation and the folder of its results.

    The run's scene is that of all parties that have none of their own.
    """

    run: RunSettings
    learner: LearnerSettings
    federation: FederationSettings
    engine: EngineSettings
    out: Path

    def execute(self) -> None:
        """Run, write the folder, and print the table.

        Raises:
            BadInput: scenes that do not go together, settings that do not, or a folder that is
                taken.
            RunFailed: Flower is missing, or has failed.
        """
        limit_threads(1)
        keep_memory()
        _check_engine(self.engine.federation, self.federation)
        parties, uavs, devices = self._parties()
        shared = Shared(self.run, self.learner, self.federation, len(parties), uavs, devices)
        check_federation(self.federation, self.learner, len(parties))
        self._claim_folder()
        write_app(shared, self.out / "app")
        if self.engine.federation == "flower-app":
            say(f"wrote {self.out / 'app'}; `flwr run` submits it to a SuperLink")
            return
        rounds = len(rounds_of(self.run, self.learner))
        with progress("rounds", total=rounds) as advance:
            engine = federate if self.engine.federation == "in-process" else self._flower
            engine(shared, parties, advance)
        self._show(parties)

    def _parties(self) -> tuple[list[Party], int, int]:
        """Return the parties, and the numbers of UAVs and devices in each scene."""
        scenes = [Path(each) for each in _listed(self.engine.party_scenes)]
        measured = [Path(each) for each in _listed(self.engine.party_measurements)]
        if not scenes:
            count = len(measured) or len(Scene.load(self.run.scene).config.uavs)
            scenes = [self.run.scene] * count
        if measured and len(measured) != len(scenes):
            raise BadInput(f"--party-measurements: {len(measured)} files for {len(scenes)} "
                           "parties; give one for each")
        device = torch_device(self.run.device)
        parties = [Party(scene, self.out / "parties" / str(number), number, self.run.truth,
                         measured[number] if measured else None, device)
                   for number, scene in enumerate(scenes)]
        sizes = [_checked(party, self.run, self.learner) for party in parties]
        if len(set(sizes)) != 1:
            which = next(number for number, size in enumerate(sizes) if size != sizes[0])
            raise BadInput(f"{scenes[0]} has {sizes[0][0]} UAVs and {sizes[0][1]} devices, "
                           f"{scenes[which]} has {sizes[which][0]} and {sizes[which][1]}; networks "
                           "can be averaged only where these numbers are equal")
        return parties, *sizes[0]

    def _claim_folder(self) -> None:
        if self.out.exists() and (not self.out.is_dir() or any(
                not is_temporary(each) for each in self.out.iterdir())):
            raise BadInput(f"{self.out} exists and is not an empty folder; --out names another one")
        config = {name: getattr(self, name).model_dump(mode="json")
                  for name in ("run", "learner", "federation", "engine")}
        with atomic_file(self.out / "config.json") as file:
            file.write(json.dumps(config, indent=1).encode())

    def _flower(self, shared: Shared, parties: list[Party],
                on_progress: Callable[[int], None]) -> None:
        """Let Flower make the means."""
        from marl.fedqmix.flower_run import Federation  # Flower is an extra

        simulation = self.engine.federation == "flower"
        with scratch_folder() as home:
            federation = Federation(parties, self.out, home, simulation)
            try:
                federation.open()
                federation.watch(federation.run(self.out / "app"), on_progress)
            finally:
                federation.close()
        rounds = pd.read_csv(self.out / "rounds.csv")
        lost = rounds.loc[rounds["parties"] < shared.federation.min_clients, "round"]
        if len(lost):
            notice(f"{len(lost)} of {len(rounds)} rounds had fewer than "
                   f"{shared.federation.min_clients} parties and left the mean as it was: "
                   f"{', '.join(map(str, lost))[:200]}")

    def _show(self, parties: list[Party]) -> None:
        """Print what each party's policy collects, where the parties run on this machine."""
        curves, rows = {}, []
        for party in parties:
            logs = sorted(party.folder.glob("run-*/metrics.csv"))
            if not logs:
                notice(f"party {party.number} has not evaluated its policy; {self.out / 'logs'} "
                       "may say why")
                continue
            table = pd.read_csv(logs[-1])
            last = table.iloc[-1]
            curves[f"party {party.number}, {party.scene.name}"] = table.to_dict("records")
            rows.append([str(party.number), party.scene.name, f"{last['real_episodes']:.0f}",
                         f"{last['simulated_episodes']:,.0f}", f"{last['twin_ratio']:.3f}",
                         f"{last['truth_ratio']:.3f}", f"{last['truth_ratio_std']:.3f}"])
        draw_curve(curves, {}, self.out / "curve.png")
        print_rows(f"Collected by each party's policy, of all data; mean and standard deviation of "
                   f"{self.run.flights} flights",
                   {"party": "left", "scene": "left", "real episodes": "right",
                    "simulated": "right", "in its twin": "right", "in its truth": "right",
                    "±": "right"}, rows)


def federate(shared: Shared, parties: list[Party], on_progress: Callable[[int], None],
             ) -> list[Weights]:
    """Make the means in this process, and return them.

    Every party trains in every round, so that the mean is that of `FedQMIX`. Each gets a folder
    `run-in-process` in its own; progress is the number of rounds since the last call.
    """
    clients = [Client(shared.run, shared.learner,
                      replace(party, folder=party.folder / "run-in-process"),
                      shared.proximal_mu) for party in parties]
    means = [initial_weights(shared)]
    for number in range(1, len(rounds_of(shared.run, shared.learner)) + 1):
        means.append(average([client.train(number, means[-1])[0] for client in clients]))
        on_progress(1)
    for client in clients:
        client.finish(means[-1])
    return means


def _check_engine(engine: str, federation: FederationSettings) -> None:
    if engine == "in-process":
        if federation.strategy == "fedavgm":
            raise BadInput("strategy fedavgm: it is Flower's; give --federation flower with it")
    elif engine != "flower-app" and (
            find_spec("flwr") is None or (engine == "flower" and find_spec("ray") is None)):
        raise RunFailed("federation over Flower needs the extra flower: pip install "
                        "'radiotwin[flower]', in an environment of its own if other packages need "
                        "newer versions of what Flower pins")


def _listed(text: str) -> list[str]:
    return [each.strip() for each in text.split(",") if each.strip()]


def _checked(party: Party, run: RunSettings, learner: LearnerSettings) -> tuple[int, int]:
    """Return the numbers of UAVs and devices of a party's scene, after a look at what it holds.

    Whether its UAVs can fly there, and whether what is learnt fits into memory, too.
    """
    scene = Scene.load(party.scene)
    if party.measurements is not None:
        in_scene_frame(read_measurements(party.measurements), scene)
        truth = segmented_truth(scene)  # which map it is does not matter here
    else:
        truth = read_truth(scene, party.truth)
        truth.require_of(scene)
    check_sizes(run, learner, make_mission(scene, truth, Known.truth(scene), run.assignment))
    return len(scene.config.uavs), len(scene.config.devices)
