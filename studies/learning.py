"""Algorithm 1 and what it is compared with: `curve`, `federation`, `tuning`, `options`."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marl.algorithm import run_algorithm
from marl.environment import Frame
from marl.figures import LEVEL_STYLES, choose_flight, trajectories_figure
from marl.flights import Flights
from marl.mission import Known, make_mission
from marl.settings import LEARNERS, PRESETS, RUNS, LearnerSettings, RunSettings
from marl.threads import torch_device
from radiotwin import Scene, segmented_truth
from radiotwin.progress import progress
from studies import tables
from studies.runner import Study
from studies.tables import RATIO, Curve, last, markdown, number, over_seeds, shown, with_sd, worlds

CITIES = ("rbm", "rdm")
PAPER_MAPS = ("runs/paper_rbm", "runs/paper_rdm")  # made by studies.paper_maps
LABELS = {"fedqmix-nn": "model-aided FedQMIX", "qmix-nn": "model-aided QMIX",
          "qmix-log-distance": "model-aided QMIX, log-distance twin",
          "qmix-truth": "QMIX on real episodes", "fedqmix-raytrace": "FedQMIX, ray-traced twin",
          "iql-truth": "IQL on real episodes", "planner-nn": "planner in the NN twin",
          "planner-raytrace": "planner in the ray-traced twin",
          "greedy": "greedy, distinct targets, true positions", "random": "random"}
LEVELS = ("greedy", "random")  # need no real episode
ENOUGH = 0.95  # of what both learners reach at least


def learn(seed: int, settings: dict) -> dict:
    """Run Algorithm 1.

    Args:
        seed: of everything random.
        settings: fields of `RunSettings` and `LearnerSettings`.

    Returns:
        `curve`: columns, a value for each round; for the picture of FedQMIX, seed 0, `known_m`:
        positions that the UAVs know at the end, and `flight`: the median one at the end.
    """
    own = {"scene": tables.scene_folder(settings["scene"]), "seed": seed}
    run, learner = (model.model_validate({name: value for name, value in (settings | own).items()
                                          if name in model.model_fields})
                    for model in (RunSettings, LearnerSettings))
    scene, truth = tables.load_world(settings)
    scene.check_map(truth)
    episodes = run.real_episodes * run.episodes
    with progress(f"{run.algorithm}, seed {seed}", total=episodes) as advance:
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
    run, learner = ({name: value for name, value in changes.items() if name in model.model_fields}
                    for model in (RunSettings, LearnerSettings))
    settings = RunSettings(truth=truth, twin=twin, algorithm=algorithm, **RUNS[preset] | run)
    learning = PRESETS[preset].model_copy(update={"mix": algorithm != "iql"} | learner)
    return settings.model_dump(mode="json", exclude={"seed", "compare"}) | {"scene": scene} | (
        learning.model_dump(mode="json") if algorithm in LEARNERS else {})


def named_cases(scenes: tuple[str, ...], truth: str, kinds: dict[str, dict]) -> dict[str, dict]:
    """Return rows of all scenes, kinds being `case`'s other arguments by name."""
    return {f"{Path(scene).name}-{truth}-{name}": case(scene, truth, **changes)
            for scene in scenes for name, changes in kinds.items()}


def curve_cases(seed: int) -> dict[str, dict]:
    """Return all algorithms in the ray-traced cities and on the paper's maps."""
    in_truth, after_one = {"twin": "truth"}, {"twin": "raytrace", "real_episodes": 1}
    kinds: dict[str, dict[str, Any]] = {
        "fedqmix-nn": {"algorithm": "fedqmix"}, "qmix-nn": {"algorithm": "qmix"},
        "qmix-log-distance": {"algorithm": "qmix", "twin": "log-distance"},
        "qmix-truth": {"algorithm": "qmix"} | in_truth,
        "iql-truth": {"algorithm": "iql"} | in_truth,
        "planner-nn": {"algorithm": "planner"},
        **{name: {"algorithm": name, "real_episodes": 1} | in_truth for name in LEVELS}}
    traced = kinds | {"planner-raytrace": {"algorithm": "planner"} | after_one,
                      "fedqmix-raytrace": {"algorithm": "fedqmix", "episodes": 8000} | after_one}
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
    """Return one change at a time; the rows `earlier` are changes of what the preset was before."""
    slot, policy, again = {"twin_shadowing": "slot"}, {"measure": "policy"}, {"fly_again": True}
    earlier = policy | slot | {"first_flight": "random"}
    kinds = {"as-it-is": {}, "shadowing-slot": slot, "measure-policy": policy,
             "measure-policy-fly-again": policy | again, "shadowing-slot-fly-again": slot | again,
             "measure-policy-shadowing-slot-fly-again": policy | slot | again, "earlier": earlier,
             "earlier-excursions-1": earlier | {"excursion_slots": 1.0},
             "earlier-fly-again": earlier | again,
             "earlier-restart-0.3": earlier | {"restart_epsilon": 0.3},
             "earlier-measure-planner": earlier | {"measure": "planner"}}
    return named_cases(CITIES, "traced", {name: {"algorithm": "qmix"} | changes
                                          for name, changes in kinds.items()})


