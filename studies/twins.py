"""Accuracy of twins, and value of training in them: `quality`, `twin`."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marl.algorithm1 import Reality, location_errors_m, twin_mission
from marl.environment import Environment, Frame
from marl.figures import COLOURS, MARKERS
from marl.flights import Flights, evaluate, fly
from marl.heuristics import PATTERN, HeuristicPolicy
from marl.learner import make_learner
from marl.mission import Known, Mission
from marl.planner import PlanPolicy, plan
from marl.settings import PRESETS, LearnerSettings, RunSettings, stream
from radiotwin import (
    Measurements,
    RadioMap,
    Scene,
    Twin,
    close_loop,
    corrected_twin,
    fit_twin,
    fly_survey,
    score_map,
)
from radiotwin.runtime.console import progress
from studies import tables
from studies.runner import Study
from studies.tables import markdown, number, over_seeds, quantiles, with_sd, worlds

MODELS = {"nn": "segmented_nn", "segmented": "segmented_log_distance",
          "log-distance": "log_distance", "paths": "paths"}
"""Name of a twin -> model of `fit_twin`; `corrected` and `truth` besides."""
TWINS = {"nn": "segmented network (NN)", "segmented": "segmented log-distance",
         "log-distance": "log-distance", "paths": "ray-traced (paths over the map)",
         "corrected": "corrected (after `close-loop`)", "truth": "the truth"}
QUALITY = {"segmented_nn": "NN", "log_distance": "log-distance", "kriging": "kriging",
           "paths": "ray-traced twin"}
PUBLISHED = {("rbm", 5): "15 m; 10 % above 100 m", ("rbm", 1): "22 m; 38 % above 100 m"}
"""Median position error of the published code, by scene and real episodes."""
REPLAYS = 10  # of a sequence of actions in a twin, whose shadowing differs from time to time
LONG = {"episodes": 4000, "learner": PRESETS["fast"].model_copy(
    update={"epsilon_slots": 87_500}).model_dump(mode="json")}
"""Settings of a policy that is trained in one map."""


def quality_cases(seed: int) -> dict[str, dict]:
    """Return each model after 1 to 10 real episodes; paths, which take minutes, after 1 and 5."""
    return {f"{scene}-{model}": {
        "scene": scene, "truth": "traced", "model": model, "noise_db": 1.0,
        "survey_flights": [1, 5] if model == "paths" else [1, 2, 3, 5, 10]}
        for scene in ("rbm", "rdm") for model in QUALITY}


def judge_twin(seed: int, settings: dict) -> dict:
    """Learn a twin from more and more real flights, and compare it with the truth."""
    scene, truth = tables.load_world(settings)
    rows = []
    with progress(settings["model"], total=len(settings["survey_flights"])) as advance:
        for flights in settings["survey_flights"]:
            measured = _survey(scene, truth, flights, settings["noise_db"], seed)
            twin = fit_twin(measured, scene, model=settings["model"], seed=seed)
            rows.append({"real_episodes": flights, "links": len(measured.table)}
                        | _errors(twin, scene, truth))
            advance()
    return {"curve": pd.DataFrame(rows).to_dict("list")}


def twin_cases(seed: int) -> dict[str, dict]:
    """Return the same five real flights, six twins and one learner."""
    return {f"{scene}-{name}": LONG | {
        "scene": scene, "truth": "traced", "twin": name, "survey_flights": 5, "noise_db": 1.0,
        "planner_iterations": 60_000, "flights": 64, "replayed_flights": 20}
        for scene in ("rbm", "rdm") for name in TWINS}


def train_in(seed: int, settings: dict) -> dict:
    """Learn a twin from real flights, train and plan in it, fly in the truth.

    Returns:
        Shares that policy and plan collect in the map that they were made in and in the truth;
        `curve`: checks of the policy during training; `fidelity` (see there); errors of the twin.
    """
    scene, truth = tables.load_world(settings)
    measured = _survey(scene, truth, settings["survey_flights"], settings["noise_db"], seed)
    twin = _learnt(settings["twin"], seed, scene, measured)
    reality = Reality(scene, truth, "matching", settings["noise_db"], seed)
    run = RunSettings(algorithm="qmix", real_episodes=1, seed=seed, **{
        key: settings[key] for key in ("episodes", "flights", "planner_iterations")})
    learner = LearnerSettings.model_validate(settings["learner"])
    result, inside = train_and_fly(reality, twin, run, learner)
    if twin is not None:
        true = reality.mission(Known.truth(scene))
        result["fidelity"] = fidelity(true, inside, settings["replayed_flights"], seed)
        result |= _errors(twin, scene, truth)
    return result


def train_and_fly(reality: Reality, twin: Twin | None, run: RunSettings,
                  learner: LearnerSettings) -> tuple[dict[str, Any], Mission]:
    """Train and plan in a twin, or in the truth (None), and fly in the truth.

    Returns:
        `WHO_WHERE_ratio` for `trained`, `plan` and `twin`, `truth`; `curve`: checks during
        training; and the mission that was trained in.
    """
    known = Known.truth(reality.scene) if twin is None else Known.of(twin.devices)
    real = reality.mission(known)
    inside = real if twin is None else twin_mission(reality.scene, run, twin, known)
    trained, result = make_learner(run, learner, inside, 1), {}
    try:
        with progress(f"training, seed {run.seed}", total=run.episodes) as advance:
            checks = trained.prepare(inside, advance)
        planned = plan(inside, run.planner_iterations, run.seed).actions
        for who, policy in (("trained", trained.policy(stream(run.seed, "decisions", 0))),
                            ("plan", PlanPolicy(planned))):
            for where, mission in (("twin", inside), ("truth", real)):
                flown = evaluate(mission, policy, run.flights,
                                 stream(run.seed, f"{where} evaluation"))
                result[f"{who}_{where}_ratio"] = flown.ratio(mission).mean()
    finally:
        trained.close()
    return result | {"curve": {"episodes": [check["episodes"] for check in checks],
                               "ratio": [check["twin_ratio"] for check in checks]}}, inside


class Replayed:
    """Repeat actions (E, T, U) of earlier flights: as many, in missions where they are feasible."""

    def __init__(self, action: np.ndarray) -> None:
        self._action = action

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._slot = 0

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        self._slot += 1
        return self._action[:, self._slot - 1]


class Mixed:
    """Greedy flights with true positions, the first without random actions, the last all random."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._policies = [HeuristicPolicy(name, rng) for name in ("random", "greedy")]
        self._rng = rng

    def start(self, mission: Mission, flights: int) -> None:
        """Begin flights."""
        for policy in self._policies:
            policy.start(mission, flights)
        self._share = np.linspace(0, 1, flights)[:, None]

    def act(self, frame: Frame) -> np.ndarray:
        """Return the actions of a slot."""
        explores = self._rng.random(frame.battery.shape) < self._share
        return np.where(explores, *(policy.act(frame) for policy in self._policies))


