"""Run jobs on a Ray cluster, with one actor for each worker."""

import contextlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput, RunFailed, optional_package
from radiotwin.io.signals import deferred, kept_from_children
from radiotwin.runtime.jobs import (
    SHARE_ROUNDING,
    Death,
    Outcome,
    PieceRunner,
    Pool,
    Resources,
    Worker,
    thread_variables,
)
from radiotwin.runtime.pieces import versions
from radiotwin.runtime.processes import usable_cores

OWN = "auto"
STORE_BYTES = 128 * 2**20  # object store of our own cluster: pieces and results are small
START_S = 120  # timeout for workers to start
STOP_S = 20  # timeout for our own cluster to end
# All are read when Ray is imported. Without the possibility of other machines Ray listens on the
# loopback interface only; that variable's name is from the systems where this is the default.
_OF_OWN_CLUSTER = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
                   "RAY_AUTH_MODE": "token"}


# A cluster of one command, in a process group of its own: it prints its address, and ends itself
# when its standard input closes, as that of a killed driver does. Ray's own helpers may outlive a
# killed driver by a minute.
_HEAD_PROGRAM = """
import json, os, shutil, signal, sys
options = json.loads(sys.stdin.readline())
import ray
try:
    head = ray.init(include_dashboard=False, log_to_driver=False, configure_logging=False,
                    **options)
    print(json.dumps({"address": head.address_info["address"]}), flush=True)
    sys.stdin.read()
    ray.shutdown()
finally:
    shutil.rmtree(options["_temp_dir"], ignore_errors=True)
    os.killpg(os.getpgrp(), signal.SIGKILL)
"""


