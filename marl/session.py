"""Execute one run, and write its folder: configuration, log, checkpoint, comparison, figures."""

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from marl.algorithm1 import FLIGHTS, Campaign, run_algorithm
from marl.figures import choose_flight, draw_curve, save, save_animation, trajectories_figure
from marl.flights import evaluate, track_table
from marl.learner import make_learner
from marl.mission import Known, Mission, make_mission
from marl.replicas import check_sizes, keep_memory, limit_threads, result_of, shut
from marl.settings import LEARNERS, LearnerSettings, RunSettings, learner_class, stream
from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.content_hash import content_hash
from radiotwin.io.files import atomic_file, atomic_path, is_temporary
from radiotwin.io.inputs import read_bytes, read_json, require_plain
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import read_truth
from radiotwin.runtime.console import print_rows, progress, say
from radiotwin.runtime.cuda import torch_device
from radiotwin.runtime.execution import start_process
from radiotwin.scene import Scene

if TYPE_CHECKING:
    from marl.event_log import EventLog

TRAINED_IN = {"nn": "NN twin", "log-distance": "log-distance twin", "kriging": "kriging twin",
              "paths": "ray-traced twin", "path_kriging": "twin of a map that may be wrong",
              "truth": "the truth"}
NO_FLIGHTS = dict.fromkeys(("real_episodes", *FLIGHTS), 0) | {"real_ratio": np.nan}
FLIGHTS_SAY = "Real flights: to measure + to train + to choose between policies"
BASELINES = ("planner", "heuristic", "greedy", "random")  # in every table
RECORDED = {
    truth: {"method": "qmix", "trained_in": "the truth (recorded with 0.1.0)",
            "real_episodes": 13_696, "measuring_flights": 0, "training_flights": 8_000,
            "selection_flights": 5_696, "truth_ratio": ratio, "truth_ratio_std": ratio_sd}
    for truth, ratio, ratio_sd in (
        ("1e44db1d67e1a86564b1ebba6ff3f1b0e974324272941efbf615a7f78a4a9622", 0.912, 0.018),  # RBM
        ("4e3ce2205330c13ac95f4f8ff317806c8b4a4ebaf27a5386c81856eaf44af7a5", 0.873, 0.017))}  # RDM
"""Hash of a published traced truth -> QMIX after training in it, mean and deviation of three seeds
(`python -m studies curve`, of versions 0.1.0 1041c7b77ada and 27311fa1f1e1)."""


