"""One command on damaged files, in a forked child that is watched; the rule that its outcome must keep.

Forked from a process that has imported everything: a case takes the time of the command alone.
"""

import contextlib
import os
import resource
import shutil
import signal
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.honest import one_core, run_command

ALLOWED_STATUS = (0, 2, 130)
MAX_PEAK_BYTES, MAX_CPU_S = 2 * 2**30, 60
MAX_WALL_S = 240  # other work shares the processor; a command that waits for ever takes no time of it
CANARY = "only for its owner: 4711"
_SECRETS = ("/etc/passwd", "/etc/shadow", "/proc/self/environ")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_BREACHES_FILE = "breaches.txt"


@dataclass(frozen=True)
class Outcome:
    """What a command did.

    `breaches`: rules of the sandbox that it broke; empty for a good outcome.
    """

    status: int
    output: str
    breaches: tuple[str, ...]


def run_watched(command: str, case: Path, listener: socket.socket) -> Outcome:
    """Run a command in `case / "work"`.

    `case` holds a canary beside it, which no command may read; `listener` is a server which nothing may call.
    """
    (case / "canary").write_text(CANARY)
    for name in ("home", "tmp"):
        (case / name).mkdir(exist_ok=True)
    started = time.monotonic()
    inherited = resident_bytes(os.getpid())  # a child begins with what this process holds
    pid = os.fork()
    if pid == 0:
        _child(command, case)
    status, killed = _wait(pid, started, inherited)
    output = (case / "output.txt").read_text(errors="replace")
    breaches = [killed] if killed else []
    if not killed and status not in ALLOWED_STATUS:
        breaches.append(f"exit status {status}")
    if "Traceback" in output:
        breaches.append("traceback")
    with contextlib.suppress(FileNotFoundError):
        breaches += sorted(set((case / _BREACHES_FILE).read_text(errors="replace").splitlines()))
    breaches += _leaks(case, listener)
    return Outcome(status, output, tuple(breaches))


def arguments_of(command: str) -> list[str]:
    """Return the arguments of a command line, or those in a file, `@FILE`, with NUL between them."""
    if command.startswith("@"):
        return Path(command[1:]).read_text(encoding="utf-8", errors="surrogateescape").split("\0")
    return command.split(" ")


def _leaks(case: Path, listener: socket.socket) -> list[str]:
    found = []
    with contextlib.suppress(BlockingIOError):
        listener.accept()[0].close()
        found.append("network: a connection was opened")
    for path in case.joinpath("work").rglob("*"):
        if path.name.startswith(".radiotwin-"):
            found.append("temporary left over")
        elif path.is_file() and not path.is_symlink() and path.stat().st_size < 2**24 \
                and CANARY.encode() in path.read_bytes():
            found.append("canary in an output")
    if any(case.joinpath("tmp").iterdir()):
        found.append("left over in the temporary folder")
    return sorted(set(found))


def resident_bytes(pid: int) -> int:
    """Return the memory that a process holds [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _wait(pid: int, started: float, inherited: int) -> tuple[int, str]:
    killed = ""
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), killed
        with contextlib.suppress(OSError, IndexError, ValueError):
            if resident_bytes(pid) - inherited > MAX_PEAK_BYTES:
                killed = killed or f"memory above {MAX_PEAK_BYTES // 2**20} MiB"
            if _cpu_s(pid) > MAX_CPU_S:
                killed = killed or f"longer than {MAX_CPU_S} s"
        if time.monotonic() - started > MAX_WALL_S:
            killed = killed or f"waits for {MAX_WALL_S} s"
        if killed:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _child(command: str, case: Path) -> None:
    """Run the command line as its process would, and end this process without returning."""
    status = 70
    try:
        output = os.open(case / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)
        os.chdir(case / "work")
        os.environ |= {"HOME": str(case / "home"), "XDG_CACHE_HOME": str(case / "home"),
                       "RADIOTWIN_CACHE": str(case / "home"), "TMPDIR": str(case / "tmp"), "COLUMNS": "100"}
        import tempfile
        tempfile.tempdir = str(case / "tmp")
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**30, 2**30))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.dont_write_bytecode = True
        sys.argv = arguments_of(command)
        breaches = os.open(case / _BREACHES_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        sys.addaudithook(_Watch(case, breaches))
        try:
            with one_core():
                run_command(sys.argv[0])
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        import traceback
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(status & 255)


class _Watch:
    """Audit hook: writes down what a command must not do; it does not forbid it."""

    def __init__(self, case: Path, breaches: int) -> None:
        self.inside = (str(case / "work"), str(case / "home"), str(case / "tmp"), os.devnull)
        self.case, self.breaches, self.busy = case, breaches, False

    def __call__(self, event: str, arguments: tuple) -> None:
        if self.busy or event not in _EVENTS:
            return
        self.busy = True
        try:
            text = getattr(self, _EVENTS[event])(event, arguments)
            if text:
                os.write(self.breaches, (text.replace("\n", " ") + "\n").encode("utf-8", "replace"))
        finally:
            self.busy = False

    def _open(self, event: str, arguments: tuple) -> str | None:
        path, mode, flags = arguments
        if not isinstance(path, str | bytes | os.PathLike):
            return None
        path = os.path.realpath(os.fsdecode(path))
        if "__pycache__" in path:  # numba compiles once, for all later runs
            return None
        if flags & _WRITING or (isinstance(mode, str) and set(mode) & set("wax+")):
            return None if path.startswith(self.inside) else f"writes outside: {path}"
        if path in _SECRETS or path == str(self.case / "canary"):
            return f"reads outside: {path}"
        return None

    def _change(self, event: str, arguments: tuple) -> str | None:
        paths = [os.path.realpath(os.fsdecode(each)) for each in arguments if isinstance(each, str | bytes | os.PathLike)]
        outside = [path for path in paths if not path.startswith(self.inside) and "__pycache__" not in path]
        return f"{event} outside: {outside[0]}" if outside else None

    def _always(self, event: str, arguments: tuple) -> str | None:
        return f"{event}: {arguments[0] if event != 'socket.connect' else arguments[1]!r}"

    def _library(self, event: str, arguments: tuple) -> str | None:
        name = os.fsdecode(arguments[0]) if isinstance(arguments[0], str | bytes) else ""
        if os.sep not in name:  # looked for where the system's libraries are, not in the working folder
            return None
        path = os.path.realpath(name)
        return f"{event}: {path}" if path.startswith(self.inside[:3]) else None


_EVENTS = {
    "open": "_open", "os.remove": "_change", "os.rename": "_change", "os.mkdir": "_change", "os.rmdir": "_change",
    "os.symlink": "_change", "os.link": "_change", "os.chmod": "_change", "shutil.rmtree": "_change",
    "os.system": "_always", "subprocess.Popen": "_always", "os.exec": "_always", "os.posix_spawn": "_always",
    "socket.connect": "_always", "socket.getaddrinfo": "_always", "ctypes.dlopen": "_library"}


def prepare_case(honest: Path, case: Path) -> Path:
    """Copy the honest files to `case / "work"`; return that folder."""
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(honest, case / "work")
    return case / "work"