def fidelity(real: Mission, twin: Mission, flights: int, seed: int) -> dict[str, float]:
    """Compare what the same `flights` sequences of actions collect in a twin and in the truth.

    Returns:
        Over the sequences, from greedy to random: `correlation` of the collected shares, `bias`
        (twin - truth), `rmse`; the same for the share from each device, with `device_` before.
    """
    def by_device(flown: Flights) -> np.ndarray:
        taken, served = np.zeros(flown.frames.data_units.shape[::2]), flown.frames.assigned
        flight, slot, uav = np.nonzero(served >= 0)
        np.add.at(taken, (flight, served[flight, slot, uav]), flown.collected[flight, slot, uav])
        return taken / flown.frames.data_units[:, 0]

    flown = fly(Environment(real, flights, stream(seed, "real flight")),
                Mixed(stream(seed, "decisions", 1)))
    here = np.mean([by_device(fly(
        Environment(twin, flights, stream(seed, "twin evaluation", index)), Replayed(flown.action)))
        for index in range(REPLAYS)], axis=0)
    there, found = by_device(flown), {}
    for prefix, one, other in (("", there.mean(axis=1), here.mean(axis=1)),
                               ("device_", there.ravel(), here.ravel())):
        found[f"{prefix}correlation"] = float(np.corrcoef(one, other)[0, 1])
        found[f"{prefix}bias"] = float((other - one).mean())
        found[f"{prefix}rmse"] = float(np.sqrt(np.mean((other - one) ** 2)))
    return found


def _survey(scene: Scene, truth: RadioMap, flights: int, noise_db: float,
            seed: int) -> Measurements:
    return fly_survey(scene, truth, flights=flights, pattern=PATTERN, seed=seed,
                      noise_db=0.0 if "sigma_db" in truth.dataset else noise_db)


def _learnt(name: str, seed: int, scene: Scene, measured: Measurements) -> Twin | None:
    """Return a twin of `TWINS`; None: the truth."""
    if name != "corrected":
        return fit_twin(measured, scene, model=MODELS[name], seed=seed) if name in MODELS else None
    with progress("closing the loop", total=None) as advance:
        return corrected_twin(
            close_loop(measured, scene, "auto", seed, lambda text: advance(1, text)), scene)


def _errors(twin: Twin, scene: Scene, truth: RadioMap) -> dict:
    scores = score_map("twin", twin.radio_map(scene), truth)
    rmse_db = {row["links"]: row["rmse_db"] for row in scores}
    return {"map_rmse_db": rmse_db["all"], "map_rmse_los_db": rmse_db["LoS"],
            "map_rmse_nlos_db": rmse_db["NLoS"],
            "location_errors_m": location_errors_m(scene, Known.of(twin.devices)).tolist()}


def _located(curves: pd.Series) -> list[tuple[float, float, float, float]]:
    """Return `quantiles` of the position errors of all seeds, by number of flights."""
    each = [curve["location_errors_m"] for curve in curves]
    return [quantiles(sum(errors_m, [])) for errors_m in zip(*each)]