class RayPool(Pool["_RayWorker"]):
    """Actors of a Ray cluster.

    Args:
        address: HOST:PORT of a running cluster; `auto`: start a cluster on this machine, with a
            token, on the loopback interface, without a dashboard, which ends with the pool.
        workers: their number; None: as many as free cores and memory of the cluster allow.

    Raises:
        BadInput: Ray is not installed, there is no such cluster, or it runs other versions.
    """

    name = "a Ray cluster"

    def __init__(self, address: str, workers: int | None = None) -> None:
        super().__init__(workers)
        self._head: _Head | None = None
        if address == OWN:
            _require_token()
        self._ray = optional_package(
            "ray", "--cluster needs Ray, which is not installed; install it with `pip install "
                   "'radiotwin[ray]'`, or leave the option out")
        try:
            if address == OWN:
                self._head = _Head(workers or usable_cores())
                self.name, address = "a Ray cluster of this machine", self._head.address
            self._connect(address)
        except BaseException:
            self.close()
            raise

    def _connect(self, address: str) -> None:
        """Join a running cluster; BadInput if that fails, or it runs other versions."""
        ray = self._ray
        if ray.is_initialized():
            raise BadInput("--cluster: this process is connected to a Ray cluster already; end "
                           "that with ray.shutdown()")
        # Workers search for modules in the driver's working folder first: that may be a stranger's.
        with tempfile.TemporaryDirectory() as empty, contextlib.chdir(empty), _own_handlers():
            try:
                ray.init(address=address, log_to_driver=False, configure_logging=False)
            except Exception as error:  # noqa: BLE001  # of many kinds
                raise BadInput(f"--cluster {address[:200]}: cannot be joined "
                               f"({_first_line(error)}); `ray status` there says whether it runs, "
                               "RAY_AUTH_TOKEN must be its token") from None
        self._require_same_versions(address)

    def _require_same_versions(self, address: str) -> None:
        """Raise BadInput about a node with other versions of Python, radiotwin or libraries."""
        ray = self._ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        ask = ray.remote(num_cpus=0, max_retries=0)(_versions)
        nodes = [node for node in ray.nodes() if node["Alive"]]
        asked = {node["NodeManagerAddress"]: ask.options(
            scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote()
            for node in nodes}
        for host, answer in asked.items():
            try:
                found = ray.get(answer, timeout=START_S)
            except Exception as error:  # noqa: BLE001  # of many kinds
                raise BadInput(f"--cluster {address}: node {host} cannot run radiotwin "
                               f"({_first_line(error)}); install the same version of it there"
                               ) from None
            if set(found) ^ set(versions()):
                raise BadInput(
                    f"--cluster {address}: node {host} has other versions than this machine: "
                    f"{', '.join(map(_named, sorted(set(found) - set(versions()))))} there, "
                    f"{', '.join(map(_named, sorted(set(versions()) - set(found))))} here; install "
                    "the same on all, or results would differ")

    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        """Return workers for a job, at most `count`; RunFailed if the cluster has no room."""
        wanted = min(self._capacity(resources), count)
        same = [each for each in self._workers if each.resources == resources][:wanted]
        for each in self._workers:
            if each not in same:
                each.close()
        new = [_RayWorker(self._ray, resources) for _ in range(wanted - len(same))]
        self._workers = same + new
        sent = self._ray.put(function)
        for each in self._workers:
            each.function = sent
        return self._workers

    def _capacity(self, resources: Resources) -> int:
        """Return how many workers to start; RunFailed if those asked for, or one, do not fit."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        needs = {"CPU": resources.cores, "memory": resources.memory_bytes,
                 "GPU": resources.gpu_share}
        fitting = sum(min(int(node.get(name, 0) / need + SHARE_ROUNDING)
                          for name, need in needs.items() if need) for node in nodes)
        if fitting < (self._most or 1):
            raise RunFailed(
                f"{self.name} has room for {fitting} workers of {resources.cores} core(s), "
                f"{resources.memory_bytes / 2**30:.1f} GiB and {resources.gpu_share:g} GPUs each; "
                f"{self._most or 1} are asked for: ask for fewer, or add nodes")
        return self._most or fitting

    def close(self) -> None:
        """End all workers, and the cluster if it is our own."""
        with deferred():
            super().close()
            self._ray.shutdown()
            if self._head is not None:
                self._head.close()
                self._head = None


class _Head:
    """A Ray cluster on this machine that ends with this process."""

    def __init__(self, cores: int) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="radiotwin-ray-"))
        with kept_from_children():
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _HEAD_PROGRAM],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                start_new_session=True, cwd=self._folder)
        assert self._process.stdin is not None and self._process.stdout is not None
        options = {"num_cpus": cores, "_temp_dir": str(self._folder),
                   "object_store_memory": STORE_BYTES,
                   # Processes started in advance would not have the workers' environment.
                   "_system_config": {"prestart_worker_first_driver": False}}
        self._process.stdin.write(json.dumps(options) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            said = self._process.stderr.read() if self._process.stderr else ""
            self.close()
            raise RunFailed("a Ray cluster could not be started on this machine: "
                            + (said.strip().splitlines() or ["no reason is given"])[-1][:300])
        self.address: str = json.loads(line)["address"]

    def close(self) -> None:
        """End the cluster and remove its files."""
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, 9)
            self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)


class _RayWorker(Worker):
    """An actor of a Ray cluster."""

    def __init__(self, ray: Any, resources: Resources) -> None:
        super().__init__(resources)
        self._ray = ray

    def start(self) -> None:
        resources = self.resources
        self.process = self._ray.remote(PieceRunner).options(
            num_cpus=resources.cores, num_gpus=resources.gpu_share or None,
            memory=resources.memory_bytes or None, max_restarts=0,
            runtime_env={"env_vars": thread_variables(resources.cores)}).remote()

    def run(self, *arguments: Any) -> "Future[Outcome]":
        return self.process.run.remote(*arguments).future()

    def death(self, error: BaseException) -> Death | None:
        """Return why the process died, if an error means that; None: an error of the function."""
        exceptions = self._ray.exceptions
        if isinstance(error, exceptions.OutOfMemoryError):
            self.close()
            return Death("its machine was short of memory", memory=True)
        if isinstance(error, exceptions.RayActorError | exceptions.WorkerCrashedError
                      | exceptions.NodeDiedError):
            self.close()
            return Death(_first_line(error))
        return None

    def raised(self, error: BaseException) -> BaseException:
        return getattr(error, "cause", None) or error

    def close(self) -> None:
        if self.process is not None:
            self._ray.kill(self.process)
            self.process = None


@contextlib.contextmanager
def _own_handlers() -> Iterator[None]:
    """Restore this program's handler of SIGTERM after the block, in which Ray replaces it."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


def _versions() -> tuple[str, ...]:
    """Return `versions()` as a plain function, which Ray needs."""
    return versions()


def _require_token() -> None:
    """Set the environment of our own Ray cluster, with a token that keeps strangers out."""
    if any(os.environ.get(name) != value for name, value in _OF_OWN_CLUSTER.items()):
        if "ray" in sys.modules:
            raise BadInput("--cluster auto: this process imported Ray before its token was set; "
                           "import radiotwin's part first, or give the address of your cluster")
        os.environ.update(_OF_OWN_CLUSTER)
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))


def _first_line(error: BaseException) -> str:
    """Return the first line of an error's message; the last one of a traceback."""
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return (lines[-1] if "Traceback" in str(error) else lines[0])[:300] if lines else \
        type(error).__name__


def _named(version: str) -> str:
    """Return a version for a message; the hash of the sources is shortened."""
    return version if " " in version or "." in version or not version.isalnum() else \
        f"radiotwin's sources {version[:8]}"
