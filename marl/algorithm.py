"""Algorithm 1 of the paper: fly for real, learn the twin from what was measured, train in the twin, and again."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marl.checkpoint import folder_content, load_checkpoint, restore_folder, save_checkpoint
from marl.flights import Flights, HeuristicPolicy, Policy
from marl.mission import Known
from marl.planner import PlanPolicy, plan
from marl.randomness import stream
from marl.reality import Reality, known_by, learn_twin, location_errors_m
from marl.settings import LearnerSettings, RunSettings
from marl.strategies import Strategy, evaluate, make_strategy
from marl.waypoints import waypoint_actions
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.twin import Twin


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a run ends with.

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


def run_algorithm(run: RunSettings, learner: LearnerSettings, scene: Scene, truth: RadioMap, folder: Path | None,
                  resume: bool, on_round: Callable[[list[dict], list[dict]], None], advance: Callable[..., None],
                  device: str = "cpu") -> Outcome:
    """Alternate real flights and training in the twin.

    With a perfect twin (`run.twin == "truth"`) nothing needs to be measured: every episode of training is a real one.

    Args:
        run, learner: settings.
        scene: what is known of the world; its devices' true positions are not looked at unless `run` says so.
        truth: map of the real world.
        folder: for the checkpoint, written after every round; None for none.
        resume: go on from the checkpoint.
        on_round: called after every round with all rows and blocks so far.
        advance: called with the number of episodes simulated, and with a text about the last round.
        device: torch device.

    Returns:
        the same to the bit, whether it was interrupted or not (on the CPU)

    Raises:
        BadInput: a damaged checkpoint, or what `fit_twin` and `make_mission` refuse.
    """
    noise_db = 0.0 if "sigma_db" in truth.dataset else run.noise_db  # shadowing already stands for it
    reality = Reality(scene, truth, run.assignment, noise_db, run.seed)
    known = Known.truth(scene) if run.twin == "truth" or run.privileged else Known.anchors(scene)
    strategy = make_strategy(run, learner, reality.mission(known), run.real_episodes, device)
    checkpoint = folder / "checkpoint.pt" if folder else None
    rows, blocks, twin = [], [], None
    try:
        # A run that was stopped before its first checkpoint starts again.
        if resume and folder and checkpoint and checkpoint.is_file():
            state = load_checkpoint(checkpoint)
            rows, blocks, reality.tables = state["rows"], state["blocks"], state["tables"]
            strategy.load_state(state["strategy"])
            if run.twin != "truth":
                restore_folder(state["twin"], folder / "twin")
                twin = Twin.load(folder / "twin")
                known = known if run.privileged else known_by(twin)
            advance(run.episodes * len(rows), _summary(rows[-1], run))
            on_round(rows, blocks)  # the run may have been stopped between the checkpoint and the log
        for number in range(len(rows), run.real_episodes):
            started = time.perf_counter()
            rng = stream(run.seed, "decisions", number)
            if run.twin == "truth":
                mission = reality.mission(known)
            else:
                reality.fly(_measuring(run, reality, twin, known, strategy, rng), known)
                twin = learn_twin(reality, run.twin, run.seed, twin)
                known = known if run.privileged else known_by(twin)
                lasting = reality.measurements() if run.twin_shadowing == "fitted" else None
                mission = reality.twin_mission(twin, known, lasting)
            learned_s = time.perf_counter() - started
            blocks += [{"round": number + 1} | block for block in strategy.prepare(mission, advance)]
            in_twin = np.full(1, np.nan)
            if twin is not None:
                flights = evaluate(mission, strategy.policy(rng), run.flights, stream(run.seed, "twin evaluation"))
                in_twin = flights.ratio(mission)
            real = reality.mission(known)
            flights = evaluate(real, strategy.policy(rng), run.flights, stream(run.seed, "truth evaluation"))
            found = known if twin is None else known_by(twin)
            rows.append(_row(run, strategy, real.uavs, number + 1, in_twin, flights.ratio(real),
                             location_errors_m(scene, found))
                        | {"evaluation_flights": (number + 1) * run.flights, "learn_twin_s": learned_s,
                           "round_s": time.perf_counter() - started})
            advance(0, _summary(rows[-1], run))
            if folder and checkpoint:
                state = {"rows": rows, "blocks": blocks, "tables": reality.tables,
                         "strategy": strategy.state(last=number + 1 == run.real_episodes)}
                if twin is not None:
                    twin.save(folder / "twin")
                    state["twin"] = folder_content(folder / "twin")
                save_checkpoint(state, checkpoint)
            on_round(rows, blocks)
        real = reality.mission(known)
        policy = strategy.policy(stream(run.seed, "decisions", run.real_episodes - 1))
        flights = evaluate(real, policy, run.flights, stream(run.seed, "truth evaluation"))
        return Outcome(rows, blocks, flights, known, twin)
    finally:
        strategy.close()


def _measuring(run: RunSettings, reality: Reality, twin: Twin | None, known: Known, strategy: Strategy,
               rng: np.random.Generator) -> Policy:
    """What flies the next real episode."""
    how = run.measure if twin is not None else run.first_flight
    if how == "waypoints":
        return PlanPolicy(waypoint_actions(reality.scene, reality.mission(known), rng))
    if twin is None:
        return HeuristicPolicy("random", rng)
    if how == "planner":
        return PlanPolicy(plan(reality.twin_mission(twin, known), run.planner_iterations, run.seed).actions)
    return strategy.policy(rng)


def _row(run: RunSettings, strategy: Strategy, uavs: int, number: int, in_twin: np.ndarray, real: np.ndarray,
         errors_m: np.ndarray) -> dict:
    simulated = number * run.episodes * {"fedqmix": uavs, "qmix": 1, "iql": 1}.get(run.algorithm, 0)
    located = errors_m[np.isfinite(errors_m)]
    return {
        "round": number,
        # In the truth, what is flown to choose between policies is real, too.
        "real_episodes": simulated + strategy.selection_flights if run.twin == "truth" else number,
        "simulated_episodes": simulated,
        "truth_ratio": float(real.mean()), "truth_ratio_std": float(real.std()), "twin_ratio": float(in_twin.mean()),
        "located": len(located),
        "location_error_median_m": float(np.median(located)) if len(located) else np.nan,
        "location_error_worst_m": float(located.max()) if len(located) else np.nan,
    }


def _summary(row: dict, run: RunSettings) -> str:
    """A round in a few words, for the progress bar."""
    where = "" if run.twin == "truth" else f", devices found to {row['location_error_median_m']:.1f} m"
    return f"round {row['round']}/{run.real_episodes}: {row['truth_ratio']:.3f} collected{where}"
