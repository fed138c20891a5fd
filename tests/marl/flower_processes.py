"""Flower's processes on this machine, as docs/federation.md has users start them on several: no TLS, no keys."""

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
from typing import Self

import tomli_w

from marl.fedqmix.client import Party
from marl.fedqmix.session import node_config
from radiotwin.errors import RunFailed

HOST, POLL_S, START_S, RESTART_S = "127.0.0.1", 0.5, 120.0, 15.0


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
