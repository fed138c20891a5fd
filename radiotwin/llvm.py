"""Find a libLLVM that Dr.Jit can use, and name it to Dr.Jit before Dr.Jit is imported.

Dr.Jit loads libLLVM when it is imported, takes the first that it meets, and cannot be told otherwise later.
One older than 15 leaves it without a CPU backend ("could not be found", though it was); 15 and 16 load, and
abort the whole process at the first kernel that they cannot compile. So each candidate is tried in a process
of its own.

`python -m radiotwin.llvm` prints the library that would be used, or says why there is none and exits with 1.
"""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from radiotwin.errors import BadInput, RunFailed
from radiotwin.files import atomic_path

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM_VERSION = 17
PROBE_TIMEOUT_S = 120

# libLLVM-14.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.19.dylib, libLLVM.dylib, LLVM-C.dll; neither
# the parts of LLVM (libLLVMCore.so) nor what rustc brings for itself (libLLVM-17-rust-1.77.0-stable.so).
_NAME = re.compile(
    r"libLLVM(?:[-.](?P<before>\d+(?:\.\d+)*))?\.(?:so|dylib)(?:\.(?P<after>\d+(?:\.\d+)*))?|LLVM-C\.dll"
)
_FOLDERS = (
    "/usr/lib", "/usr/lib64", "/usr/lib/*-linux-*", "/usr/lib/llvm*/lib", "/usr/lib64/llvm*/lib*",
    "/usr/local/lib", "/usr/local/lib64", "/usr/local/opt/llvm*/lib", "/opt/homebrew/opt/llvm*/lib",
    "/home/linuxbrew/.linuxbrew/opt/llvm*/lib", "/opt/local/libexec/llvm-*/lib",
)
_ASK_VERSION = """
import ctypes, sys
parts = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, parts))
print(*(part.value for part in parts))
"""
# The minimum is what LLVM 15 cannot compile. A new HOME keeps Dr.Jit from using a kernel out of its cache.
_PROBE = """
import ctypes, os, sys, tempfile
ctypes.CDLL(sys.argv[1])
with tempfile.TemporaryDirectory() as home:
    os.environ.update(DRJIT_LIBLLVM_PATH=sys.argv[1], HOME=home)
    import drjit
    from drjit.llvm import Float, UInt32
    x = drjit.arange(Float, 1000)
    drjit.make_opaque(x)
    y = drjit.fma(drjit.minimum(drjit.sqrt(x), drjit.abs(x - 3)), x, 2)
    kept = drjit.gather(Float, y, drjit.compress(y > 4))
    total = drjit.zeros(Float, 10)
    drjit.scatter_add(total, x, UInt32(x) % 10)
    if len(kept) != 996 or float(total[9]) != 50400:
        sys.exit(f"a kernel gave wrong values: {len(kept)} for 996, {float(total[9])} for 50400")
"""


@dataclass(frozen=True)
class Candidate:
    """A libLLVM on this machine. `version` is None where neither its name nor the library itself tells."""

    path: Path
    version: tuple[int, ...] | None

    def __str__(self) -> str:
        return f"{self.path} (version {'.'.join(map(str, self.version)) if self.version else 'unknown'})"


def _version_in_name(name: str) -> tuple[int, ...] | None:
    match = _NAME.fullmatch(name)
    digits = match and (match["before"] or match["after"])
    return tuple(map(int, digits.split("."))) if digits else None


def _run_python(program: str, path: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, str(path)]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S)


def _version_by_asking(path: Path) -> tuple[int, ...] | None:
    """What the library says of itself; None where it cannot be loaded, or is older than 16 and cannot say."""
    try:
        answer = _run_python(_ASK_VERSION, path)
    except subprocess.TimeoutExpired:
        return None
    return tuple(map(int, answer.stdout.split())) if answer.returncode == 0 else None


def search_folders() -> list[Path]:
    """The folders where this system, Homebrew, MacPorts, conda or an LLVM installer puts libLLVM."""
    folders = [Path(found) for pattern in _FOLDERS for found in sorted(Path("/").glob(pattern[1:]))]
    for prefix in (sys.prefix, sys.base_prefix, os.environ.get("CONDA_PREFIX")):
        if prefix:
            folders += [Path(prefix) / "lib", Path(prefix) / "Library" / "bin"]
    for name in ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH"):
        folders += [Path(entry) for entry in os.environ.get(name, "").split(os.pathsep) if entry]
    if "ProgramFiles" in os.environ:
        folders.append(Path(os.environ["ProgramFiles"]) / "LLVM" / "bin")
    return folders


def _loader_files() -> list[Path]:
    """What the dynamic loader of Linux knows, wherever it lies."""
    ldconfig = shutil.which("ldconfig") or shutil.which("ldconfig", path="/sbin:/usr/sbin")
    if ldconfig is None or platform.system() != "Linux":
        return []
    listing = subprocess.run([ldconfig, "-p"], check=False, capture_output=True, text=True)
    return [Path(line.rpartition(" => ")[2]) for line in listing.stdout.splitlines() if "libLLVM" in line]


def find() -> list[Candidate]:
    """Every libLLVM on this machine, the newest first; also what DRJIT_LIBLLVM_PATH names, there or not."""
    files = _loader_files()
    for folder in search_folders():
        files += sorted(file for pattern in ("libLLVM*", "LLVM-C.dll") for file in folder.glob(pattern))
    # Links are followed: one library has many names, and a link without a number points to a name with one.
    paths = {file.resolve(): None for file in files if _NAME.fullmatch(file.name) and file.is_file()}
    if os.environ.get(VARIABLE):
        named = Path(os.environ[VARIABLE])
        paths[named.resolve() if named.is_file() else named] = None
    candidates = [Candidate(path, _version_in_name(path.name) or _version_by_asking(path)) for path in paths]
    return sorted(candidates, key=lambda candidate: candidate.version or (0,), reverse=True)


