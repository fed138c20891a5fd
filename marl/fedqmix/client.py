"""One party of a federation: a scene, flights or measurements, and a replica that learns in them.

It does what `marl.algorithm1` does, driven from outside: the mean of all replicas comes in, and the
weights of this one go out. Nothing else is returned. FedProx adds a term to the loss that keeps a
replica near the mean that it started from.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from typing_extensions import override

from marl.algorithm1 import (
    TWINS,
    Reality,
    location_errors_m,
    measuring_policy,
    round_row,
    twin_mission,
)
from marl.checkpoint import (
    NAME,
    Damaged,
    check_rows,
    check_table,
    keep_twin,
    load_checkpoint,
    refuse_damaged,
    require_count,
    require_fields,
    require_number,
    save_checkpoint,
    stored_twin,
)
from marl.fedqmix.federation import Weights, require_weights
from marl.flights import evaluate
from marl.learner import Setup
from marl.mission import Known, Mission
from marl.qmix import QMIX, QNetworks
from marl.replicas import check_sizes
from marl.settings import LearnerSettings, RunSettings, stream
from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.links.alignment import in_scene_frame
from radiotwin.links.measurements import Measurements, read_measurements
from radiotwin.maps.survey import read_truth
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit_twin


class ProximalNetworks(QNetworks):
    """QMIX's networks with the proximal term µ/2 ‖w - w^t‖² (Li et al., MLSys 2020, Eq. 2)."""

    def __init__(self, *arguments: Any, mu: float) -> None:
        super().__init__(*arguments)
        self.mu = mu
        self._keep()

    def _keep(self) -> None:
        self._mean = [weight.detach().clone() for weight in self.parameters()]

    @override
    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        super().set_weights(weights)
        self._keep()

    @override
    def penalty(self) -> Tensor:
        distances = [(weight - mean).square().sum()
                     for weight, mean in zip(self.parameters(), self._mean)]
        return self.mu / 2 * torch.stack(distances).sum()


@dataclass(frozen=True)
class Party:
    """Data of one party, which nobody else sees.

    Attributes:
        scene: its folder.
        folder: of its checkpoint and results.
        number: of its replica, whose random numbers it learns with. Its real flights are drawn by
            the run's seed alone, as those of a single owner's replicas are.
        truth: see `RunSettings.truth`; real flights are simulated in this map.
        measurements: of flights that were flown; None: they are simulated.
        device: torch device.
    """

    scene: Path
    folder: Path
    number: int = 0
    truth: str = "traced"
    measurements: Path | None = None
    device: str = "cpu"


def rounds_of(run: RunSettings, settings: LearnerSettings) -> list[tuple[int, int]]:
    """Return (real episode from 0, training episodes) of each round of a federation.

    They are the blocks of `FedQMIX`: a mean after every `federate_every` episodes, and after the
    last one before the next real episode.
    """
    blocks = [min(settings.federate_every, run.episodes - start)
              for start in range(0, run.episodes, settings.federate_every)]
    return [(number, block) for number in range(run.real_episodes) for block in blocks]