def quality_table(rows: pd.DataFrame) -> str:
    """Return errors of map and positions by real episodes."""
    parts, names = [], [f"map_rmse_{links}db" for links in ("", "los_", "nlos_")]
    heads = ["model", "real episodes", "map RMSE, all / LoS / NLoS [dB]",
             "position error, median [m]", "90 %", "worst", "above 100 m",
             "published code, its map and truth", "seeds"]
    for title, scene, runs in worlds(rows):
        lines = []
        for name in (each for each in QUALITY if each in runs):
            curves = runs[name]["curve"]
            rmse_db = np.array([over_seeds(curves, y=each).mean for each in names]).T
            for flights, of_map_db, (median, most, worst, far) in zip(
                    curves.iloc[0]["real_episodes"], rmse_db, _located(curves)):
                published = PUBLISHED.get((scene, flights), "") if name == "segmented_nn" else ""
                lines.append([QUALITY[name], str(flights),
                              " / ".join(f"{each:.1f}" for each in of_map_db), f"{median:.1f}",
                              f"{most:.0f}", f"{worst:.0f}", f"{far:.0%}", published,
                              str(len(curves))])
        parts.append(markdown(heads, lines, title))
    return "\n\n".join(parts)


def twin_table(rows: pd.DataFrame) -> str:
    """Return what training and planning in each twin is worth."""
    parts = []
    heads = ["twin", "map RMSE [dB]", "position error, median / worst [m]", "correlation", "bias",
             "correlation by device", "policy in the twin", "**policy in the truth**",
             "plan in the twin", "**plan in the truth**", "seeds"]
    for title, _, runs in worlds(rows):
        lines = []
        for name, seeds in ((name, runs[name]) for name in TWINS if name in runs):
            errors_m: list = sum(seeds["location_errors_m"].dropna(), [])
            lines.append([
                TWINS[name], number(seeds["map_rmse_db"].mean(), 1),
                "{:.1f} / {:.0f}".format(*quantiles(errors_m)[::2]) if errors_m else "–",
                *(with_sd(seeds["fidelity"].dropna().str[key], 2)
                  for key in ("correlation", "bias", "device_correlation")),
                *(with_sd(seeds[f"{who}_{where}_ratio"])
                  for who in ("trained", "plan") for where in ("twin", "truth")), str(len(seeds))])
        parts.append(markdown(heads, lines, f"{title}, five real flights"))
    return "\n\n".join(parts) + (
        "\n\nCorrelation and bias (twin less truth) of the share that 20 sequences of actions, "
        "from greedy to random, collect in both.")


def quality_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw errors of the map and of positions against real episodes."""
    found = list(worlds(rows))
    figure, panels = tables.make_panels(2 * len(found), 2, 3.8)
    for left, right, (title, _, runs) in zip(panels[::2], panels[1::2], found):
        episodes: set[float] = set()
        for index, name in enumerate(name for name in QUALITY if name in runs):
            curve = over_seeds(runs[name]["curve"], y="map_rmse_db")
            tables.draw_line(left, curve, QUALITY[name], index)
            episodes |= set(curve.x)
            median, most, *_ = zip(*_located(runs[name]["curve"]))
            right.plot(curve.x, median, marker=MARKERS[index], markersize=4, color=COLOURS[index])
            right.plot(curve.x, most, ":", color=COLOURS[index])
        left.set(ylabel="RMSE of the map [dB]", ylim=(0, None))
        right.set(ylabel="error of positions [m]: median, dotted 90 %", yscale="log")
        for axes in (left, right):
            axes.set(xlabel="real episodes", xscale="log", title=title)
            axes.set_xticks(sorted(episodes), [f"{x:.0f}" for x in sorted(episodes)], minor=False)
            axes.set_xticks([], minor=True)
            axes.grid(True, alpha=0.3)
    return {"quality": tables.with_legend(figure, panels, 3)}


def twin_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw what policy and plan collect in the truth, by the twin that they were made in."""
    found = list(worlds(rows))
    figure, panels = tables.make_panels(len(found), 2, 4.1)
    for axes, (title, _, runs) in zip(panels, found):
        names = [name for name in TWINS if name in runs]
        cells = {label: [runs[name][f"{key}_truth_ratio"] for name in names]
                 for key, label in (("trained", "policy (QMIX)"), ("plan", "planner"))}
        errors = {label: [tables.sd(each) for each in values] for label, values in cells.items()}
        tables.draw_bars(axes, cells, errors, [name.replace("-", "-\n") for name in names],
                         title=title, xlabel="twin that it was trained or planned in")
    return {"twin": tables.with_legend(figure, panels, 2)}


STUDIES = {
    "quality": Study("How good is the twin after how many real episodes?", judge_twin,
                     quality_cases, quality_table, quality_figures),
    "twin": Study("Which twin is worth training in?", train_in, twin_cases, twin_table,
                  twin_figures)}
