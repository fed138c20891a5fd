"""What each study runs: plain lists of runs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from marl.experiments.records import Run
from marl.settings import PRESETS, LearnerSettings, RunSettings, check_together
from radiotwin.errors import BadInput

TRUTHS = ("traced", "segmented")
FLIGHTS = (1, 2, 3, 5, 10)  # real episodes that a twin is learnt from
FEW_FLIGHTS = (1, 5)  # where that takes minutes
SCENARIOS = ("nominal", "volumes", "positions", "loss", "everything")
NAMING = ("scene", "twin", "model", "scenario", "method", "algorithm")  # what the names of runs say


@dataclass(frozen=True)
class Study:
    """A question, and the runs that answer it.

    Attributes:
        question: in a line.
        runs: (scenes, seeds) -> runs, the most telling ones first; None where there is nothing to run.
    """

    question: str
    runs: Callable[[list[str], int], list[Run]] | None


def curve(scenes: list[str], seeds: int) -> list[Run]:
    """Share of the data against real episodes, of all that there is."""
    runs = []
    for seed in range(seeds):
        for truth in TRUTHS:
            for scene in scenes:
                here: dict[str, Any] = {"study": "curve", "scene": scene, "truth": truth, "seed": seed}
                runs += [learning(algorithm="fedqmix", **here), learning(algorithm="qmix", **here),
                         learning(algorithm="qmix", twin="log-distance", **here),
                         learning(algorithm="qmix", twin="truth", **here),
                         learning(algorithm="iql", twin="truth", **here), learning(algorithm="planner", **here)]
                runs += [learning(algorithm=name, twin="truth", real_episodes=1, flights=64, **here)
                         for name in ("greedy", "random")]
                if truth == "traced":  # in the statistical one there are no paths to follow
                    runs += [learning(algorithm="planner", twin="raytrace", real_episodes=1, **here),
                             learning(algorithm="fedqmix", twin="raytrace", real_episodes=1, episodes=8000, **here)]
    return runs


def federation(scenes: list[str], seeds: int) -> list[Run]:
    """FedQMIX against QMIX at equal simulated episodes of a replica, in all, and in equal time.

    The share of training over which exploration fades is the same in all. Equal time is that of one core (equal in
    all), of three or more (equal of a replica), and of two, where three replicas take 1.6 times as long as one
    (`benchmarks/marl_speed.py`: 3 / 1.87).
    """
    runs = []
    for seed in range(seeds):
        for scene in scenes:
            for name, algorithm, episodes in (("fedqmix-3x800", "fedqmix", 800), ("qmix-800", "qmix", 800),
                                              ("fedqmix-3x267", "fedqmix", 267), ("qmix-1280", "qmix", 1280),
                                              ("qmix-2400", "qmix", 2400), ("fedqmix-3x800-weights", "fedqmix", 800)):
                changed = {"epsilon_slots": round(PRESETS["fast"].epsilon_slots * episodes / 800),
                           "federate_all": not name.endswith("weights")}
                runs.append(learning("federation", scene, "segmented", seed, algorithm, changes=changed, name=name,
                                     episodes=episodes))
    return runs


def twin(scenes: list[str], seeds: int) -> list[Run]:
    """Which twin to train in: the same five real flights, six twins, one learner, flown in the ray-traced truth."""
    return [Run("twin", f"{label(scene)}-{name}", "trained in",
                {"scene": scene, "truth": "traced", "twin": name, "survey_flights": 5, "noise_db": 1.0,
                 "episodes": 4000, "learner": learner(epsilon_slots=87_500), "planner_iterations": 60_000,
                 "flights": 64, "replayed_flights": 20}, seed)
            for seed in range(seeds) for scene in scenes
            for name in ("nn", "segmented", "log-distance", "truth", "raytrace", "corrected")]


def quality(scenes: list[str], seeds: int) -> list[Run]:
    """Map and positions against the number of real episodes."""
    return [Run("quality", f"{label(scene)}-{model}", "twin quality",
                {"scene": scene, "truth": "traced", "model": model, "survey_flights": list(flights), "noise_db": 1.0},
                seed)
            for seed in range(seeds) for scene in scenes
            for model, flights in (("segmented_nn", FLIGHTS), ("log_distance", FLIGHTS),
                                   ("regression_kriging", FLIGHTS), ("raytrace", FEW_FLIGHTS))]


def pays(scenes: list[str], seeds: int) -> list[Run]:
    """Policy, plan and re-planning where things are not as they were thought before take-off."""
    runs = []
    for seed in range(seeds):
        for scene in scenes:
            for scenario in SCENARIOS:
                shared = {"scene": scene, "scenario": scenario, "flights": 64, "truths": 8}
                trained = {"episodes": 4000, "learner": learner(epsilon_slots=87_500)}
                planner = {"planner_iterations": 60_000}
                again = planner | {"replan_every": 10, "replan_iterations": 1500}
                for method, more in (("policy", trained), ("policy-no-link", trained), ("plan", planner),
                                     ("taught", trained | planner), ("taught-no-link", trained | planner),
                                     ("replan", again), ("replan-no-link", again), ("greedy", {})):
                    runs.append(Run("pays", f"{label(scene)}-{scenario}-{method}", "disturbed",
                                    shared | {"method": method} | more, seed))
    return runs


def tuning(scenes: list[str], seeds: int) -> list[Run]:
    """What might bring model-aided learning nearer to the planner, one change at a time; `earlier` ones are changes of
    what the preset was before."""
    policy = {"measure": "policy"}
    earlier = policy | {"first_flight": "random", "twin_shadowing": "slot"}
    changes: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # of the learner, and of the run
        "as-it-is": ({}, {}), "shadowing-slot": ({}, {"twin_shadowing": "slot"}),
        "first-random": ({}, {"first_flight": "random"}), "excursions-1": ({"excursion_slots": 1.0}, {}),
        "excursions-8": ({"excursion_slots": 8.0}, {}), "measure-policy": ({}, policy),
        "lambda-0.6": ({"td_lambda": 0.6}, {}),
        "lambda-0.95": ({"td_lambda": 0.95}, {}), "target-100": ({"target_every": 100}, {}),
        "epsilon-60k": ({"epsilon_slots": 60_000}, {}), "replay-800": ({"replay": 800}, {}),
        "guide": ({}, {"guide": "planner"}),
        "episodes-1600": ({}, {"episodes": 1600}), "earlier": ({}, earlier),
        "earlier-excursions-1": ({"excursion_slots": 1.0}, earlier)}
    return [learning("tuning", scene, "traced", seed, "qmix", changes=of_learner, name=name, **of_run)
            for seed in range(seeds) for scene in scenes for name, (of_learner, of_run) in changes.items()]


STUDIES = {
    "curve": Study("How much is collected after how many real episodes?", curve),
    "federation": Study("Does averaging replicas pay?", federation),
    "twin": Study("Which twin is worth training in?", twin),
    "quality": Study("How good is the twin after how many real episodes?", quality),
    "pays": Study("Where does learning pay?", pays),
    "tuning": Study("What brings the learner nearer to the planner?", tuning),
    "closeloop": Study("What does close-loop find? (a table of docs/results/*.json; nothing is run)", None),
}


def learning(study: str, scene: str, truth: str, seed: int, algorithm: str, twin: str = "nn", *,
             changes: dict[str, Any] | None = None, name: str | None = None, **run: Any) -> Run:
    """A run of Algorithm 1 with the preset `fast`, and what is changed in it."""
    settings = RunSettings(truth=truth, twin=twin, algorithm=algorithm, **run)
    name = name or (f"{algorithm}-{twin}" if algorithm not in ("greedy", "random") else algorithm)
    return Run(study, f"{label(scene)}-{truth}-{name}", "learning",
               {"run": settings.model_dump(mode="json", exclude={"seed", "compare"}) | {"scene": scene},
                "learner": learner(**(changes or {}))}, seed)


def learner(**changes: Any) -> dict[str, Any]:
    """The preset `fast`, and what is changed in it, as a record has it."""
    return PRESETS["fast"].model_copy(update=changes).model_dump(mode="json")


def label(scene: str) -> str:
    """The name of a scene, or of its folder."""
    return Path(scene).name


def with_settings(runs: list[Run], given: list[str]) -> list[Run]:
    """The runs with settings changed as the command line says.

    Args:
        runs: of a study.
        given: NAME=VALUE; applied to the runs that have such a setting.

    Raises:
        BadInput: not of that form, a name that no run has, or an impossible value.
    """
    for text in given:
        name, equals, value = text.partition("=")
        if name in NAMING or (name == "truth" and any(run.kind == "learning" for run in runs)):
            raise BadInput(f"--set {text}: the names of the runs say that, so it cannot be changed in them; choose "
                           "with --scenes, --only")
        changed = [_changed(run, name, value) if equals else None for run in runs]
        if all(run is None for run in changed):
            names = sorted({each for run in runs for group in _groups(run).values() for each in group})
            raise BadInput(f"--set {text}: give NAME=VALUE with one of {', '.join(names)}")
        runs = [new or old for new, old in zip(changed, runs)]
    for run in runs:
        _check(run)
    return runs


def _groups(run: Run) -> dict[str, dict[str, Any]]:
    """The settings by group; those that are in none have the name ""."""
    groups = {name: value for name, value in run.settings.items() if isinstance(value, dict)}
    return groups | {"": {name: value for name, value in run.settings.items() if name not in groups}}


def _changed(run: Run, name: str, text: str) -> Run | None:
    for group, values in _groups(run).items():
        if name in values:
            changed = {name: _converted(name, text, values[name])}
            return replace(run, settings=run.settings | ({group: values | changed} if group else changed))
    return None


def _converted(name: str, text: str, before: Any) -> Any:
    try:
        if isinstance(before, bool):
            return {"true": True, "false": False}[text]
        if isinstance(before, list):
            return [int(part) for part in text.split(",")]
        return type(before)(text)
    except (ValueError, KeyError):
        kind = {bool: "true or false", int: "a whole number", float: "a number", list: "whole numbers with commas"}
        raise BadInput(f"--set {name}={text}: allowed is {kind[type(before)]}") from None


def _check(run: Run) -> None:
    """Complain about impossible values before anything is run."""
    try:
        settings = RunSettings.model_validate(run.settings.get("run", {}))
        check_together(settings, LearnerSettings.model_validate(run.settings.get("learner", {})))
    except ValidationError as error:
        first = error.errors()[0]
        raise BadInput(f"--set {first['loc'][0]}={first['input']}: {first['msg']}") from None
    for name, value in _groups(run)[""].items():
        if name == "truth" and value not in TRUTHS:
            raise BadInput(f"--set truth={value}: allowed is {' or '.join(TRUTHS)}")
        for each in value if isinstance(value, list) else [value]:
            least = 0 if name == "noise_db" else 1
            if isinstance(each, int | float) and each < least:
                raise BadInput(f"--set {name}={each}: allowed is {least} or more")
