"""One party of a federation: its scene, its flights or measurements, and its replica of FedQMIX.

It runs Algorithm 1 as the coordinator asks: the mean weights come in, the replica's weights go out.
Nothing else is returned.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from marl.algorithm1 import MAX_NUMBER, Campaign
from marl.checkpoint import (
    NAME,
    load_checkpoint,
    refusing,
    require,
    require_log,
    save_checkpoint,
)
from marl.fedqmix.federation import Replica, Weights, require_weights, rounds_of
from marl.learner import Setup
from marl.replicas import check_sizes
from marl.settings import LearnerSettings, RunSettings, stream
from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.links.alignment import in_scene_frame
from radiotwin.links.measurements import read_measurements
from radiotwin.maps.survey import read_truth
from radiotwin.scene import Scene


@dataclass(frozen=True)
class Party:
    """Private data of one party.

    Attributes:
        scene: folder of its scene.
        folder: folder of its checkpoint and results.
        number: number of its replica, for random numbers of learning. Its real flights depend on
            the run's seed only, as with a single owner.
        truth: map of simulated real flights, see `RunSettings.truth`.
        measurements: file of measurements; None: flights are simulated.
        device: torch device.
    """

    scene: Path
    folder: Path
    number: int = 0
    truth: str = "traced"
    measurements: Path | None = None
    device: str = "cpu"


class Client:
    """A party that trains on request, and continues from the checkpoint in its folder.

    Settings are common to all parties, but for scene and truth. `sizes` are the numbers of UAVs and
    devices of its scene.

    Raises:
        BadInput: a scene, measurements, settings or a checkpoint that cannot be used.
    """

    def __init__(self, run: RunSettings, settings: LearnerSettings, party: Party) -> None:
        self._run, self._party = run, party
        self._schedule = rounds_of(run, settings)
        self._done, self._entered = 0, 0  # rounds, and real episodes that were begun
        self._train_s = 0.0  # in the present real episode
        scene = Scene.load(party.scene)
        self.sizes = len(scene.config.uavs), len(scene.config.devices)
        self._campaign = _campaign(run, scene, party)
        path = party.folder / NAME
        state = load_checkpoint(path) if path.exists() else None
        if state is not None:
            with refusing(path):
                self._restore(state, path)
        elif party.measurements is not None:
            self._campaign.learn(None, stream(run.seed, "decisions"))
        mission = self._campaign.mission()
        check_sizes(run, settings, mission)
        blank = mission._replace(snr_db=np.full_like(mission.snr_db, -np.inf))
        self._replica = Replica(Setup(run, settings, blank, run.real_episodes, party.device),
                                party.number)
        if state is not None:
            with refusing(path):
                self._replica.go_on(mission, state["replica"])

    def train(self, number: int, mean: Weights) -> tuple[Weights, int]:
        """Train for a round from the mean weights, and write the checkpoint.

        Rounds count from 1, and some may have been missed; the first mean is the initial weights.
        Returned are the trained weights and the number of training episodes.

        Raises:
            BadInput: no such round, or weights of other names, shapes or values.
        """
        started = time.perf_counter()
        if not self._done < number <= len(self._schedule):
            raise BadInput(f"round {number} is asked for; rounds {self._done + 1} to "
                           f"{len(self._schedule)} are to come")
        self._judge(mean)
        real_episode, episodes = self._schedule[number - 1]
        if real_episode >= self._entered:
            if self._entered:
                self._log()
            campaign = self._campaign
            campaign.learn(self._replica, stream(self._run.seed, "decisions", campaign.flown))
            self._replica.enter(campaign.mission())
            self._entered = real_episode + 1
        weights = self._replica.train(mean, episodes)
        self._done = number
        self._train_s += time.perf_counter() - started
        self._save()
        return weights, episodes

    def finish(self, mean: Weights) -> int:
        """Evaluate the last mean weights, and write log and checkpoint; return the flights."""
        self._judge(mean)
        if self._entered:
            self._log()
            self._save()
        return self._run.flights

    def _judge(self, mean: Weights) -> None:
        """Check mean weights, and keep their policy if it is the best so far."""
        require_weights(mean, self._replica.weights())
        if self._done:
            self._replica.judge(mean)

    def _log(self) -> None:
        """Evaluate the policy learnt in a real episode, and write `metrics.csv`."""
        campaign, replica = self._campaign, self._replica
        campaign.log(replica, replica.mission, stream(self._run.seed, "decisions"),
                     replica.episodes)
        campaign.rows[-1]["round_s"], self._train_s = self._train_s, 0.0
        with atomic_path(self._party.folder / "metrics.csv") as temporary:
            write_csv(pd.DataFrame(campaign.rows), temporary)

    def _save(self) -> None:
        """Write the checkpoint: campaign, replica, and rounds and real episodes done."""
        campaign = self._campaign
        save_checkpoint(campaign.state(self._party.folder) | {
            "done": self._done, "entered": self._entered, "replica": self._replica.state(False),
            "spent": {"learn_s": campaign.learn_s, "train_s": self._train_s}},
            self._party.folder / NAME)

    def _restore(self, state: dict, path: Path) -> None:
        """Continue from the state of a checkpoint; raise Damaged if it is not of this run."""
        campaign = self._campaign
        campaign.load_state(state, path, ("done", "entered", "replica", "spent"))
        self._done = require(state["done"], range(len(self._schedule) + 1), "done")
        self._entered = require(state["entered"], range(self._run.real_episodes + 1), "entered")
        [spent] = require_log([state["spent"]], (), ("learn_s", "train_s"), MAX_NUMBER)
        campaign.learn_s, self._train_s = spent["learn_s"], spent["train_s"]


def _campaign(run: RunSettings, scene: Scene, party: Party) -> Campaign:
    """Return the campaign of a party; with measurements, a map of the truth is optional."""
    measured, truth = None, None
    if party.measurements is not None:
        if run.twin == "truth":
            raise BadInput("twin truth: there are measurements, and no truth to train in; leave "
                           "them out, or choose another twin")
        measured = in_scene_frame(read_measurements(party.measurements), scene)
    if measured is None or (scene.folder / "truth.nc").exists():
        truth = read_truth(scene, party.truth)
        truth.require_made_for(scene)
    return Campaign(run, scene, truth, measured)
