"""Algorithm 1 of the paper: fly, fit the twin to the measurements, train in it, and repeat."""

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from marl.checkpoint import (
    NAME,
    Damaged,
    keep_twin,
    load_checkpoint,
    refusing,
    require,
    require_log,
    require_tables,
    save_checkpoint,
    stored_twin,
)
from marl.environment import Environment
from marl.flights import Flights, Policy, evaluate, fly
from marl.heuristics import HeuristicPolicy, waypoint_actions
from marl.learner import Learner, make_learner
from marl.mission import Known, Mission, levels_of, make_mission
from marl.planner import PlanPolicy
from marl.settings import LearnerSettings, RunSettings, stream
from marl.worlds import twin_prior
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import declared_devices, heading_deg, link_table
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin.shadowing import with_shadowing

TWINS = {"nn": "segmented_nn", "log-distance": "log_distance", "kriging": "kriging",
         "paths": "paths", "path_kriging": "path_kriging"}
"""Name of a twin on the command line -> model of `fit_twin`."""
FLIGHTS = ("measuring_flights", "training_flights", "selection_flights")
"""Columns of the log: numbers of real flights by purpose."""
COUNTS = ("round", "real_episodes", *FLIGHTS, "simulated_episodes", "located", "evaluation_flights")
NUMBERS = ("real_ratio", "truth_ratio", "truth_ratio_std", "twin_ratio", "location_error_median_m",
           "location_error_worst_m", "learn_twin_s", "round_s")
"""Further columns of the log, see `Campaign.log`."""
MAX_NUMBER = 1e30  # largest number that is accepted in a log


def run_algorithm(run: RunSettings, learner_settings: LearnerSettings, scene: Scene,
                  truth: RadioMap, folder: Path | None, resume: bool,
                  on_round: Callable[[list[dict], list[dict]], None],
                  on_progress: Callable[..., None], device: str = "cpu",
                  on_learned: Callable[["Campaign", Mission], None] | None = None) -> "Campaign":
    """Alternate real flights and training in the twin.

    With a perfect twin (`run.twin == "truth"`) nothing is measured: training episodes are real.

    Args:
        run: settings of the run.
        learner_settings: settings of learning.
        scene: scene; true positions of unknown devices are used only if `run` says so.
        truth: radio map of the real world.
        folder: folder of the checkpoint, written after every round; None: no checkpoint.
        resume: whether to continue from the checkpoint.
        on_round: called after every round with all rows and blocks so far.
        on_progress: called with the number of episodes simulated since the last call, and with a
            text about the last round.
        device: torch device.
        on_learned: called in every round with the campaign and the mission to train in.

    Returns:
        the campaign at its end; on the CPU it is the same to the bit if the run was interrupted and
        resumed.

    Raises:
        BadInput: a damaged checkpoint, or input that `fit_twin` or `make_mission` refuses.
    """
    campaign = Campaign(run, scene, truth)
    learner = make_learner(run, learner_settings, campaign.in_truth(), run.real_episodes, device)
    rows, blocks = campaign.rows, campaign.blocks
    checkpoint = folder / NAME if folder else None
    try:
        # A run that was stopped before its first checkpoint starts again.
        if resume and folder and checkpoint and checkpoint.exists():
            resume_from(checkpoint, campaign, learner)
            if campaign.twin is not None:
                campaign.twin.save(folder / "twin")
            on_progress(run.episodes * len(rows), _summary(rows[-1], run))
            # The run may have stopped between checkpoint and log, so the log is written again.
            on_round(rows, blocks)
        for number in range(len(rows), run.real_episodes):
            started = time.perf_counter()
            rng = stream(run.seed, "decisions", number)
            campaign.learn(learner, rng)
            mission = campaign.mission()
            if on_learned is not None:
                on_learned(campaign, mission)
            campaign.pass_uncertainty(learner)
            blocks += [{"round": number + 1} | block
                       for block in learner.prepare(mission, on_progress)]
            campaign.log(learner, mission, rng, (number + 1) * run.episodes * learner.replicas)
            rows[-1]["round_s"] = time.perf_counter() - started
            on_progress(0, _summary(rows[-1], run))
            if folder and checkpoint:
                last = number + 1 == run.real_episodes
                save_checkpoint(campaign.state(folder) | {"blocks": blocks,
                                                          "strategy": learner.state(last)},
                                checkpoint)
            on_round(rows, blocks)
        policy = learner.policy(stream(run.seed, "decisions", run.real_episodes - 1))
        campaign.flights = evaluate(campaign.in_truth(), policy, run.flights,
                                    stream(run.seed, "truth evaluation"))
        return campaign
    finally:
        learner.close()


