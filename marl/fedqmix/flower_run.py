"""A federation on this machine: Flower's processes, started, watched and ended.

Either Flower's simulation engine, or a SuperLink and a SuperNode for each party as real processes.
Both speak TLS on the loopback; real SuperNodes prove who they are, too. Keys and certificates are
made for a run, and are worth nothing after it.
"""

import datetime
import ipaddress
import json
import os
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import tomli_w
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from marl.fedqmix.client import Party
from marl.fedqmix.flower_app import DONE, FOLDER, PARTIES, WEIGHTS
from radiotwin.errors import RunFailed
from radiotwin.runtime.console import notice
from radiotwin.runtime.processes import die_with_parent

LIFETIME = datetime.timedelta(days=30)
HOST, LINK = "127.0.0.1", "federation"
START_S, END_S, POLL_S, STATUS_S, RESTART_S = 120.0, 15.0, 0.5, 30.0, 15.0
SHORT_S = 0.05
_LAST_LINES = 15  # of a log, in a message


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate for this machine's loopback, which is its own authority, and its key.

    Returns:
        paths of both, in PEM.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "radiotwin federation")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = x509.CertificateBuilder(
        name, name, key.public_key(), x509.random_serial_number(),
        now - datetime.timedelta(minutes=5), now + LIFETIME).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True).add_extension(
        x509.SubjectAlternativeName([x509.DNSName("localhost"),
                                     x509.IPAddress(ipaddress.ip_address(HOST))]),
        critical=False).sign(key, hashes.SHA256())
    paths = folder / "ca.crt", folder / "server.key"
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    _write_secret(paths[1], key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption()))
    return paths


def make_node_key(path: Path) -> Path:
    """Write a SuperNode's private key, in the form of `ssh-keygen -t ecdsa -b 384`.

    Returns:
        The path of the public key, with the suffix `.pub`, which the coordinator registers.
    """
    key = ec.generate_private_key(ec.SECP384R1())
    _write_secret(path, key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH,
        serialization.NoEncryption()))
    public = path.with_suffix(".pub")
    public.write_bytes(key.public_key().public_bytes(
        serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH))
    return public


def _write_secret(path: Path, content: bytes) -> None:
    path.touch(mode=0o600)
    path.write_bytes(content)


class Processes:
    """Flower's commands with one environment; all that were started are ended by `close`.

    Args:
        home: folder of keys and of what Flower keeps.
        logs: folder of logs.
        environment: variables for all of them.
    """

    def __init__(self, home: Path, logs: Path, environment: dict[str, str]) -> None:
        self._home, self._logs, self._running = home, logs, dict[str, subprocess.Popen]()
        binaries = str(Path(sys.executable).parent)
        self._environment = os.environ | {
            "PATH": os.pathsep.join([binaries, os.environ.get("PATH", os.defpath)]),
            "FLWR_HOME": str(home), "FLWR_TELEMETRY_ENABLED": "0",
            "FLWR_DISABLE_UPDATE_CHECK": "1", "OMP_NUM_THREADS": "1"} | environment

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a process; its log has its name."""
        parent = os.getpid()
        with open(self._logs / f"{name}.log", "ab") as log:
            self._running[name] = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True, preexec_fn=lambda: die_with_parent(parent))

    def call(self, command: Sequence[str]) -> str:
        """Run a command to its end, and return what it printed.

        Raises:
            RunFailed: it failed, or took too long.
        """
        try:
            done = subprocess.run(command, env=self._environment, stdin=subprocess.DEVNULL,
                                  capture_output=True, text=True, timeout=START_S, check=False)
        except subprocess.TimeoutExpired:
            raise RunFailed(f"{shlex.join(command)} takes longer than {START_S:.0f} s") from None
        if done.returncode:
            raise RunFailed(f"{shlex.join(command)} failed: {(done.stdout + done.stderr)[-800:]}")
        return done.stdout

    def is_running(self, name: str) -> bool:
        """Return whether a process that was started has not ended."""
        return self._running[name].poll() is None

    def end_of_log(self, name: str) -> str:
        """Return the last lines of a process's log."""
        log = (self._logs / f"{name}.log").read_text(errors="replace").splitlines()
        return "\n".join(log[-_LAST_LINES:])

    def kill(self, name: str) -> None:
        """End a process as a power cut would; what it has started notices by itself."""
        self._running[name].kill()

    def close(self) -> None:
        """End all of them, the last started first, and whatever they have started."""
        for process in reversed(self._running.values()):
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        end = time.monotonic() + END_S
        while (left := _processes_with(f"FLWR_HOME={self._home}")) and time.monotonic() < end:
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, 9)
            time.sleep(SHORT_S)


