"""Algorithm 1 and what it is compared with: `curve`, `federation`, `tuning`."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pydantic import BaseModel

from marl.algorithm1 import run_algorithm
from marl.environment import Frame
from marl.figures import LEVEL_STYLES, choose_flight, trajectories_figure
from marl.flights import Flights
from marl.mission import Known, make_mission
from marl.settings import PRESETS, RUNS, LearnerSettings, RunSettings, learner_class
from radiotwin import Scene, segmented_truth
from radiotwin.runtime.console import progress
from radiotwin.runtime.cuda import torch_device
from studies import tables
from studies.runner import Study
from studies.tables import RATIO, Curve, last, markdown, number, over_seeds, with_sd, worlds

CITIES = ("rbm", "rdm")
PAPER_MAPS = ("runs/paper_rbm", "runs/paper_rdm")  # made by studies.paper_maps
LABELS = {"fedqmix-nn": "model-aided FedQMIX", "qmix-nn": "model-aided QMIX",
          "qmix-log-distance": "model-aided QMIX, log-distance twin",
          "qmix-truth": "QMIX on real episodes", "fedqmix-paths": "FedQMIX, ray-traced twin",
          "iql-truth": "IQL on real episodes", "planner-nn": "planner in the NN twin",
          "planner-paths": "planner in the ray-traced twin",
          "greedy": "greedy, distinct targets, true positions", "random": "random"}
LEVELS = ("greedy", "random")  # need no real episode
ENOUGH = 0.95  # of what both learners reach at least
PLANNER_ITERATIONS = 60_000  # of the rows that are kept


def _own(model: type[BaseModel], values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name in model.model_fields}


def learn(seed: int, settings: dict) -> dict:
    """Run Algorithm 1 with fields of `RunSettings` and `LearnerSettings`.

    Returns:
        `curve`: columns, a value for each round; for the picture of FedQMIX, seed 0, `known_m`:
        positions that the UAVs know at the end, and `flight`: the median one at the end.
    """
    values = settings | {"scene": tables.scene_folder(settings["scene"]), "seed": seed}
    run = RunSettings(**_own(RunSettings, values))
    learner = LearnerSettings(**_own(LearnerSettings, values))
    scene, truth = tables.load_world(settings)
    truth.require_made_for(scene)
    total = run.real_episodes * run.episodes
    with progress(f"{run.algorithm}, seed {seed}", total=total) as advance:
        outcome = run_algorithm(run, learner, scene, truth, None, False, lambda rows, blocks: None,
                                advance, torch_device(run.device))
    result: dict[str, Any] = {"curve": pd.DataFrame(outcome.rows).to_dict("list")}
    if run.algorithm == "fedqmix" and seed == 0:
        flights = outcome.flights
        which = choose_flight(flights, make_mission(scene, truth, outcome.known, run.assignment))
        arrays = {name: getattr(flights.frames, name) for name in ("cell", "battery", "assigned")}
        arrays["collected"] = np.round(flights.collected.astype(float), 1)
        result |= {"known_m": outcome.known.position_m,
                   "flight": {name: array[which, :int(flights.length[which])].tolist()
                              for name, array in arrays.items()}}
    return result


def case(scene: str, truth: str, algorithm: str, twin: str = "nn", **changes: Any) -> dict:
    """Return the settings of a row: those of a preset (`fast`), and what is changed in them."""
    preset = changes.get("preset", "fast")
    fixed = {"truth": truth, "twin": twin, "algorithm": algorithm,
             "planner_iterations": PLANNER_ITERATIONS}
    run = RunSettings(**fixed | RUNS[preset] | _own(RunSettings, changes))
    settings = run.model_dump(mode="json", exclude={"seed", "compare"}) | {"scene": scene}
    learner = PRESETS[preset].model_copy(update=_own(LearnerSettings, changes))
    return settings | (learner.model_dump() if learner_class(algorithm).learns else {})


def named_cases(scenes: tuple[str, ...], truth: str, kinds: dict[str, dict[str, Any]]
                ) -> dict[str, dict]:
    """Return rows of all scenes, kinds being `case`'s other arguments by name."""
    return {f"{Path(scene).name}-{truth}-{name}": case(scene, truth, **changes)
            for scene in scenes for name, changes in kinds.items()}


def curve_cases(seed: int) -> dict[str, dict]:
    """Return all algorithms in the ray-traced cities and on the paper's maps."""
    in_truth, after_one = {"twin": "truth"}, {"twin": "paths", "real_episodes": 1}
    kinds: dict[str, dict[str, Any]] = {
        "fedqmix-nn": {"algorithm": "fedqmix"}, "qmix-nn": {"algorithm": "qmix"},
        "qmix-log-distance": {"algorithm": "qmix", "twin": "log-distance"},
        "qmix-truth": {"algorithm": "qmix"} | in_truth,
        "iql-truth": {"algorithm": "iql"} | in_truth,
        "planner-nn": {"algorithm": "planner"},
        **{name: {"algorithm": name, "real_episodes": 1} | in_truth for name in LEVELS}}
    traced = kinds | {"planner-paths": {"algorithm": "planner"} | after_one,
                      "fedqmix-paths": {"algorithm": "fedqmix", "episodes": 8000} | after_one}
    return named_cases(CITIES, "traced", traced) | named_cases(PAPER_MAPS, "segmented", kinds)


