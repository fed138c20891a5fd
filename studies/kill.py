"""Commands that are killed at random moments and run again: `kill`.

Each command runs once without a disturbance. Then, for each moment, the same inputs are laid out
anew, the command is killed (SIGKILL) and run again to its end: its outputs have to be the same
bytes, and neither temporaries nor processes may be left over.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from marl.checkpoint import NAME as CHECKPOINT
from marl.checkpoint import load_checkpoint
from radiotwin.errors import RunFailed
from radiotwin.io.cells import write_csv
from radiotwin.io.files import scratch_folder
from studies.runner import Study
from studies.tables import markdown

MOMENTS = 10  # a row, with its own undisturbed run; two seeds make twenty
EARLIEST_S = 0.05
ORPHANS_MAY_LIVE_S = 20.0  # those that notice a closed pipe when their step is done
RADIOTWIN = ("-c", "from radiotwin.cli import main; main()")
LEVELS, SCENE = "data/measurements.csv.gz", ("--scene", "scene")

COMMANDS: dict[str, tuple[str, ...]] = {
    "trace": (*RADIOTWIN, "trace", "scene", "--quality", "fast", "-o", "out/truth.nc"),
    "fit": (*RADIOTWIN, "fit", LEVELS, *SCENE, "--model", "raytrace", "-o", "out"),
    "close-loop": (*RADIOTWIN, "close-loop", LEVELS, *SCENE, "--base", "log-distance", "-o", "out"),
    "compare": (*RADIOTWIN, "compare", LEVELS, *SCENE, "--truth", "segmented", "-o", "out"),
    "import": (*RADIOTWIN, "import", "data/raw.csv", "--level-unit", "dBm", "--length-unit", "m",
               "--columns", "level=level,device=device,x=x,y=y", "-o", "out"),
    "build-scene": (*RADIOTWIN, "build-scene", "data/city.geojson", "-o", "out"),
    "map": (*RADIOTWIN, "map", "twin", *SCENE, "-o", "out/twin.nc"),
    "marl": ("-m", "marl.fedqmix", *SCENE, "--truth", "segmented", "--twin", "log-distance",
             "--algorithm", "fedqmix", "--real-episodes", "3", "--episodes", "16", "--batch", "8",
             "--replay", "40", "--flights", "2", "--planner-iterations", "50", "--compare", "none",
             "--out", "out"),
    "demo": (*RADIOTWIN, "demo", "-o", "out"),
}
"""Arguments of Python, in a folder with `scene`, `data` and `twin`; results go to `out`."""

CLOCKS = {"learn_twin_s", "round_s"}
"""Names of durations in the tables, checkpoints and events of planning: all that may differ."""


def measure_kills(seed: int, settings: dict) -> dict:
    """Kill a `command` at `moments` random moments; return what differed or was left over."""
    rng = np.random.default_rng(seed)
    with scratch_folder() as folder:
        make_inputs(folder / "inputs", settings["command"])
        whole = Workplace(folder / "whole", folder / "inputs")
        started = time.perf_counter()
        finish(whole, settings["command"])
        duration_s = time.perf_counter() - started
        expected = digests(whole.work / "out")
        kills = []
        for moment_s in np.sort(rng.uniform(EARLIEST_S, duration_s, settings["moments"])):
            place = Workplace(folder / "killed", folder / "inputs")
            killed = kill_at(place, settings["command"], moment_s)
            orphans = len(wait_for_orphans(place))
            finish(place, settings["command"])
            found = digests(place.work / "out")
            kills.append({
                "moment_s": moment_s, "killed": killed, "orphans": orphans,
                "different": sorted(name for name in expected.keys() | found.keys()
                                    if expected.get(name) != found.get(name)),
                "left_over": sorted(place.left_over() - whole.left_over())})
            shutil.rmtree(place.root)
    return {"duration_s": duration_s, "files": len(expected), "kills": kills}


class Workplace:
    """Folders of one run: inputs and outputs, and caches and temporaries of its own.

    Args:
        root: folder to make.
        inputs: are copied.

    Attributes:
        session: number of the killed command's session.
    """

    def __init__(self, root: Path, inputs: Path) -> None:
        self.root, self.work, self.session = root, root / "work", 0
        shutil.copytree(inputs, self.work)
        for name in ("cache", "temporary"):
            (root / name).mkdir()
        self.environment = os.environ | {
            "PYTHONPATH": str(Path(__file__).parents[1]), "XDG_CACHE_HOME": str(root / "cache"),
            "RADIOTWIN_CACHE": "", "TMPDIR": str(root / "temporary")}

    def start(self, *arguments: str) -> subprocess.Popen:
        """Start Python in a session of its own, by which its processes are found again."""
        with (self.root / "said.txt").open("ab") as said:
            return subprocess.Popen([sys.executable, *arguments], cwd=self.work, stdout=said,
                                    stderr=said, env=self.environment, start_new_session=True)

    def left_over(self) -> set[str]:
        """Return temporaries: names of ours anywhere, and all in the folder of temporaries."""
        ours = {path for path in self.root.rglob("*") if path.name.startswith(".radiotwin-")}
        return {path.relative_to(self.root).as_posix()
                for path in ours.union((self.root / "temporary").iterdir())}


def make_inputs(folder: Path, command: str) -> None:
    """Write scene, measurements, raw table, city and twin, as far as a command needs them."""
    folder.mkdir(parents=True)
    (folder / "data").mkdir()
    run_here = (
        ("build-scene", "preset:small", "-o", "scene", "-q"),
        ("survey", "scene", "--truth", "segmented", "--flights", "4", "-o", LEVELS, "-q"),
        ("fit", LEVELS, *SCENE, "--model", "log_distance", "-o", "twin", "-q"))
    needed = {"import": 0, "build-scene": 0, "demo": 0, "trace": 1, "marl": 1, "map": 3}
    for arguments in run_here[:needed.get(command, 2)]:
        subprocess.run([sys.executable, *RADIOTWIN, *arguments], cwd=folder, check=True,
                       env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])})
    if command == "import":
        write_raw_table(folder / "data" / "raw.csv")
    if command == "build-scene":
        write_city(folder / "data" / "city.geojson")


def write_raw_table(path: Path, rows: int = 300_000) -> None:
    """Write levels of ten devices as a receiver would."""
    rng = np.random.default_rng(0)
    write_csv(pd.DataFrame({
        "time": np.arange(rows) * 0.1, "x": rng.uniform(0, 1000, rows).round(2),
        "y": rng.uniform(0, 1000, rows).round(2), "z": 60.0,
        "device": rng.integers(0, 10, rows), "level": rng.normal(-80, 8, rows).round(1),
    }), path)


def write_city(path: Path, side: int = 25) -> None:
    """Write a grid of buildings of different heights."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * 2e-4
    features = [
        {"type": "Feature", "properties": {"building": "yes", "height": 8 + (3 * i + 5 * j) % 20},
         "geometry": {"type": "Polygon", "coordinates": [
             (corners + [8 + i * 4e-4, 48 + j * 4e-4]).round(7).tolist()]}}
        for i in range(side) for j in range(side)]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))