@dataclass(frozen=True)
class Session:
    """A new or resumed run, and the folder of its results."""

    run: RunSettings
    learner: LearnerSettings
    out: Path
    resume: bool

    def execute(self) -> tuple[pd.DataFrame, dict[str, list[dict]]]:
        """Run Algorithm 1 and its comparison, write the folder, and print the table.

        Returned are the table of all methods, and the log of each run by its name.

        Raises:
            BadInput: an unusable scene or truth, a folder that is not empty, or settings other than
                those of the run to be resumed.
        """
        limit_threads(1)
        keep_memory()
        scene = Scene.load(self.run.scene)
        truth = read_truth(scene, self.run.truth)
        truth.require_made_for(scene)
        # Check the input before anything is written.
        mission = make_mission(scene, truth, Known.truth(scene), self.run.assignment)
        check_sizes(self.run, self.learner, mission)
        device = torch_device(self.run.device)
        world = _world(scene, truth)
        self._claim_folder(world)
        with ExitStack() as stack:
            compared = self._start_comparison(stack)
            advance = stack.enter_context(progress(
                "first real episode", total=self.run.real_episodes * self.run.episodes, lines=True))

            def on_progress(count: int, text: str | None = None) -> None:
                advance(count, text and f"{TRAINED_IN[self.run.twin]}: {text}")

            def on_learned(campaign: Campaign, mission: Mission) -> None:
                number, rounds = len(campaign.rows) + 1, self.run.real_episodes
                on_progress(0, f"round {number}/{rounds}")
                if number == 1 and learner_class(self.run.algorithm).learns:
                    for name in ("greedy", "heuristic", "planner"):
                        _say_row(self._baseline(name, mission, campaign.in_truth(), NO_FLIGHTS | {
                            "real_episodes": 1, "measuring_flights": 1}))

            main = run_algorithm(self.run, self.learner, scene, truth, self.out, self.resume,
                                 _Log(self.out), on_progress, device, on_learned)
            curves = {f"{self.run.algorithm} in {TRAINED_IN[self.run.twin]}": main.rows}
            entries = [_entry(self.run.algorithm, self.run.twin, main.rows[-1])]
            for run, call in compared:
                _say_row(entries[-1])
                advance(0, f"{TRAINED_IN[run.twin]}: the comparison is trained")
                rows = result_of(call)
                curves[f"{run.algorithm} in {TRAINED_IN[run.twin]}"] = rows
                entries.append(_entry(run.algorithm, run.twin, rows[-1]))
        recorded = RECORDED.get(world["truth"])
        if recorded and self.run.truth == "traced" and self.run.compare == "twins" and compared:
            entries.append(recorded)
        return self._write(scene, truth, main, curves, entries), curves

    def _start_comparison(self, stack: ExitStack) -> "list[tuple[RunSettings, Future[list[dict]]]]":
        """Start the runs of the comparison, one after the other in a process of their own.

        FedQMIX is compared by a single replica of QMIX, which takes a third of the work. Returned
        are settings and future log of each run.
        """
        main = self.run
        twins = {"none": (), "twins": ("nn", "log-distance"),
                 "truth": ("nn", "log-distance", "truth")}[main.compare]
        algorithm = "qmix" if main.algorithm == "fedqmix" else main.algorithm
        runs = [main.model_copy(update={"twin": twin, "algorithm": algorithm})
                for twin in twins if twin != main.twin and learner_class(main.algorithm).learns]
        if not runs:
            return []
        pool, _ = start_process({})
        stack.callback(shut, pool)
        return [(run, pool.submit(_compared, run, learner_class(algorithm), self.learner,
                                  self.out / "compare" / run.twin, self.resume)) for run in runs]

    def _claim_folder(self, world: dict[str, str]) -> None:
        """Create the folder of a new run, or check that it holds the run to be resumed."""
        path = self.out / "config.json"
        config = {"run": self.run.model_dump(mode="json"),
                  "learner": self.learner.model_dump(mode="json"), "world": world}
        if self.resume:
            try:
                before = read_json(path)
                if not isinstance(before, dict) or not all(
                        isinstance(before.get(group), dict) for group in config):
                    raise BadInput("a part is missing")
            except BadInput:
                raise BadInput(f"{path} is not there or damaged, so there is nothing to resume in "
                               f"{self.out}; start the run without --resume") from None
            for group in config:
                for name, value in config[group].items():
                    if before[group].get(name) == value:
                        continue
                    if group == "world":
                        raise BadInput(f"the {name} has changed since the run in {self.out} was "
                                       "started; put it back, or give another --out")
                    raise BadInput(
                        f"--{name.replace('_', '-')} {value}: the run in {self.out} was started "
                        f"with {str(before[group].get(name))[:200]}; resume it with the options "
                        "that it was started with, or give another --out")
            require_plain(self.out)
            return
        require_free(self.out, "--resume goes on with the run in it, --out names another folder")
        with atomic_file(path) as file:
            file.write(json.dumps(config, indent=1).encode())

    def _write(self, scene: Scene, truth: RadioMap, main: Campaign, curves: dict[str, list[dict]],
               entries: list[dict]) -> pd.DataFrame:
        """Evaluate the baselines, write tables and figures, and print and return the comparison."""
        real = make_mission(scene, truth, main.known, self.run.assignment)
        trained_in = real
        if main.twin is not None:
            trained_in = make_mission(scene, main.twin.radio_map(scene), main.known,
                                      self.run.assignment)
        baselines = [name for name in BASELINES if name != self.run.algorithm]
        entries += [self._baseline(name, trained_in, real, main.rows[-1]) for name in baselines]
        known = make_mission(scene, truth, Known.truth(scene), self.run.assignment)
        best = self._baseline("planner", known, known, NO_FLIGHTS) | {
            "method": "clairvoyant", "trained_in": TRAINED_IN["truth"]}
        table = pd.DataFrame([*entries, best])
        # Regret [flights' data]: sum over real flights of the clairvoyant share minus their own;
        # 0 without real flights, NaN if their share is not known.
        table["regret"] = (table["real_episodes"] * (best["truth_ratio"] - table["real_ratio"])
                           ).where(table["real_episodes"] > 0, 0.0)
        with atomic_path(self.out / "comparison.csv") as temporary:
            write_csv(table, temporary)
        levels = {entry["method"]: entry["truth_ratio"] for entry in entries
                  if entry["method"] in baselines}
        draw_curve(curves, levels, self.out / "curve.png")
        flights, typical = main.flights, choose_flight(main.flights, real)
        with atomic_path(self.out / "flights.csv") as temporary:
            write_csv(track_table(scene, real, flights, typical), temporary)
        save(trajectories_figure(scene, real, flights, typical, main.known),
             self.out / "trajectories.png")
        save_animation(scene, real, flights, typical, self.out / "flight.gif")
        print_rows(f"Collected in the truth ({self.run.truth}), of all data; mean and standard "
                   f"deviation of {self.run.flights} flights. {FLIGHTS_SAY}",
                   {"method": "left", "trained in": "left", "real flights": "right",
                    "regret": "right", "collected": "right", "±": "right"},
                   [[row["method"], row["trained_in"], flights_text(row), regret_text(row),
                     f"{row['truth_ratio']:.3f}", f"{row['truth_ratio_std']:.3f}"]
                    for row in table.to_dict("records")])
        return table

    def _baseline(self, name: str, trained_in: Mission, real: Mission, flown: dict) -> dict:
        """Evaluate a method without training, and return its row of the table.

        It is prepared in one mission, and flies in another, in the truth; `flown` are the numbers
        of the real flights on which its map is based.
        """
        run = self.run.model_copy(update={"algorithm": name})
        learner = make_learner(run, self.learner, trained_in, 1)
        learner.prepare(trained_in, lambda _: None)
        ratio = evaluate(real, learner.policy(stream(run.seed, "decisions")), run.flights,
                         stream(run.seed, "truth evaluation")).ratio(real)
        # Random flights need no real flights. Greedy flights need positions and a plan needs the
        # map: both come from real flights, unless the settings provide them.
        free = (name == "random" or run.twin == "truth"
                or (name in ("greedy", "heuristic") and run.privileged))
        return _entry(name, run.twin, (NO_FLIGHTS if free else flown) | {
            "truth_ratio": float(ratio.mean()), "truth_ratio_std": float(ratio.std())})