def resume_from(path: Path, campaign: "Campaign", learner: Learner) -> None:
    """Restore a campaign and its learner from a checkpoint.

    Raises:
        BadInput: the checkpoint is damaged, or of another run.
    """
    state = load_checkpoint(path)
    with refusing(path):
        campaign.load_state(state, path, ("blocks", "strategy"))
        if not campaign.rows:
            raise Damaged("no round has finished")
        learner.load_state(state["strategy"])
        campaign.blocks += require_log(state["blocks"], ("round", "episodes"))
    if not state["strategy"]:  # a learner without a state of its own is prepared from the twin
        campaign.pass_uncertainty(learner)
        learner.prepare(campaign.mission(), lambda _: None)


class Campaign:
    """Real flights, the twin fitted to their measurements, and the log of the rounds.

    Args:
        run: settings of the run.
        scene: scene; true positions of unknown devices are used only if `run` says so.
        truth: radio map of the real world; None: there are only `measured` flights.
        measured: measurements of flights; None: flights are simulated in the truth.

    Attributes:
        known: device positions that the UAVs know.
        twin: the present twin; None before the first, or if training is in the truth.
        rows: log with a row for each round; `docs/marl.md` explains the columns.
        blocks: records of training, several for each round.
        flights: final evaluation in the truth.
        learn_s: duration of the last simulated real flight and fit of a twin [s].
    """

    def __init__(self, run: RunSettings, scene: Scene, truth: RadioMap | None,
                 measured: Measurements | None = None) -> None:
        self.run, self.scene, self.measured = run, scene, measured
        self.rows, self.blocks = list[dict](), list[dict]()
        self.flights: Flights
        self.twin: Twin | None = None
        self.reality: Reality | None = None
        if truth is not None:
            # In a truth with shadowing, that includes the receivers' noise.
            noise_db = 0.0 if "sigma_db" in truth.dataset else run.noise_db
            self.reality = Reality(scene, truth, run.assignment, noise_db, run.seed)
        self._true_positions = run.twin == "truth" or run.privileged
        self.known = (Known.truth if self._true_positions else Known.anchors)(scene)
        self.learn_s = 0.0

    @property
    def flown(self) -> int:
        """Number of simulated real flights."""
        return len(self.reality.tables) if self.reality is not None else 0

    def in_truth(self) -> Mission:
        """Return the mission in the truth's map."""
        assert self.reality is not None
        return self.reality.mission(self.known)

    def mission(self) -> Mission:
        """Return the mission to train in: in the twin's map, or in the truth's without a twin."""
        if self.twin is None:
            return self.in_truth()
        radio_map = self.twin.radio_map(self.scene)
        if self.run.twin_shadowing == "fitted":
            radio_map = with_shadowing(radio_map, self.twin)
        return make_mission(self.scene, radio_map, self.known, self.run.assignment)

    def pass_uncertainty(self, learner: Learner) -> None:
        """Pass the twin's uncertainty to a learner that uses it (`Learner.believes`)."""
        if not learner.believes:
            return
        prior = None
        if self.twin is not None:
            prior = twin_prior(self.twin, self.scene, self.twin.radio_map(self.scene),
                               stream(self.run.seed, "learning"))
        learner.believe(prior)

    def learn(self, learner: Learner | None, rng: np.random.Generator) -> None:
        """Fly a real episode, and fit the twin to all measurements so far.

        Measurements from a file are fitted once; then no learner is needed. If the truth is the
        twin, nothing is done.
        """
        run, started, measured = self.run, time.perf_counter(), self.measured
        if run.twin == "truth" or (measured is not None and self.twin is not None):
            return
        if measured is None:
            assert self.reality is not None and learner is not None
            self.reality.fly(self.measuring_policy(learner, rng), self.known)
            measured = self.reality.measurements()
        self._set_twin(fit_twin(measured, self.scene, model=TWINS[run.twin], seed=run.seed,
                                start=self.twin))
        self.learn_s = time.perf_counter() - started

    def measuring_policy(self, learner: Learner, rng: np.random.Generator) -> Policy:
        """Return the next real flight's policy: random waypoints or actions, or the learner's."""
        kind = self.run.measure if self.twin is not None else self.run.first_flight
        if kind == "waypoints":
            return PlanPolicy(waypoint_actions(self.scene, self.in_truth(), rng))
        return HeuristicPolicy("random", rng) if self.twin is None else learner.policy(rng)

    def log(self, learner: Learner, mission: Mission, rng: np.random.Generator,
            simulated: int) -> None:
        """Evaluate the policy in the twin's and the truth's map, if any, and add a row to the log.

        `mission` is that in which the learner was prepared in this round, `simulated` the number of
        training episodes of all replicas so far.
        """
        run, found, in_twin, real = self.run, self.known, np.full(1, np.nan), np.full(1, np.nan)
        if self.twin is not None:
            flown = evaluate(mission, learner.policy(rng), run.flights,
                             stream(run.seed, "twin evaluation"))
            in_twin, found = flown.ratio(mission), Known.of(self.twin.devices)
        if self.reality is not None:
            mission = self.in_truth()
            real = evaluate(mission, learner.policy(rng), run.flights,
                            stream(run.seed, "truth evaluation")).ratio(mission)
        number = len(self.rows) + 1
        errors_m = location_errors_m(self.scene, found)
        located = errors_m[np.isfinite(errors_m)]
        self.rows.append({
            "round": number, **self._real_flights(learner, simulated),
            "simulated_episodes": simulated,
            "truth_ratio": float(real.mean()), "truth_ratio_std": float(real.std()),
            "twin_ratio": float(in_twin.mean()), "located": len(located),
            "location_error_median_m": float(np.median(located)) if len(located) else np.nan,
            "location_error_worst_m": float(located.max()) if len(located) else np.nan,
            "evaluation_flights": number * run.flights, "learn_twin_s": self.learn_s,
            "round_s": 0.0})

    def _real_flights(self, learner: Learner, simulated: int) -> dict[str, float]:
        """Return the numbers of real flights by purpose, and the mean share that they collected.

        With a perfect twin, flights of training and of selection are real. The share is NaN for
        given measurements, and if the learner does not count what it collected.
        """
        if self.run.twin == "truth":
            counts = 0, simulated, learner.selection.flights
            collected = learner.training.collected + learner.selection.collected
            if learner.training.flights != simulated:
                collected = np.nan
        elif self.measured is not None:
            counts, collected = (len(self.measured.flights), 0, 0), np.nan
        else:
            assert self.reality is not None
            counts, collected = (self.flown, 0, 0), sum(self.reality.ratios)
        total = sum(counts)
        return {"real_episodes": total, **dict(zip(FLIGHTS, counts, strict=True)),
                "real_ratio": float(collected / total) if total else np.nan}

    def state(self, folder: Path) -> dict:
        """Return the state for a checkpoint, and write the twin into the run's folder."""
        tables, ratios = ([], []) if self.reality is None else (self.reality.tables,
                                                                self.reality.ratios)
        return {"rows": self.rows, "tables": tables, "ratios": ratios,
                "twin": None if self.twin is None else keep_twin(self.twin, folder)}

    def load_state(self, state: dict, path: Path, others: Collection[str]) -> None:
        """Restore the campaign from a checkpoint; raise Damaged if it is not of this campaign.

        The state may come from a stranger; the caller checks its parts `others`.
        """
        require(state, dict.fromkeys(("rows", "tables", "ratios", "twin", *others), ...))
        run, tables, ratios = self.run, state["tables"], [float(each) for each in state["ratios"]]
        self.rows += require_log(state["rows"], COUNTS, NUMBERS, MAX_NUMBER)
        if len(self.rows) > run.real_episodes or any(
                row["round"] != number for number, row in enumerate(self.rows, 1)):
            raise Damaged("rounds are too many, or not in order")
        flown = self.measured is None and run.twin != "truth"
        if (state["twin"] is None) != (run.twin == "truth") or bool(tables) != flown \
                or len(tables) > run.real_episodes or len(ratios) != len(tables):
            raise Damaged("the twin or its measurements are missing, or not of this run")
        if self.reality is not None:
            self.reality.tables += require_tables(tables, self.scene)
            self.reality.ratios += ratios
        if state["twin"] is not None:
            self._set_twin(stored_twin(state["twin"], path, self.scene))

    def _set_twin(self, twin: Twin) -> None:
        """Set the twin, and the device positions that the UAVs know by it."""
        self.twin = twin
        if not self._true_positions:
            self.known = Known.of(twin.devices)