def probe(path: Path) -> str | None:
    """Compile and run a kernel with this library in a process of its own; None, or what went wrong."""
    try:
        done = _run_python(_PROBE, path)
    except subprocess.TimeoutExpired:
        return f"a kernel did not end within {PROBE_TIMEOUT_S} s"
    if done.returncode == 0:
        return None
    if done.returncode < 0:
        return f"a kernel killed the process (signal {-done.returncode})"
    complaint = done.stderr.strip().splitlines() or [f"a kernel ended with exit status {done.returncode}"]
    return complaint[-1].removeprefix("OSError: ")


def _memory_file() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "radiotwin" / "llvm.json"


def _probe_key(path: Path) -> list:
    """What a probe's result holds for: this file, this Dr.Jit, this Python."""
    status = path.stat()
    return [str(path), status.st_mtime_ns, status.st_size, version("drjit"), sys.executable]


def _remembered() -> list:
    """Keys of the probes that passed; a file that is missing or unreadable counts as none."""
    try:
        content = json.loads(_memory_file().read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError):
        return []
    return content if isinstance(content, list) else []


def _remember(key: list) -> None:
    """Save the cost of the next probe. Where the folder cannot be written, it is simply paid again."""
    try:
        passed = [old for old in _remembered() if isinstance(old, list) and old[:1] != key[:1]]
        with atomic_path(_memory_file()) as temporary:
            temporary.write_text(json.dumps([*passed, key]), encoding="utf-8")
    except (OSError, RuntimeError, BadInput):
        pass


@cache
def refusal(candidate: Candidate) -> str | None:
    """Why this library cannot be used, or None if it can. A pass is remembered over runs, a failure not."""
    if candidate.version and candidate.version[0] < MINIMUM_VERSION:
        return f"too old: Dr.Jit needs version {MINIMUM_VERSION} or newer"
    try:
        key = _probe_key(candidate.path)
    except (OSError, PackageNotFoundError):  # a name that only the loader resolves, or no Dr.Jit
        return probe(candidate.path)
    if key in _remembered():
        return None
    reason = probe(candidate.path)
    if reason is None:
        _remember(key)
    return reason


def _eligible() -> list[Candidate]:
    """All that were found; with DRJIT_LIBLLVM_PATH set only that one, as Dr.Jit keeps to it as well."""
    candidates = find()
    if not os.environ.get(VARIABLE):
        return candidates
    named = Path(os.environ[VARIABLE])
    return [candidate for candidate in candidates if candidate.path in (named, named.resolve())]


def choose() -> Candidate | None:
    """The newest libLLVM that works (where DRJIT_LIBLLVM_PATH is set: that one, if it works), or None."""
    return next((candidate for candidate in _eligible() if refusal(candidate) is None), None)


def available() -> bool:
    """Whether rays can be traced on this machine's processor."""
    return choose() is not None


def install_line() -> str:
    """The one line that installs a libLLVM on this machine."""
    system = platform.system()
    if os.environ.get("CONDA_PREFIX"):
        return f"conda install -y -c conda-forge {'libllvm-c19' if system == 'Windows' else 'libllvm19'}"
    if system == "Darwin":
        return "brew install llvm"
    if system == "Windows":
        return "winget install LLVM.LLVM"
    sudo = "" if os.geteuid() == 0 else "sudo "
    managers = {
        "apt-get": "apt-get install -y libllvm19  # not known there? see https://apt.llvm.org",
        "dnf": "dnf install -y llvm-libs",
        "pacman": "pacman -S --noconfirm llvm-libs",
        "zypper": "zypper install -y libLLVM19",
        "apk": "apk add llvm19-libs",
    }
    line = next((line for manager, line in managers.items() if shutil.which(manager)), None)
    return sudo + line if line else "this system's package manager has it as libLLVM, llvm or llvm-libs"


def advice() -> str:
    """What was found, why none of it can be used, and what to do about it."""
    named = os.environ.get(VARIABLE)
    return "\n".join([
        f"tracing needs libLLVM {MINIMUM_VERSION} or newer, and "
        + (f"{VARIABLE} names one that does not work:" if named else "none that works was found."),
        *(f"  {candidate}: {refusal(candidate)}" for candidate in _eligible()),
        f"To have another one looked for: unset {VARIABLE}" if named else f"To install one: {install_line()}",
        f"To use one that lies elsewhere: name it in {VARIABLE}. Everything but tracing works without any.",
    ])


def prepare() -> None:
    """Name the chosen libLLVM in DRJIT_LIBLLVM_PATH. Call it before drjit, mitsuba or sionna.rt is imported.

    Raises:
        RunFailed: no libLLVM works, or Dr.Jit was imported earlier and took one that does not.
    """
    if "drjit" in sys.modules:
        if sys.modules["drjit"].detail.llvm_version()[0] >= MINIMUM_VERSION:
            return
        raise RunFailed(
            "drjit was imported before radiotwin could choose its libLLVM, and has none that works; import "
            "radiotwin.trace before drjit, mitsuba and sionna.rt" if available() else advice()
        )
    chosen = choose()
    if chosen is None:
        raise RunFailed(advice())
    os.environ[VARIABLE] = str(chosen.path)


if __name__ == "__main__":
    try:
        prepare()
    except RunFailed as problem:
        sys.exit(str(problem))
    print(os.environ[VARIABLE])