def federation_cases(seed: int) -> dict[str, dict]:
    """Return FedQMIX and QMIX at equal simulated episodes of a replica, in all, and in equal time.

    Exploration fades over the same share of training in all. Equal time is that of one core (equal
    in all), of three or more (equal of a replica), and of two, where three replicas take 1.6 times
    as long as one (study `speed`: 3 / 1.87).
    """
    episodes = {"fedqmix-3x800": 800, "qmix-800": 800, "fedqmix-3x267": 267, "qmix-1280": 1280,
                "qmix-2400": 2400, "fedqmix-3x800-weights": 800}
    return named_cases(CITIES, "segmented", {name: {
        "algorithm": name.split("-")[0], "episodes": count,
        "federate_all": not name.endswith("weights"),
        "epsilon_slots": round(PRESETS["fast"].epsilon_slots * count / 800)}
        for name, count in episodes.items()})


def tuning_cases(seed: int) -> dict[str, dict]:
    """Return one change at a time; the rows `earlier` are changes of what the preset was before.

    The record has rows of options, too, that did not pay and that version 0.1 had.
    """
    slot, policy = {"twin_shadowing": "slot"}, {"measure": "policy"}
    earlier = policy | slot | {"first_flight": "random"}
    kinds: dict[str, dict] = {
        "as-it-is": {}, "shadowing-slot": slot, "measure-policy": policy, "earlier": earlier,
        "earlier-excursions-1": earlier | {"excursion_slots": 1.0}}
    return named_cases(CITIES, "traced", {name: {"algorithm": "qmix"} | changes
                                          for name, changes in kinds.items()})


def curve_table(rows: pd.DataFrame) -> str:
    """Return what is collected at the end, and the real episodes that the same ratio takes."""
    parts = []
    for title, runs in worlds(rows):
        curves = {name: over_seeds(runs[name]["curve"]) for name in LABELS if name in runs}
        target, lines = common_ratio(curves), []
        for name, curve in curves.items():
            episodes = [curve.x[-1], curve.needed(target)]
            episodes = ["" if name in LEVELS else number(each, 0) for each in episodes]
            lines.append([LABELS[name], episodes[0], with_sd(last(runs[name]["curve"])),
                          episodes[1], str(len(runs[name])),
                          number(runs[name]["cpu_s"].mean(), 0)])
        heads = ["", "real episodes", "collected at the end", f"real episodes to {target:.3f}",
                 "seeds", "CPU s each"]
        parts.append(markdown(heads, lines, title) + factors(curves, target))
    return "\n\n".join(parts) + (
        '\n\n±: standard deviation over seeds. "Real episodes to": the first round whose mean over '
        f"seeds is as high; the ratio is {ENOUGH:.0%} of what both model-aided FedQMIX and QMIX on "
        "real episodes reach at least. Rounds of training in the truth are 800 episodes and the "
        "flights that choose the policy, so there that column is an upper bound.")


def common_ratio(curves: dict[str, Curve]) -> float:
    """Return a ratio that the learners with and without a twin both reach."""
    tops = [curves[name].mean.max() for name in ("fedqmix-nn", "qmix-truth") if name in curves]
    return ENOUGH * float(min(tops)) if tops else np.nan


def factors(curves: dict[str, Curve], target: float) -> str:
    """Return how many times as many real episodes QMIX needs without a twin."""
    real = curves["qmix-truth"].needed(target) if "qmix-truth" in curves else np.nan
    needed = {name: curve.needed(target) for name, curve in curves.items()
              if not name.endswith("-truth") and name not in LEVELS}
    texts = [f"{LABELS[name]} {count:.0f} (a factor of {real / count:,.0f})" if count == count else
             f"{LABELS[name]} does not reach it in {curves[name].x[-1]:.0f}"
             for name, count in needed.items()]
    return (f"\n\nQMIX without a twin takes {real:,.0f} or fewer for {target:.3f}; "
            f"{'; '.join(texts)}.") if texts and real == real else ""