class Federation:
    """A coordinator and its parties on this machine.

    Args:
        parties: one for each SuperNode.
        out: folder of results: `weights/`, `rounds.csv`, `logs/`.
        home: folder for keys and for what Flower keeps, to be removed afterwards.
        simulation: in Flower's simulation engine.
    """

    def __init__(self, parties: Sequence[Party], out: Path, home: Path, simulation: bool) -> None:
        self._parties, self._home, self._simulation = parties, home, simulation
        self._out, self._started = out, dict[int, float]()
        logs = out / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        configs = [_config_of(party) for party in parties]
        environment = {FOLDER: str(out.absolute())}
        if simulation:
            (home / "parties.json").write_text(json.dumps(configs))
            environment[PARTIES] = str(home / "parties.json")
        self.processes = Processes(home, logs, environment)
        self._certificate, self._key = make_certificate(home)
        self._port = free_port()
        self.ports = [self._port]  # that were opened
        self._link = f"{HOST}:{self._port}"
        (home / "config.toml").write_text(tomli_w.dumps({"superlink": {
            "default": LINK,
            LINK: {"address": self._link, "root-certificates": str(self._certificate)}}}))
        for number, config in enumerate(configs):
            (home / f"node-{number}.toml").write_text(tomli_w.dumps(config))

    def open(self) -> None:
        """Start the SuperLink and the SuperNodes.

        Raises:
            RunFailed: one of them does not start.
        """
        certificate = str(self._certificate)
        self.processes.start("superlink", [
            "flower-superlink", "--host", HOST, "--port", str(self._port),
            "--ssl-ca-certfile", certificate, "--ssl-certfile", certificate,
            "--ssl-keyfile", str(self._key), "--disable-runtime-dependency-installation",
            "--simulation" if self._simulation else "--enable-supernode-auth"])
        self._wait_for_superlink()
        if not self._simulation:
            for number in range(len(self._parties)):
                public = make_node_key(self._home / f"node-{number}")
                self.processes.call(["flwr", "supernode", "register", str(public), LINK])
                self.start_node(number)

    def start_node(self, number: int) -> None:
        """Start the SuperNode of a party."""
        self._started[number] = time.monotonic()
        self.ports.append(free_port())
        self.processes.start(f"supernode-{number}", [
            "flower-supernode", "--superlink", self._link, "--root-certificates",
            str(self._certificate), "--auth-supernode-private-key",
            str(self._home / f"node-{number}"), "--host", HOST, "--port", str(self.ports[-1]),
            "--node-config", str(self._home / f"node-{number}.toml")])

    def run(self, app: Path) -> str:
        """Submit the app, and return the number of its run.

        Raises:
            RunFailed: Flower does not take it.
        """
        command = ["flwr", "run", str(app), LINK, "--format", "json"]
        if self._simulation:
            command += ["--federation-config", f"num-supernodes={len(self._parties)} "
                        "client-resources-num-cpus=1"]
        answer = json.loads(self.processes.call(command))
        if not answer.get("run-id"):  # with JSON, its exit status says nothing
            raise RunFailed(f"flwr run has failed: {str(answer)[:800]}")
        return str(answer["run-id"])

    def watch(self, run: str, on_progress: Callable[[int], None]) -> None:
        """Wait for the end of a run; a SuperNode that ends is started again.

        Flower takes a SuperNode that was killed back when it has missed two heartbeats, which is
        after a minute; until then it ends again.

        Args:
            run: its number.
            on_progress: called with the number of rounds since the last call.

        Raises:
            RunFailed: the run or the SuperLink has ended early.
        """
        done, asked = 0, time.monotonic()
        while True:
            self._require_superlink()
            if not self._simulation:
                self._start_again()
            rounds = len(list((self._out / WEIGHTS).glob("round-*"))) - 1  # and the initial ones
            if rounds > done:
                on_progress(rounds - done)
                done = rounds
            ended = (self._out / DONE).exists()
            # Asking takes seconds of a processor.
            if ended or time.monotonic() - asked > STATUS_S:
                status, asked = self._status(run), time.monotonic()
                if status == "finished:completed":
                    return
                if status.startswith("finished"):
                    raise RunFailed(f"Flower's run is {status}; the log of the SuperLink ends "
                                    "with\n" + self.processes.end_of_log("superlink"))
            time.sleep(POLL_S)

    def close(self) -> None:
        """End all processes."""
        self.processes.close()

    def _status(self, run: str) -> str:
        listed = json.loads(self.processes.call(["flwr", "list", LINK, "--run-id", run, "--format",
                                                 "json"]))
        return str(listed["runs"][0]["status"])

    def _start_again(self) -> None:
        for number in range(len(self._parties)):
            if not self.processes.is_running(f"supernode-{number}") and \
                    time.monotonic() - self._started[number] > RESTART_S:
                notice(f"the SuperNode of party {number} has ended; it is started again")
                self.start_node(number)

    def _require_superlink(self) -> None:
        if not self.processes.is_running("superlink"):
            raise RunFailed("the SuperLink has ended; its log ends with\n"
                            + self.processes.end_of_log("superlink"))

    def _wait_for_superlink(self) -> None:
        end = time.monotonic() + START_S
        while True:
            with socket.socket() as caller:
                if caller.connect_ex((HOST, self._port)) == 0:
                    return
            self._require_superlink()
            if time.monotonic() > end:
                raise RunFailed(f"the SuperLink does not answer for {START_S:.0f} s")
            time.sleep(POLL_S)


def free_port() -> int:
    """Return a port of the loopback that nothing uses now."""
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        return listener.getsockname()[1]


def _config_of(party: Party) -> dict[str, str | int]:
    config: dict[str, str | int] = {
        "scene": str(party.scene.absolute()), "out": str(party.folder.absolute()),
        "number": party.number, "truth": party.truth, "device": party.device}
    if party.measurements is not None:
        config["measurements"] = str(party.measurements.absolute())
    return config


def _processes_with(variable: str) -> list[int]:
    """Return processes with a variable in their environment, `NAME=VALUE` (Linux only)."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # somebody else's, or it has ended
            if variable.encode() in (path / "environ").read_bytes().split(b"\0"):
                found.append(int(path.name))
    return found