def kill_at(place: Workplace, command: str, moment_s: float) -> bool:
    """Start a command and kill its process; False if it was done before."""
    child = place.start(*COMMANDS[command])
    try:
        child.wait(timeout=moment_s)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGKILL)
    place.session = child.pid
    return child.wait() == -signal.SIGKILL


def finish(place: Workplace, command: str) -> None:
    """Run a command to its end, as its own message says: planning goes on with --resume.

    Raises:
        RunFailed: its exit status is not 0.
    """
    again = ("--resume",) if command == "marl" and (place.work / "out/config.json").is_file() \
        else ()
    status = place.start(*COMMANDS[command], *again).wait()
    if status:
        said = (place.root / "said.txt").read_text(encoding="utf-8", errors="replace")
        raise RunFailed(f"{command}: exit status {status}: {said[-500:]}")


def wait_for_orphans(place: Workplace) -> list[int]:
    """Wait for the other processes of a killed command; return those that stay, and end them."""
    deadline = time.monotonic() + ORPHANS_MAY_LIVE_S
    while (alive := list(_processes(place.session))) and time.monotonic() < deadline:
        time.sleep(0.1)
    for process in alive:
        os.kill(process, signal.SIGKILL)
    return alive


def _processes(session: int) -> Iterator[int]:
    """Yield the living processes of a session."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, of = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it has ended
            continue
        if int(of) == session and state != "Z":
            yield int(folder.name)


def digests(folder: Path) -> dict[str, str]:
    """Return path -> hash of every file of a result, durations aside."""
    return {path.relative_to(folder).as_posix(): hashlib.sha256(timeless(path)).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file()}


def timeless(path: Path) -> bytes:
    """Return the content of a file without durations and the times of events."""
    if path.name.startswith("events.out.tfevents"):
        # A resumed run logs the rounds before it, then their blocks of training.
        return repr(sorted((event.step, value.tag, str(value)) for event in
                           EventFileLoader(str(path)).Load() for value in event.summary.value
                           if value.tag.rpartition("/")[2] not in CLOCKS)).encode()
    if path.name == CHECKPOINT:
        return _bytes_of(load_checkpoint(path))
    if path.name == "metrics.csv":
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        return table.drop(columns=[name for name in table if name in CLOCKS]).to_json().encode()
    return path.read_bytes()


def _bytes_of(value: Any) -> bytes:
    """Return the bytes of nested dicts, lists, tables, arrays and numbers, durations aside."""
    if isinstance(value, dict | pd.DataFrame):
        return b"".join(str(name).encode() + b"=" + _bytes_of(each)
                        for name, each in value.items() if name not in CLOCKS)
    if isinstance(value, list):
        return b"[" + b",".join(map(_bytes_of, value)) + b"]"
    if hasattr(value, "numpy"):  # a tensor
        value = value.numpy()
    numeric = isinstance(value, np.ndarray) and value.dtype != object
    return value.tobytes() if numeric else repr(
        value.tolist() if hasattr(value, "tolist") else value).encode()


def kill_cases(seed: int) -> dict[str, dict]:
    """Return every command."""
    return {command: {"command": command, "moments": MOMENTS} for command in COMMANDS}


def kill_table(rows: pd.DataFrame) -> str:
    """Return, for each command, how often it was killed and what came of it."""
    lines = []
    for command, group in rows.groupby("name", sort=False):
        kills = [kill for row in group["kills"] for kill in row]
        lines.append([command, f"{group['duration_s'].median():.0f}", str(group["files"].max()),
                      f"{sum(kill['killed'] for kill in kills)} of {len(kills)}",
                      *(str(sum(bool(kill[name]) for kill in kills))
                        for name in ("different", "left_over", "orphans"))])
    return markdown(["command", "undisturbed [s]", "files", "killed before the end",
                     "other bytes", "left over", "processes alive"], lines)


STUDIES = {"kill": Study("Does a killed command end the same when it runs again?", measure_kills,
                         kill_cases, kill_table, seeds=2)}
