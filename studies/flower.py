"""Federation over Flower's processes against means in one process: `flower`.

The processes are those that `docs/federation.md` has users start on several machines, here on one,
without TLS and keys.

Three parties: two cities whose flights are simulated, and one that has measurements of flights that
were flown before. Rewards are shares of all data that each party's policy collects in the truth of
its own city. Needs the extra `flower`.
"""

import os
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pandas as pd
import tomli_w

from marl.checkpoint import load_checkpoint
from marl.fedqmix.client import Client, Party
from marl.fedqmix.federation import Weights, rounds_of
from marl.fedqmix.session import federate, node_config
from marl.fedqmix.settings import Shared, write_app
from marl.settings import PRESETS, RunSettings
from radiotwin import Scene, fly_survey
from radiotwin.errors import RunFailed
from radiotwin.io.files import scratch_folder
from radiotwin.maps.survey import read_truth
from studies.runner import Study
from studies.tables import markdown, scene_folder, with_sd
from studies.tables import number as rounded

CITIES, MEASURED = ("rbm", "rdm", "rbm"), 2
KILLED = 1  # party
HOST, POLL_S, START_S, RESTART_S = "127.0.0.1", 0.5, 120.0, 15.0


def measure(seed: int, settings: dict) -> dict[str, Any]:
    """Run a federation of three parties.

    Args:
        seed: of all parties.
        settings: `engine`: `in-process` or `flower`; `killed_after`: round after which the
            SuperNode of a party is killed, 0 for none; `compare_means`: with those of one process;
            the rest are fields of the run.

    Returns:
        `reward` of each party, and its mean; `heard` parties and `seconds` of each round;
        `largest_difference` of a weight from the mean in one process, over all rounds.
    """
    run = RunSettings(seed=seed, device="cpu", real_episodes=settings["real_episodes"],
                      episodes=settings["episodes"], flights=settings["flights"])
    learner = PRESETS["fast"].model_copy(update={
        name: settings[name] for name in ("epsilon_slots", "federate_every", "hidden")})
    shared = Shared(run=run, learner=learner, clients=len(CITIES), uavs=3, devices=10,
                    round_timeout_s=settings["timeout_s"])
    result: dict[str, Any] = {}
    with scratch_folder() as folder:
        parties = _parties(folder, seed, settings["survey_flights"])
        means: list[Weights] = []
        if settings["engine"] == "in-process" or settings["compare_means"]:
            means = federate(shared, [Client(run, learner, party) for party in parties])
        if settings["engine"] == "flower":
            result |= _over_flower(shared, parties, folder, settings["killed_after"])
        if settings["engine"] == "flower" and settings["compare_means"]:
            result["largest_difference"] = f"{_difference(folder / 'out', means):.1e}"
        tables = [pd.read_csv(sorted(party.folder.glob("**/metrics.csv"),
                                     key=lambda path: path.stat().st_mtime)[-1])
                  for party in parties]
    rewards = [float(table["truth_ratio"].iloc[-1]) for table in tables]
    return result | {"reward": rewards, "mean_reward": float(np.mean(rewards)),
                     "rounds": len(rounds_of(run, learner))}


def _parties(folder: Path, seed: int, flights: int) -> list[Party]:
    scenes = [scene_folder(name).absolute() for name in CITIES]
    scene = Scene.load(scenes[MEASURED])
    measured = fly_survey(scene, read_truth(scene, "traced"), flights=flights,
                          pattern="random-waypoint", seed=1000 + seed)
    path = folder / "survey" / "measurements.csv"
    path.parent.mkdir()
    measured.save(path)
    return [Party(each, folder / "parties" / str(index), index, "traced",
                  path if index == MEASURED else None) for index, each in enumerate(scenes)]


def _over_flower(shared: Shared, parties: list[Party], folder: Path,
                 killed_after: int) -> dict[str, Any]:
    out = folder / "out"
    write_app(shared.model_copy(update={"out": str(out)}), [], folder)

    def on_round(number: int) -> None:
        if number == killed_after:
            processes.kill(f"supernode-{KILLED}")

    with Processes(folder / "home", parties) as processes:
        processes.run(folder / "app", out, on_round)
    rounds = pd.read_csv(out / "rounds.csv")
    return {"heard": rounds["parties"].tolist(), "seconds": rounds["seconds"].round(1).tolist()}


