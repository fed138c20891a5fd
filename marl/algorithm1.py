"""Algorithm 1 of the paper: fly, learn the twin from the measurements, train in it, and repeat."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from marl.checkpoint import NAME, keep_twin, restored, save_checkpoint
from marl.environment import Environment
from marl.flights import Flights, Policy, evaluate, fly
from marl.heuristics import HeuristicPolicy, waypoint_actions
from marl.learner import Learner, make_learner
from marl.mission import Known, Mission, make_mission
from marl.planner import PlanPolicy
from marl.settings import LearnerSettings, RunSettings, stream
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import declared_devices, heading_deg, link_table
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin.shadowing import with_shadowing

TWINS = {"nn": "segmented_nn", "log-distance": "log_distance", "kriging": "regression_kriging",
         "raytrace": "raytrace", "path-kriging": "path_kriging"}
"""Name of a twin on the command line -> model of `fit_twin`."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a run.

    Attributes:
        rows: one for every round; the columns are explained in `docs/marl.md`.
        blocks: records of training, several a round.
        flights: the evaluation in the truth at the end.
        known: positions that the UAVs knew in it.
        twin: the last one; None where none was needed.
    """

    rows: list[dict]
    blocks: list[dict]
    flights: Flights
    known: Known
    twin: Twin | None


def run_algorithm(run: RunSettings, learner_settings: LearnerSettings, scene: Scene,
                  truth: RadioMap, folder: Path | None, resume: bool,
                  on_round: Callable[[list[dict], list[dict]], None],
                  on_progress: Callable[..., None], device: str = "cpu") -> Outcome:
    """Alternate real flights and training in the twin.

    With a perfect twin (`run.twin == "truth"`) nothing needs to be measured: every training
    episode is a real one.

    Args:
        run: settings of the run.
        learner_settings: settings of learning.
        scene: the true positions of its unknown devices are not used unless `run` says so.
        truth: map of the real world.
        folder: for the checkpoint, written after every round; None for none.
        resume: go on from the checkpoint.
        on_round: called after every round with all rows and blocks so far.
        on_progress: called with the number of episodes simulated since the last call, and with a
            text about the last round.
        device: torch device.

    Returns:
        The same to the bit, whether it was interrupted or not (on the CPU).

    Raises:
        BadInput: a damaged checkpoint, or input that `fit_twin` or `make_mission` refuses.
    """
    # The shadowing of a truth includes the receivers' noise.
    noise_db = 0.0 if "sigma_db" in truth.dataset else run.noise_db
    reality = Reality(scene, truth, run.assignment, noise_db, run.seed)
    true_positions = run.twin == "truth" or run.privileged
    known = Known.truth(scene) if true_positions else Known.anchors(scene)
    learner = make_learner(run, learner_settings, reality.mission(known), run.real_episodes,
                           device)
    checkpoint = folder / NAME if folder else None
    rows: list[dict] = []
    blocks: list[dict] = []
    twin: Twin | None = None
    try:
        # A run that was stopped before its first checkpoint starts again.
        if resume and folder and (folder / NAME).exists():
            rows, blocks, reality.tables, twin = restored(folder / NAME, run, scene, learner)
            if twin is not None:
                twin.save(folder / "twin")
                known = known if true_positions else Known.of(twin.devices)
            on_progress(run.episodes * len(rows), _summary(rows[-1], run))
            # The run may have been stopped between the checkpoint and the log.
            on_round(rows, blocks)
        for number in range(len(rows), run.real_episodes):
            started = time.perf_counter()
            rng = stream(run.seed, "decisions", number)
            if run.twin == "truth":
                mission = reality.mission(known)
            else:
                reality.fly(measuring_policy(run, reality, twin, known, learner, rng), known)
                measured = reality.measurements()
                twin = fit_twin(measured, scene, model=TWINS[run.twin], seed=run.seed, start=twin)
                known = known if true_positions else Known.of(twin.devices)
                mission = twin_mission(scene, run, twin, known, measured)
            learned_s = time.perf_counter() - started
            blocks += [{"round": number + 1} | block
                       for block in learner.prepare(mission, on_progress)]
            in_twin = np.full(1, np.nan)
            if twin is not None:
                flights = evaluate(mission, learner.policy(rng), run.flights,
                                   stream(run.seed, "twin evaluation"))
                in_twin = flights.ratio(mission)
            real = reality.mission(known)
            flights = evaluate(real, learner.policy(rng), run.flights,
                               stream(run.seed, "truth evaluation"))
            found = known if twin is None else Known.of(twin.devices)
            rows.append(round_row(run, learner, number + 1, in_twin, flights.ratio(real),
                                  location_errors_m(scene, found))
                        | {"evaluation_flights": (number + 1) * run.flights,
                           "learn_twin_s": learned_s, "round_s": time.perf_counter() - started})
            on_progress(0, _summary(rows[-1], run))
            if folder and checkpoint:
                state = {"rows": rows, "blocks": blocks, "tables": reality.tables,
                         "strategy": learner.state(last=number + 1 == run.real_episodes)}
                if twin is not None:
                    state["twin"] = keep_twin(twin, folder)
                save_checkpoint(state, checkpoint)
            on_round(rows, blocks)
        real = reality.mission(known)
        policy = learner.policy(stream(run.seed, "decisions", run.real_episodes - 1))
        flights = evaluate(real, policy, run.flights, stream(run.seed, "truth evaluation"))
        return Outcome(rows, blocks, flights, known, twin)
    finally:
        learner.close()


@dataclass
class Reality:
    """Real flights, and what was measured on them.

    Args:
        scene: its anchors are known, its unknown devices are not.
        truth: radio map that decides what UAVs receive.
        assignment: see `make_mission`.
        noise_db: standard deviation of the receivers' measurement error [dB].
        seed: of shadowing and noise.
        tables: measurements so far, one table for each flight.
    """

    scene: Scene
    truth: RadioMap
    assignment: str
    noise_db: float
    seed: int
    tables: list[pd.DataFrame] = field(default_factory=list)

    def mission(self, known: Known) -> Mission:
        """Return the mission in the truth, for UAVs that know these positions."""
        return make_mission(self.scene, self.truth, known, self.assignment)

    def fly(self, policy: Policy, known: Known) -> Flights:
        """Fly one real episode and keep the measurements of every device in every slot."""
        mission = self.mission(known)
        number = len(self.tables)
        rng = stream(self.seed, "real flight", number)
        flights = fly(Environment(mission, 1, rng), policy)
        self.tables.append(self._measured(flights, f"f{number}", rng))
        return flights

    def measurements(self) -> Measurements:
        """Return all measurements so far."""
        return Measurements(pd.concat(self.tables, ignore_index=True),
                            declared_devices(self.scene))

    def _measured(self, flights: Flights, name: str, rng: np.random.Generator) -> pd.DataFrame:
        config, lattice = self.scene.config, self.scene.lattice
        slots, frames = int(flights.length[0]), flights.frames
        before = len(self.tables) * flights.action.shape[1]
        time_s = config.mission.slot_s * (np.arange(slots) + before)
        tables = []
        for u, uav in enumerate(config.uavs):
            flown = slice(0, max(int((frames.battery[0, :slots, u] > 0).sum()), 1))
            cells = frames.cell[0, flown, u].astype(int)
            level = int(np.abs(lattice.z_m - uav.altitude_m).argmin())
            index = np.ravel_multi_index((np.full(len(cells), level), cells[:, 0], cells[:, 1]),
                                         lattice.shape)
            snr_db = frames.snr_db[0, flown, u].T.astype(float)
            gain_db = snr_db - config.radio.tx_power_dbm + config.radio.noise_dbm
            gain_db = gain_db + rng.normal(0, self.noise_db, gain_db.shape)
            gain_db[gain_db < config.gain_limit_db] = np.nan
            tables.append(link_table(self.scene, name, uav.uav, index, gain_db, time_s[flown],
                                     heading_deg(cells)))
        return pd.concat(tables, ignore_index=True)


def twin_mission(scene: Scene, run: RunSettings, twin: Twin, known: Known,
                 measurements: Measurements | None) -> Mission:
    """Return the mission in a twin.

    Args:
        scene: of the twin.
        run: settings of the run.
        twin: it gives the map.
        known: positions that the UAVs know.
        measurements: errors of the map last as long as their residuals say; None: for a slot.
    """
    radio_map = twin.radio_map(scene)
    if measurements is not None and run.twin_shadowing == "fitted":
        radio_map = with_shadowing(radio_map, twin, measurements, scene.config.gain_limit_db,
                                   run.seed)
    return make_mission(scene, radio_map, known, run.assignment)


def location_errors_m(scene: Scene, known: Known) -> np.ndarray:
    """Return the distance of each unknown device's estimate from its true position [m].

    NaN where there is no estimate.
    """
    nowhere = np.nan, np.nan
    return np.array([
        np.hypot(*np.subtract(known.position_m.get(d.device, nowhere), (d.x_m, d.y_m)))
        for d in scene.config.devices if d.role == "unknown"])


def measuring_policy(run: RunSettings, reality: Reality, twin: Twin | None, known: Known,
                     learner: Learner, rng: np.random.Generator) -> Policy:
    """Return the policy of the next real episode."""
    how = run.measure if twin is not None else run.first_flight
    if how == "waypoints":
        return PlanPolicy(waypoint_actions(reality.scene, reality.mission(known), rng))
    return HeuristicPolicy("random", rng) if twin is None else learner.policy(rng)


def round_row(run: RunSettings, learner: Learner, number: int, in_twin: np.ndarray,
              real: np.ndarray, errors_m: np.ndarray) -> dict:
    """Return the row of a round (from 1) in the log.

    Args:
        run: settings of the run.
        learner: that has been prepared in so many rounds.
        number: of the round.
        in_twin: (E,) shares collected in the twin.
        real: (E,) shares collected in the truth.
        errors_m: see `location_errors_m`.
    """
    simulated = number * run.episodes * learner.replicas
    located = errors_m[np.isfinite(errors_m)]
    return {
        "round": number,
        # In the truth, flights that choose between policies are real, too.
        "real_episodes": simulated + learner.selection_flights if run.twin == "truth" else number,
        "simulated_episodes": simulated,
        "truth_ratio": float(real.mean()), "truth_ratio_std": float(real.std()),
        "twin_ratio": float(in_twin.mean()),
        "located": len(located),
        "location_error_median_m": float(np.median(located)) if len(located) else np.nan,
        "location_error_worst_m": float(located.max()) if len(located) else np.nan,
    }


def _summary(row: dict, run: RunSettings) -> str:
    """Return a short text about a round, for the progress bar."""
    where = ""
    if run.twin != "truth":
        where = f", devices found to {row['location_error_median_m']:.1f} m"
    return f"round {row['round']}/{run.real_episodes}: {row['truth_ratio']:.3f} collected{where}"