class Client:
    """A party that trains when it is asked to, and goes on from the checkpoint in its folder.

    Args:
        run: settings that all parties share; scene and truth are the party's own.
        settings: of learning, shared too.
        party: what is its own.
        proximal_mu: µ of FedProx; 0: none.

    Raises:
        BadInput: a scene, measurements, settings or a checkpoint that cannot be used.
    """

    def __init__(self, run: RunSettings, settings: LearnerSettings, party: Party,
                 proximal_mu: float = 0.0) -> None:
        self._run, self._settings, self._party = run, settings, party
        self._schedule = rounds_of(run, settings)
        self._done, self._entered = 0, 0  # rounds, and real episodes that were begun
        self._rows: list[dict] = []
        self._spent = {"learn_twin_s": 0.0, "round_s": 0.0}  # in the present real episode
        self._scene = Scene.load(party.scene)
        self._measured = self._read_measurements()
        self._reality = self._read_reality()
        self._twin: Twin | None = None
        self._true_positions = run.twin == "truth" or run.privileged
        self._known = (Known.truth if self._true_positions else Known.anchors)(self._scene)
        path = party.folder / NAME
        state = load_checkpoint(path) if path.exists() else None
        if state is not None:
            self._restore(state, path)
        elif self._measured is not None:
            self._learn(None)
        mission = self._mission()
        check_sizes(run, settings, mission)
        blank = mission._replace(snr_db=np.full_like(mission.snr_db, -np.inf))
        self._replica = _Replica(Setup(run, settings, blank, run.real_episodes, party.device),
                                 party.number, proximal_mu)
        if state is not None:
            try:
                self._replica.go_on(mission, state["replica"])
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                refuse_damaged(path, error)

    def train(self, number: int, mean: Weights) -> tuple[Weights, int]:
        """Train for a round from a mean, and write the checkpoint.

        Args:
            number: of the round, from 1; rounds may have been missed.
            mean: of the round before; at first the initial weights.

        Returns:
            The weights, and the number of training episodes behind them.

        Raises:
            BadInput: no such round, or weights of other names, shapes or values.
        """
        started = time.perf_counter()
        if not self._done < number <= len(self._schedule):
            raise BadInput(f"round {number} is asked for; rounds {self._done + 1} to "
                           f"{len(self._schedule)} are to come")
        require_weights(mean, self._replica.weights())
        if self._done:
            self._replica.judge(mean)
        real_episode, episodes = self._schedule[number - 1]
        if real_episode >= self._entered:
            if self._entered:
                self._log()
            if self._measured is None and self._run.twin != "truth":
                self._learn(self._replica)
            self._replica.enter(self._mission())
            self._entered = real_episode + 1
        weights = self._replica.train(mean, episodes)
        self._done = number
        self._spent["round_s"] += time.perf_counter() - started
        self._save()
        return weights, episodes

    def finish(self, mean: Weights) -> int:
        """Evaluate the last mean's policy; write its row of the log and the checkpoint.

        Returns:
            The number of flights of the evaluation.
        """
        require_weights(mean, self._replica.weights())
        if self._entered:
            self._replica.judge(mean)
            self._log()
            self._save()
        return self._run.flights

    def _read_measurements(self) -> Measurements | None:
        if self._party.measurements is None:
            return None
        if self._run.twin == "truth":
            raise BadInput("twin truth: there are measurements, and no truth to train in; leave "
                           "them out, or choose another twin")
        return in_scene_frame(read_measurements(self._party.measurements), self._scene)

    def _read_reality(self) -> Reality | None:
        """Return what real flights are simulated in; None where they were flown, and no map is."""
        run, scene = self._run, self._scene
        if self._measured is not None and not (scene.folder / "truth.nc").exists():
            return None
        truth = read_truth(scene, self._party.truth)
        truth.require_of(scene)
        noise_db = 0.0 if "sigma_db" in truth.dataset else run.noise_db
        return Reality(scene, truth, run.assignment, noise_db, run.seed)

    def _learn(self, replica: "_Replica | None") -> None:
        """Learn the twin from one more flight, or from the measurements."""
        started, run, reality = time.perf_counter(), self._run, self._reality
        measured, before = self._measured, self._twin
        if measured is None:
            assert reality is not None and replica is not None
            rng = stream(run.seed, "decisions", len(reality.tables))
            reality.fly(measuring_policy(run, reality, before, self._known, replica, rng),
                        self._known)
            measured = reality.measurements()
        self._twin = fit_twin(measured, self._scene, model=TWINS[run.twin], seed=run.seed,
                              start=before)
        if not self._true_positions:
            self._known = Known.of(self._twin.devices)
        self._spent["learn_twin_s"] = time.perf_counter() - started

    def _mission(self) -> Mission:
        """Return the mission to train in; before the first flight, one of its size."""
        if self._twin is None:
            assert self._reality is not None
            return self._reality.mission(self._known)
        measured = self._measured
        if measured is None:
            assert self._reality is not None
            measured = self._reality.measurements()
        return twin_mission(self._scene, self._run, self._twin, self._known, measured)

    def _log(self) -> None:
        """Evaluate the policy of a real episode, in the twin and in the truth if there is one."""
        run, replica = self._run, self._replica
        policy = replica.policy(stream(run.seed, "decisions", self._entered - 1))
        in_twin = real = np.full(1, np.nan)
        if self._twin is not None:
            flown = evaluate(replica.mission, policy, run.flights,
                             stream(run.seed, "twin evaluation"))
            in_twin = flown.ratio(replica.mission)
        if self._reality is not None:
            mission = self._reality.mission(self._known)
            real = evaluate(mission, policy, run.flights,
                            stream(run.seed, "truth evaluation")).ratio(mission)
        found = self._known if self._twin is None else Known.of(self._twin.devices)
        row = round_row(run, replica, len(self._rows) + 1, in_twin, real,
                        location_errors_m(self._scene, found))
        if self._measured is not None:
            row["real_episodes"] = len(self._measured.flights)
        row["simulated_episodes"] = replica.episodes  # it may have missed rounds
        if run.twin == "truth":
            row["real_episodes"] = replica.episodes + replica.selection_flights
        row["evaluation_flights"] = row["round"] * run.flights
        self._rows.append(row | self._spent)
        self._spent["round_s"] = 0.0
        with atomic_path(self._party.folder / "metrics.csv") as temporary:
            write_csv(pd.DataFrame(self._rows), temporary)

    def _save(self) -> None:
        tables = []
        if self._measured is None and self._reality is not None:
            tables = self._reality.tables
        twin = None if self._twin is None else keep_twin(self._twin, self._party.folder)
        save_checkpoint({"done": self._done, "entered": self._entered, "rows": self._rows,
                         "spent": dict(self._spent), "tables": tables,
                         "replica": self._replica.state(last=False), "twin": twin},
                        self._party.folder / NAME)

    def _restore(self, state: dict, path: Path) -> None:
        try:
            require_fields(state, ("done", "entered", "rows", "spent", "tables", "replica",
                                   "twin"))
            self._done = require_count(state["done"], len(self._schedule))
            self._entered = require_count(state["entered"], self._run.real_episodes)
            self._rows = check_rows(state["rows"], 0, self._entered)
            for name, seconds in require_fields(state["spent"], self._spent).items():
                self._spent[name] = require_number(seconds)
            for number, table in enumerate(state["tables"]):
                check_table(table, number, self._scene)
            flown = self._measured is None and self._run.twin != "truth"
            if (state["twin"] is None) != (self._run.twin == "truth") or \
                    (len(state["tables"]) > 0) != flown:
                raise Damaged("the twin or its measurements are missing")
            if flown and self._reality is not None:
                self._reality.tables = list(state["tables"])
            if state["twin"] is not None:
                self._twin = stored_twin(state["twin"], path, self._scene)
                if not self._true_positions:
                    self._known = Known.of(self._twin.devices)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            refuse_damaged(path, error)


class _Replica(QMIX):
    """One of the replicas of `FedQMIX`, alone: the mean is made elsewhere."""

    def __init__(self, setup: Setup, number: int, proximal_mu: float) -> None:
        if proximal_mu:
            self.networks = partial(ProximalNetworks, mu=proximal_mu)
        super().__init__(setup, [number])

    def train(self, mean: Weights, episodes: int) -> Weights:
        """Train for some episodes from a mean, and return the weights."""
        self._trainers.call("set_weights", mean)
        _, weights = self._train(episodes)
        self.episodes += episodes
        return weights

    def weights(self) -> Weights:
        """Return the present weights."""
        return self._trainers.call("weights")[0]

    def go_on(self, mission: Mission, state: dict) -> None:
        """Go on from a checkpoint, in the map of that time."""
        self.load_state(state)
        self.mission = mission
        self._trainers.call("enter", mission, self._actions)

    @override
    def state(self, last: bool) -> dict:
        return super().state(last) | {"highest": float(self._highest)}

    @override
    def load_state(self, state: dict) -> None:
        if type(state["highest"]) is not float:
            raise Damaged("the highest share should be a number")
        self._highest = state["highest"]
        super().load_state({name: part for name, part in state.items() if name != "highest"})