def require_free(folder: Path, advice: str) -> None:
    """Raise BadInput, with advice, if a folder exists and is not empty."""
    if folder.exists() and (not folder.is_dir() or any(
            not is_temporary(each) for each in folder.iterdir())):
        raise BadInput(f"{folder} exists and is not an empty folder; {advice}")


def _entry(method: str, twin: str, row: dict) -> dict:
    """Return a row of the comparison from a row of a log."""
    trained_in = TRAINED_IN[twin] if learner_class(method).uses_map else ""
    return {"method": method, "trained_in": trained_in,
            **{name: row[name] for name in (*NO_FLIGHTS, "truth_ratio", "truth_ratio_std")}}


def flights_text(row: Mapping[str, float]) -> str:
    """Return the numbers of real flights as text: measuring + training + selection."""
    return " + ".join(f"{row[name]:,.0f}" for name in FLIGHTS)


def regret_text(row: Mapping[str, float]) -> str:
    """Return the regret of a row as text; a dash if it is not known."""
    return "–" if np.isnan(row["regret"]) else f"{row['regret']:,.1f}"


def _compared(run: RunSettings, made: Any, learner: LearnerSettings, folder: Path,
              resume: bool) -> list[dict]:
    """Run Algorithm 1 in this process for the comparison, and return its log.

    `made` is the class of the learner, which a script may have registered.
    """
    limit_threads(1)
    keep_memory()
    LEARNERS[run.algorithm] = made
    scene = Scene.load(run.scene)
    return run_algorithm(run, learner, scene, read_truth(scene, run.truth), folder, resume,
                         _Log(folder), lambda *_: None, torch_device(run.device)).rows


def _say_row(row: dict) -> None:
    """Print a row of the table while other runs continue."""
    place = f" in the {row['trained_in'].removeprefix('the ')}" if row["trained_in"] else ""
    say(f"{row['method']}{place}, real flights {flights_text(row)}: "
        f"{row['truth_ratio']:.3f} ± {row['truth_ratio_std']:.3f} collected in the truth")


def _world(scene: Scene, truth: RadioMap) -> dict[str, str]:
    """Return hashes of scene and truth, which must not change before a run is resumed."""
    declared = hashlib.sha256(read_bytes(scene.folder / "scene.toml")).hexdigest()
    measured = hashlib.sha256(np.ascontiguousarray(truth.gain_db).tobytes()).hexdigest()
    rest = {name: values.values if values.dtype.kind in "biuf" else values.values.tolist()
            for name, values in truth.dataset.variables.items() if name != "gain_db"}
    rest |= {name: truth.dataset.attrs.get(name)
             for name in ("shadowing_share", "shadowing_length_m")}
    return {"city": scene.content_hash(), "scene.toml": declared, "truth": measured,
            "truth besides gain_db": content_hash(rest)}


class _Log:
    """Callback that writes `metrics.csv` and TensorBoard events after every round."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._rows, self._blocks = folder, 0, 0
        self._events: EventLog | None = None

    def __call__(self, rows: list[dict], blocks: list[dict]) -> None:
        with atomic_path(self._folder / "metrics.csv") as temporary:
            write_csv(pd.DataFrame(rows), temporary)
        if self._events is None:
            from marl.event_log import EventLog  # slow to load

            self._events = EventLog(self._folder / "tensorboard")
        for row in rows[self._rows:]:
            self._events.add("round", row["round"], _numbers(row))
        for block in blocks[self._blocks:]:
            self._events.add("train", block["episodes"], _numbers(block))
        self._rows, self._blocks = len(rows), len(blocks)
        self._events.flush()


def _numbers(record: dict) -> dict[str, float]:
    """Return the values of a record without its counters."""
    return {name: value for name, value in record.items() if name not in ("round", "episodes")}