class Processes:
    """Flower's SuperLink and a SuperNode for each party, as processes of this machine.

    On leaving, all that were started are ended.

    Args:
        home: folder of what Flower keeps, and of logs.
        parties: one for each SuperNode; none: Flower's simulation engine, by its own SuperLink.
    """

    def __init__(self, home: Path, parties: list[Party]) -> None:
        home.mkdir()
        self._home, self._running = home, dict[str, subprocess.Popen]()
        self._port, self._count = free_port(), len(parties)
        binaries = str(Path(sys.executable).parent)
        self._environment = os.environ | {
            "PATH": os.pathsep.join([binaries, os.environ.get("PATH", os.defpath)]),
            "FLWR_HOME": str(home), "FLWR_TELEMETRY_ENABLED": "0", "FLWR_DISABLE_UPDATE_CHECK": "1",
            "FLWR_LOCAL_SUPERLINK_HTTP_API_PORT": str(self._port),
            "FLWR_LOCAL_CONTROL_API_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
        link = {"address": f"{HOST}:{self._port}", "insecure": True} if parties else {
            "address": ":local-in-memory:"}
        (home / "config.toml").write_text(tomli_w.dumps(
            {"superlink": {"default": "here", "here": link}}))
        for number, party in enumerate(parties):
            (home / f"node-{number}.toml").write_text(tomli_w.dumps(node_config(party)))

    def __enter__(self) -> Self:
        if self._count:
            self.start("superlink", f"flower-superlink --insecure --host {HOST} --port "
                       f"{self._port} --disable-runtime-dependency-installation")
            end = time.monotonic() + START_S
            while not is_open(self._port) and time.monotonic() < end:
                time.sleep(POLL_S)
        for number in range(self._count):
            self.start_node(number)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        for process in reversed(self._running.values()):
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(RESTART_S)
        while left := _processes_with(f"FLWR_HOME={self._home}"):
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, 9)
            time.sleep(POLL_S)

    def start(self, name: str, command: str) -> None:
        """Start a process; its log has its name."""
        with (self._home / f"{name}.log").open("ab") as log:
            self._running[name] = subprocess.Popen(
                shlex.split(command), env=self._environment, stdin=subprocess.DEVNULL, stdout=log,
                stderr=log, start_new_session=True)

    def start_node(self, number: int) -> None:
        """Start the SuperNode of a party."""
        self.start(f"supernode-{number}", f"flower-supernode --insecure --superlink {HOST}:"
                   f"{self._port} --host {HOST} --port {free_port()} --node-config "
                   f"{shlex.quote(str(self._home / f'node-{number}.toml'))}")

    def kill(self, name: str) -> None:
        """End a process as a power cut would."""
        self._running[name].kill()

    def run(self, app: Path, out: Path, on_round: Callable[[int], None] = lambda number: None,
            options: str = "") -> None:
        """Submit the app and wait for its end; a SuperNode that ends is started again.

        Flower takes a SuperNode that was killed back when it has missed two heartbeats, which is
        after a minute; until then it ends again.

        Raises:
            RunFailed: it ends without all rounds.
        """
        self.start("flwr-run", f"flwr run {shlex.quote(str(app))} here --stream {options}")
        done, started = 0, dict.fromkeys(range(self._count), time.monotonic())
        while self._running["flwr-run"].poll() is None:
            while (out / "weights" / f"round-{done + 1:05d}.safetensors").exists():
                done += 1
                on_round(done)
            for number, at in started.items():
                if self._running[f"supernode-{number}"].poll() is not None \
                        and time.monotonic() - at > RESTART_S:
                    started[number] = time.monotonic()
                    self.start_node(number)
            time.sleep(POLL_S)
        if "have evaluated" not in (log := (self._home / "flwr-run.log").read_text()):
            raise RunFailed(f"Flower's run has failed: {log[-800:]}")


def free_port() -> int:
    """Return a port of the loopback that nothing uses now."""
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        return listener.getsockname()[1]


def is_open(port: int) -> bool:
    """Return whether something answers at a port of the loopback."""
    with socket.socket() as caller:
        return caller.connect_ex((HOST, port)) == 0


def _processes_with(variable: str) -> list[int]:
    """Return processes with a variable in their environment, `NAME=VALUE` (Linux only)."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # somebody else's, or it has ended
            if variable.encode() in (path / "environ").read_bytes().split(b"\0"):
                found.append(int(path.name))
    return found


def _difference(out: Path, means: list[Weights]) -> float:
    """Return the largest difference of any weight in any round."""
    largest = 0.0
    for number, mean in enumerate(means):
        state = load_checkpoint(out / "weights" / f"round-{number:05d}.safetensors")
        largest = max([largest, *(float(np.abs(state["weights"][name] - mean[name]).max())
                                  for name in mean)])
    return largest


def _cases(seed: int) -> dict[str, dict]:
    base: dict[str, Any] = {
        "real_episodes": 2, "episodes": 200, "federate_every": 40, "hidden": 32, "flights": 32,
        "epsilon_slots": 10_000, "survey_flights": 3, "timeout_s": 900, "killed_after": 0,
        "compare_means": False}
    cases = {"in-process": base | {"engine": "in-process"},
             "flower, one killed": base | {"engine": "flower", "killed_after": 3}}
    if seed == 0:
        cases["flower"] = base | {"engine": "flower", "compare_means": True}
    return cases


def _table(rows: pd.DataFrame) -> str:
    lines = []
    for name, group in rows.groupby("name", sort=False):
        each = np.array(group["reward"].tolist())
        first = group.iloc[0]
        heard, seconds, difference = (
            first.get(key) for key in ("heard", "seconds", "largest_difference"))
        lines.append([str(name), str(len(group)), *(with_sd(each[:, party]) for party in range(3)),
                      with_sd(group["mean_reward"].to_numpy()),
                      " ".join(map(str, heard)) if isinstance(heard, list) else "–",
                      rounded(float(np.median(seconds)), 0) if isinstance(seconds, list) else "–",
                      difference if isinstance(difference, str) else "–"])
    return markdown(["", "seeds", "RBM", "RDM", "RBM, measured", "mean of the parties",
                     "parties heard in each round (seed 0)", "seconds a round, median",
                     "largest difference of a weight"], lines)


STUDIES = {"flower": Study(
    "Does a federation over Flower's processes collect what one in a single process does?",
    measure, _cases, _table)}
