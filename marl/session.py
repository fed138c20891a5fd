"""One run and its folder: configuration, metrics, checkpoints, comparison, figures."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from marl.algorithm1 import Outcome, run_algorithm
from marl.checkpoint import NAME
from marl.figures import choose_flight, draw_curve, save, trajectories_figure
from marl.flights import evaluate, track_table
from marl.learner import make_learner
from marl.mission import Known, Mission, make_mission
from marl.replicas import check_sizes, keep_memory, limit_threads
from marl.settings import LearnerSettings, RunSettings, learner_class, stream
from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.content_hash import content_hash
from radiotwin.io.files import atomic_file, atomic_path, is_temporary
from radiotwin.io.inputs import read_bytes, read_json, require_plain
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import read_truth
from radiotwin.runtime.console import print_rows, progress
from radiotwin.runtime.cuda import torch_device
from radiotwin.scene import Scene

if TYPE_CHECKING:
    from marl.event_log import EventLog

TRAINED_IN = {"nn": "NN twin", "log-distance": "log-distance twin", "kriging": "kriging twin",
              "raytrace": "ray-traced twin", "path-kriging": "twin of a map that may be wrong",
              "truth": "the truth"}
BASELINES = ("planner", "greedy", "random")  # in every table


@dataclass(frozen=True)
class Session:
    """A run, or one that is to be resumed, and the folder of its results."""

    run: RunSettings
    learner: LearnerSettings
    out: Path
    resume: bool

    def execute(self) -> None:
        """Run, write the folder, and print the table.

        Raises:
            BadInput: a scene or truth that cannot be used, a folder that is taken, or settings
                that are not those of the run to be resumed.
        """
        limit_threads(1)
        keep_memory()
        scene = Scene.load(self.run.scene)
        truth = read_truth(scene, self.run.truth)
        truth.require_of(scene)
        # Complain before anything is written.
        mission = make_mission(scene, truth, Known.truth(scene), self.run.assignment)
        check_sizes(self.run, self.learner, mission)
        device = torch_device(self.run.device)
        self._claim_folder(_world(scene, truth))
        runs: dict[str, RunSettings] = {self.run.twin: self.run}
        if self.run.compare and learner_class(self.run.algorithm).learns:
            runs |= {twin: self.run.model_copy(update={"twin": twin})
                     for twin in ("nn", "log-distance", "truth") if twin != self.run.twin}
        outcomes = {}
        episodes = len(runs) * self.run.real_episodes * self.run.episodes
        with progress("first real episode", total=episodes) as advance:
            for twin, run in runs.items():
                def on_progress(count: int, text: str | None = None, twin: str = twin) -> None:
                    advance(count, text and f"{TRAINED_IN[twin]}: {text}")
                folder = self.out if run is self.run else self.out / "compare" / twin
                outcomes[twin] = run_algorithm(run, self.learner, scene, truth, folder,
                                               self.resume, _Log(folder), on_progress, device)
        self._write(scene, truth, outcomes)

    def _claim_folder(self, world: dict[str, str]) -> None:
        """Make the folder of a new run, or check that it holds the run that is to be resumed."""
        path = self.out / "config.json"
        config = {"run": self.run.model_dump(mode="json"),
                  "learner": self.learner.model_dump(mode="json"), "world": world}
        if self.resume:
            old = self.out / "checkpoint.pt"
            if old.exists() and not (self.out / NAME).exists():
                raise BadInput(f"{old} is of an earlier version of radiotwin, in a form that this "
                               "one does not read, so the run in it cannot be resumed; finish it "
                               "with that version, or start it anew without --resume and with "
                               "another --out")
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

    def _write(self, scene: Scene, truth: RadioMap, outcomes: dict[str, Outcome]) -> None:
        main = outcomes[self.run.twin]
        real = make_mission(scene, truth, main.known, self.run.assignment)
        entries = [_entry(self.run.algorithm, twin, outcome.rows[-1])
                   for twin, outcome in outcomes.items()]
        trained_in = real
        if main.twin is not None:
            trained_in = make_mission(scene, main.twin.radio_map(scene), main.known,
                                      self.run.assignment)
        baselines = [name for name in BASELINES if name != self.run.algorithm]
        entries += [self._baseline(name, trained_in, real, main.rows[-1]["real_episodes"])
                    for name in baselines]
        table = pd.DataFrame(entries)
        with atomic_path(self.out / "comparison.csv") as temporary:
            write_csv(table, temporary)
        levels = {entry["method"]: entry["truth_ratio"] for entry in entries
                  if entry["method"] in baselines}
        curves = {f"{self.run.algorithm} in {TRAINED_IN[twin]}": outcome.rows
                  for twin, outcome in outcomes.items()}
        draw_curve(curves, levels, self.out / "curve.png")
        flights, typical = main.flights, choose_flight(main.flights, real)
        with atomic_path(self.out / "flights.csv") as temporary:
            write_csv(track_table(scene, real, flights, typical), temporary)
        save(trajectories_figure(scene, real, flights, typical, main.known),
             self.out / "trajectories.png")
        print_rows(f"Collected in the truth ({self.run.truth}), of all data; mean and standard "
                   f"deviation of {self.run.flights} flights",
                   {"method": "left", "trained in": "left", "real episodes": "right",
                    "collected": "right", "±": "right"},
                   [[row.method, row.trained_in, f"{row.real_episodes:,}",
                     f"{row.truth_ratio:.3f}", f"{row.truth_ratio_std:.3f}"]
                    for row in table.itertuples()])

    def _baseline(self, name: str, trained_in: Mission, real: Mission, real_episodes: int) -> dict:
        run = self.run.model_copy(update={"algorithm": name})
        learner = make_learner(run, self.learner, trained_in, 1)
        learner.prepare(trained_in, lambda _: None)
        ratio = evaluate(real, learner.policy(stream(run.seed, "decisions")), run.flights,
                         stream(run.seed, "truth evaluation")).ratio(real)
        # Random flights need no real ones. Greedy flights need the positions and a plan the map:
        # both come from the real flights, unless the settings give them.
        free = (name == "random" or run.twin == "truth"
                or (name == "greedy" and run.privileged))
        row = {"real_episodes": 0 if free else real_episodes, "truth_ratio": float(ratio.mean()),
               "truth_ratio_std": float(ratio.std())}
        return _entry(name, run.twin, row)


def require_free(folder: Path, advice: str) -> None:
    """Refuse a folder that has something in it, BadInput."""
    if folder.exists() and (not folder.is_dir() or any(
            not is_temporary(each) for each in folder.iterdir())):
        raise BadInput(f"{folder} exists and is not an empty folder; {advice}")


def _entry(method: str, twin: str, row: dict) -> dict:
    trained_in = TRAINED_IN[twin] if learner_class(method).uses_map else ""
    return {"method": method, "trained_in": trained_in,
            **{name: row[name] for name in ("real_episodes", "truth_ratio", "truth_ratio_std")}}


def _world(scene: Scene, truth: RadioMap) -> dict[str, str]:
    """Return hashes of what must not change before a run is resumed."""
    declared = hashlib.sha256(read_bytes(scene.folder / "scene.toml")).hexdigest()
    measured = hashlib.sha256(np.ascontiguousarray(truth.gain_db).tobytes()).hexdigest()
    rest = {name: values.values if values.dtype.kind in "biuf" else values.values.tolist()
            for name, values in truth.dataset.variables.items() if name != "gain_db"}
    rest |= {name: truth.dataset.attrs.get(name)
             for name in ("shadowing_share", "shadowing_length_m")}
    return {"city": scene.content_hash(), "scene.toml": declared, "truth": measured,
            "truth besides gain_db": content_hash(rest)}


class _Log:
    """Write `metrics.csv` and TensorBoard events of one folder after every round."""

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
    return {name: value for name, value in record.items() if name not in ("round", "episodes")}