BEFORE = {"first_flight": "random", "measure": "policy", "twin_shadowing": "slot",
          "excursion_slots": 1.0}
"""The defaults when the study `options` was made."""


def options_cases(seed: int) -> dict[str, dict]:
    """Return the learner's options, on top of the defaults of then."""
    qmix, plan = {"algorithm": "qmix"}, {"algorithm": "planner"}
    fixed = {"twin": "truth", "real_episodes": 1}
    aloof, greedy = {"algorithm": "random"} | fixed, {"algorithm": "greedy"} | fixed
    paper = {"twin": "truth", "preset": "paper", "real_episodes": 2}
    few, many, in_truth = {"planner_iterations": 20_000}, {"flights": 200}, {"twin": "truth"}
    traced = {"random": aloof, "greedy": greedy, "planner_nn": plan,
              "planner_log-distance": plan | {"twin": "log-distance"}, "qmix_nn": qmix,
              "qmix_truth": qmix | in_truth, "qmix_log-distance": qmix | {"twin": "log-distance"}}
    segmented = {"random": aloof | many,
                 "random_maxrate": aloof | many | {"assignment": "max-rate"},
                 "greedy": greedy | many, "planner": plan | fixed | many | few,
                 "paper_iql": {"algorithm": "iql"} | paper, "paper_qmix": qmix | paper,
                 "qmix_truth": qmix | in_truth, "qmix": qmix,
                 "fedqmix": {"algorithm": "fedqmix"},
                 "qmix_2real": qmix | {"real_episodes": 2, "episodes": 4000},
                 "qmix_guided": qmix | {"guide": "planner"} | few}
    return {name: settings for scenes, truth, kinds in ((PAPER_MAPS, "segmented", segmented),
                                                       (CITIES, "traced", traced))
            for name, settings in named_cases(scenes, truth, {
                kind: BEFORE | changes for kind, changes in kinds.items()}).items()}


def curve_table(rows: pd.DataFrame) -> str:
    """Return what is collected at the end, and the real episodes that the same ratio takes."""
    parts = []
    for truth, scene, runs in worlds(rows):
        curves = {name: over_seeds(runs[name]["curve"]) for name in LABELS if name in runs}
        target, lines = common_ratio(curves), []
        for name, curve in curves.items():
            seeds, level = runs[name], name in LEVELS
            lines.append([LABELS[name], "" if level else number(curve.x[-1], 0),
                          with_sd(last(seeds["curve"])),
                          "" if level else number(curve.needed(target), 0), str(len(seeds)),
                          number(seeds["cpu_s"].mean(), 0)])
        table = markdown(["", "real episodes", "collected at the end",
                          f"real episodes to {target:.3f}", "seeds", "CPU s each"], lines)
        parts.append(f"**{shown(scene, truth)}**\n\n{table}{factors(curves, target)}")
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
    texts = []
    for name in ("fedqmix-nn", "qmix-nn", "qmix-log-distance", "fedqmix-raytrace", "planner-nn",
                 "planner-raytrace"):
        if name in curves and real == real:
            needed = curves[name].needed(target)
            texts.append(f"{LABELS[name]} {needed:.0f} (a factor of {real / needed:,.0f})"
                         if needed == needed else
                         f"{LABELS[name]} does not reach it in {curves[name].x[-1]:.0f}")
    return (f"\n\nQMIX without a twin takes {real:,.0f} or fewer for {target:.3f}; "
            f"{'; '.join(texts)}.") if texts else ""


def federation_table(rows: pd.DataFrame) -> str:
    """Return FedQMIX and QMIX by simulated episodes."""
    parts = []
    for _, scene, runs in worlds(rows):
        lines = {}
        for name, seeds in runs.items():
            settings = seeds["settings"].iloc[0]
            simulated = last(seeds["curve"], "simulated_episodes")[0]
            lines[simulated, name] = [
                name, f"{settings['episodes'] * settings['real_episodes']:,}", f"{simulated:,}",
                number(seeds["cpu_s"].mean(), 0), with_sd(last(seeds["curve"])), str(len(seeds))]
        heads = ["", "episodes of a replica", "simulated in all", "CPU s", "collected", "seeds"]
        table = markdown(heads, [lines[key] for key in sorted(lines)])
        parts.append(f"**{scene}, statistical truth, 10 real episodes**\n\n{table}")
    return "\n\n".join(parts) + (
        "\n\nEqual for a replica: `fedqmix-3x800` and `qmix-800` (equal time where there are three "
        "cores). Equal in all: `fedqmix-3x267` and `qmix-800`, `fedqmix-3x800` and `qmix-2400` "
        "(equal time on one core). Equal time on two cores: `fedqmix-3x800` and `qmix-1280`. "
        "`weights`: moments and target networks are not averaged.")