def federation_table(rows: pd.DataFrame) -> str:
    """Return FedQMIX and QMIX by simulated episodes."""
    heads = ["", "episodes of a replica", "simulated in all", "CPU s", "collected", "seeds"]
    parts = []
    for title, runs in worlds(rows):
        lines = {}
        for name, seeds in runs.items():
            settings = seeds["settings"].iloc[0]
            simulated = last(seeds["curve"], "simulated_episodes")[0]
            lines[simulated, name] = [
                name, f"{settings['episodes'] * settings['real_episodes']:,}", f"{simulated:,}",
                number(seeds["cpu_s"].mean(), 0), with_sd(last(seeds["curve"])), str(len(seeds))]
        parts.append(markdown(heads, [lines[key] for key in sorted(lines)],
                              f"{title}, 10 real episodes"))
    return "\n\n".join(parts) + (
        "\n\nEqual for a replica: `fedqmix-3x800` and `qmix-800` (equal time where there are three "
        "cores). Equal in all: `fedqmix-3x267` and `qmix-800`, `fedqmix-3x800` and `qmix-2400` "
        "(equal time on one core). Equal time on two cores: `fedqmix-3x800` and `qmix-1280`. "
        "`weights`: moments and target networks are not averaged.")


def options(settings: dict, hidden: tuple[str, ...] = ("scene", "truth", "algorithm"),
            **changed: Any) -> str:
    """Return the settings that differ from the defaults (some `changed`), as options."""
    defaults = RunSettings(planner_iterations=PLANNER_ITERATIONS).model_dump(mode="json") \
        | LearnerSettings().model_dump() | changed
    given = [f"--{name.replace('_', '-')} {str(value).lower()}" for name, value in settings.items()
             if name not in hidden and value != defaults.get(name)]
    return f"`{' '.join(given)}`" if given else "as it is"


def tuning_table(rows: pd.DataFrame) -> str:
    """Return one change at a time."""
    heads = ["options", "collected", "in the twin", "worst position error at the end [m]", "seeds"]
    return "\n\n".join(markdown(heads, [
        [options(seeds["settings"].iloc[0]),
         *(with_sd(last(seeds["curve"], column)) for column in ("truth_ratio", "twin_ratio")),
         f"{np.mean(last(seeds['curve'], 'location_error_worst_m')):,.0f}", str(len(seeds))]
        for seeds in runs.values()], f"{title}, model-aided QMIX")
        for title, runs in worlds(rows))


def curve_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw collected data against real episodes, a panel a world; and the flights of FedQMIX."""
    found = list(worlds(rows))
    figure, panels = tables.make_panels(len(found), 2, 4.1)
    for axes, (title, runs) in zip(panels, found):
        for index, name in enumerate(name for name in LABELS if name not in LEVELS):
            if name in runs:
                tables.draw_line(axes, over_seeds(runs[name]["curve"]), LABELS[name], index)
        for style, name in zip(LEVEL_STYLES, LEVELS):
            if name in runs:
                axes.axhline(float(np.mean(last(runs[name]["curve"]))), color="black",
                             linestyle=style, linewidth=1.1, label=LABELS[name])
        axes.set(xscale="log", ylim=(0, 1.02), xlabel="real episodes", ylabel=RATIO, title=title)
    flown = rows[rows["name"].str.endswith("-traced-fedqmix-nn") & (rows["seed"] == 0)]
    return {"curve": tables.with_legend(figure, panels, 3)} | {
        f"trajectories-{row.settings['scene']}": _draw_flight(row) for row in flown.itertuples()}


def _draw_flight(row: Any) -> Figure:
    scene, known = Scene.load(tables.scene_folder(row.settings["scene"])), Known(row.known_m)
    mission = make_mission(scene, segmented_truth(scene), known)
    flown = {name: np.array(values)[None] for name, values in row.flight.items()}
    slots, devices = flown["cell"].shape[1], mission.devices
    # What the picture does not show is left empty.
    frames = Frame(flown["cell"], flown["battery"], np.zeros((1, slots, mission.uavs, devices)),
                   np.broadcast_to(mission.data_units, (1, slots, devices)), flown["assigned"])
    flights = Flights(frames, np.zeros(flown["assigned"].shape, np.int8), flown["collected"],
                      np.array([slots], dtype=np.int32))
    figure = trajectories_figure(scene, mission, flights, 0, known)
    figure.set_dpi(80)  # keeps the picture below 200 kB
    return figure


def federation_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw collected data over the episodes of a replica, and over all."""
    found = list(worlds(rows))
    figure, panels = tables.make_panels(2 * len(found), 2, 4.1)
    for row, (title, runs) in enumerate(found):
        for axes, of in zip(panels[2 * row:], ("a replica", "all replicas")):
            for index, (name, seeds) in enumerate(runs.items()):
                curve = over_seeds(seeds["curve"], x="simulated_episodes")
                share = 3 if name.startswith("fedqmix") and of == "a replica" else 1
                tables.draw_line(axes, curve._replace(x=curve.x / share), name, index)
            axes.set(xlabel=f"simulated episodes of {of}", ylabel=RATIO, title=title)
    return {"federation": tables.with_legend(figure, panels, 3)}


STUDIES = {
    "curve": Study("How much is collected after how many real episodes?", learn, curve_cases,
                   curve_table, curve_figures),
    "federation": Study("Does averaging replicas pay?", learn, federation_cases, federation_table,
                        federation_figures),
    "tuning": Study("What brings the learner nearer to the planner?", learn, tuning_cases,
                    tuning_table)}