@dataclass
class Reality:
    """Simulated real flights and their measurements.

    Attributes:
        scene: scene with the true positions.
        truth: radio map of the real world.
        assignment: see `make_mission`.
        noise_db: standard deviation of the receivers' measurement error [dB].
        seed: random seed of shadowing and noise.
        tables: table of measurements of each flight.
        ratios: share of all data that each flight collected.
    """

    scene: Scene
    truth: RadioMap
    assignment: str
    noise_db: float
    seed: int
    tables: list[pd.DataFrame] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)

    def mission(self, known: Known) -> Mission:
        """Return the mission in the truth's map, for UAVs that know these positions."""
        return make_mission(self.scene, self.truth, known, self.assignment)

    def fly(self, policy: Policy, known: Known) -> Flights:
        """Simulate one real flight, and store the readings of every device in every slot."""
        mission = self.mission(known)
        number = len(self.tables)
        rng = stream(self.seed, "real flight", number)
        flights = fly(Environment(mission, 1, rng), policy)
        self.tables.append(self._measured(flights, f"f{number}", rng))
        self.ratios += flights.ratio(mission).tolist()
        return flights

    def measurements(self) -> Measurements:
        """Return the measurements of all flights so far."""
        return Measurements(pd.concat(self.tables, ignore_index=True),
                            declared_devices(self.scene))

    def _measured(self, flights: Flights, name: str, rng: np.random.Generator) -> pd.DataFrame:
        """Return the readings of a flight as a table, with noise, blank below the limit."""
        config, lattice = self.scene.config, self.scene.lattice
        slots, frames = int(flights.length[0]), flights.frames
        before = len(self.tables) * flights.action.shape[1]
        time_s = config.mission.slot_s * (np.arange(slots) + before)
        tables = []
        for u, (uav, level) in enumerate(zip(config.uavs, levels_of(self.scene))):
            flown = slice(0, max(int((frames.battery[0, :slots, u] > 0).sum()), 1))
            cells = frames.cell[0, flown, u].astype(int)
            index = np.ravel_multi_index((np.full(len(cells), level), cells[:, 0], cells[:, 1]),
                                         lattice.shape)
            snr_db = frames.snr_db[0, flown, u].T.astype(float)
            gain_db = snr_db - config.radio.tx_power_dbm + config.radio.noise_dbm
            gain_db = gain_db + rng.normal(0, self.noise_db, gain_db.shape)
            gain_db[gain_db < config.gain_limit_db] = np.nan
            tables.append(link_table(self.scene, name, uav.uav, index, gain_db, time_s[flown],
                                     heading_deg(cells)))
        return pd.concat(tables, ignore_index=True)


def location_errors_m(scene: Scene, known: Known) -> np.ndarray:
    """Return the horizontal error of each unknown device's estimate [m]; NaN without one."""
    missing = np.nan, np.nan
    return np.array([
        np.hypot(*np.subtract(known.position_m.get(d.device, missing), (d.x_m, d.y_m)))
        for d in scene.config.devices if d.role == "unknown"])


def _summary(row: dict, run: RunSettings) -> str:
    """Return a short text about a round for the progress bar."""
    accuracy = ""
    if run.twin != "truth":
        accuracy = f", devices found to {row['location_error_median_m']:.1f} m"
    return f"round {row['round']}/{run.real_episodes}: {row['truth_ratio']:.3f} collected{accuracy}"