def options(settings: dict, without: tuple[str, ...] = ("scene", "truth", "algorithm"),
            changed: dict[str, Any] = {}) -> str:  # noqa: B006 - not written to
    """Return what differs from the defaults (some `changed`), as options of `marl.fedqmix`."""
    defaults = RunSettings().model_dump(mode="json") | LearnerSettings().model_dump() | changed
    given = [f"--{name.replace('_', '-')} {str(value).lower()}" for name, value in settings.items()
             if name not in without and value != defaults[name]]
    return f"`{' '.join(given)}`" if given else "as it is"


def tuning_table(rows: pd.DataFrame) -> str:
    """Return one change at a time."""
    heads = ["options", "collected", "in the twin", "worst position error at the end [m]", "seeds"]
    return "\n\n".join(f"**{shown(scene, truth)}, model-aided QMIX**\n\n" + markdown(heads, [
        [options(seeds["settings"].iloc[0]), with_sd(last(seeds["curve"])),
         with_sd(last(seeds["curve"], "twin_ratio")),
         number(np.mean(last(seeds["curve"], "location_error_worst_m")), 0), str(len(seeds))]
        for seeds in runs.values()]) for truth, scene, runs in worlds(rows))


def options_table(rows: pd.DataFrame) -> str:
    """Return what each option collects in both cities, options as `marl.fedqmix` has them."""
    cells: dict[str, dict[str, dict[str, str]]] = {"segmented": {}, "traced": {}}
    for truth, scene, runs in worlds(rows):
        for seeds in runs.values():
            settings = seeds["settings"].iloc[0]
            own = LearnerSettings.model_fields if settings["preset"] == "paper" else ()
            hide = ("scene", "truth", "flights", *own)  # the preset says what the learner's are
            text = options(settings, hide, BEFORE | {"algorithm": ""})
            cells[truth].setdefault(text, {})[scene[-3:]] = f"{np.mean(last(seeds['curve'])):.3f}"
    titles = {"segmented": "The paper's maps, statistical truth", "traced": "Ray-traced truth"}
    return "\n\n".join(f"**{title}**\n\n" + markdown(["options", "RBM", "RDM"], [
        [text, *(ratio.get(scene, "") for scene in CITIES)]
        for text, ratio in cells[truth].items()]) for truth, title in titles.items())


def curve_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw collected data against real episodes, a panel a world; and the flights of FedQMIX."""
    found = list(worlds(rows))
    figure, panels = tables.make_panels(len(found), 2, 4.1)
    for axes, (truth, scene, runs) in zip(panels, found):
        for index, name in enumerate(name for name in LABELS if name not in LEVELS):
            if name in runs:
                tables.draw_line(axes, over_seeds(runs[name]["curve"]), LABELS[name], index)
        for style, name in zip(LEVEL_STYLES, LEVELS):
            if name in runs:
                axes.axhline(np.mean(last(runs[name]["curve"])), color="black", linestyle=style,
                             linewidth=1.1, label=LABELS[name])
        axes.set(xscale="log", ylim=(0, 1.02), xlabel="real episodes", ylabel=RATIO,
                 title=shown(scene, truth))
        axes.grid(alpha=0.3)
    flown = rows[rows["name"].str.endswith("-traced-fedqmix-nn") & (rows["seed"] == 0)]
    return {"curve": tables.with_legend(figure, panels, 3)} | {
        f"trajectories-{row.settings['scene']}": _draw_flight(row) for row in flown.itertuples()}


def _draw_flight(row: Any) -> Figure:
    scene = Scene.load(tables.scene_folder(row.settings["scene"]))
    known = Known({name: tuple(position_m) for name, position_m in row.known_m.items()})
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
    for row, (truth, scene, runs) in enumerate(found):
        for axes, of in zip(panels[2 * row:], ("a replica", "all replicas")):
            for index, (name, seeds) in enumerate(runs.items()):
                curve = over_seeds(seeds["curve"], x="simulated_episodes")
                share = 3 if name.startswith("fedqmix") and of == "a replica" else 1
                tables.draw_line(axes, curve._replace(x=curve.x / share), name, index)
            axes.set(xlabel=f"simulated episodes of {of}", ylabel=RATIO, title=shown(scene, truth))
            axes.grid(alpha=0.3)
    return {"federation": tables.with_legend(figure, panels, 3)}


STUDIES = {
    "curve": Study("How much is collected after how many real episodes?", learn, curve_cases,
                   curve_table, curve_figures),
    "federation": Study("Does averaging replicas pay?", learn, federation_cases, federation_table,
                        federation_figures),
    "tuning": Study("What brings the learner nearer to the planner?", learn, tuning_cases,
                    tuning_table),
    "options": Study("What do the learner's options bring?", learn, options_cases, options_table)}
