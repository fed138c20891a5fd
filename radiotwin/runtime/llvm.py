"""Choice of a libLLVM that Dr.Jit can use, before Dr.Jit is imported.

Dr.Jit loads the first libLLVM that it finds when it is imported, and never another one. A version
below 15 leaves it without a CPU backend ("could not be found", though it was); 15 and 16 load, and
abort the process at the first kernel that they cannot compile. Therefore each candidate is tried in
a process of its own.

`python -m radiotwin.runtime.llvm` prints the library that would be used, or the reason why there is
none, with exit status 1.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from radiotwin.errors import RunFailed
from radiotwin.io.content_hash import content_hash

VARIABLE = "DRJIT_LIBLLVM_PATH"
MIN_VERSION = 17  # of Dr.Jit 1.5
PROBE_TIMEOUT_S = 120

# libLLVM-14.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.19.dylib, libLLVM.dylib and
# LLVM-C.dll; not the parts of LLVM (libLLVMCore.so), not rustc's own (libLLVM-17-rust-1.77.0.so).
_NAME = re.compile(r"libLLVM(?:[-.](?P<before>\d+(?:\.\d+)*))?\.(?:so|dylib)"
                   r"(?:\.(?P<after>\d+(?:\.\d+)*))?|LLVM-C\.dll")
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
# LLVM 15 cannot compile `minimum`. A new HOME keeps Dr.Jit from using a cached kernel.
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
    """A libLLVM on this machine; its version is None where neither its name nor itself gives it."""

    path: Path
    version: tuple[int, ...] | None

    def __str__(self) -> str:
        version = ".".join(map(str, self.version)) if self.version else "unknown"
        return f"{self.path} (version {version})"


def _version_in_name(name: str) -> tuple[int, ...] | None:
    match = _NAME.fullmatch(name)
    digits = match and (match["before"] or match["after"])
    return tuple(map(int, digits.split("."))) if digits else None


def _run_python(program: str, path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-P", "-c", program, str(path)], check=False,
                          capture_output=True, text=True, timeout=PROBE_TIMEOUT_S)


def _version_in_library(path: Path) -> tuple[int, ...] | None:
    """Return the version that the library reports; None if it cannot be loaded or is below 16."""
    try:
        answer = _run_python(_ASK_VERSION, path)
    except subprocess.TimeoutExpired:
        return None
    return tuple(map(int, answer.stdout.split())) if answer.returncode == 0 else None


def search_folders() -> list[Path]:
    """Return the folders where systems, Homebrew, MacPorts, conda and LLVM's installer put it."""
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
    """Return the libraries that the dynamic loader of Linux knows."""
    ldconfig = shutil.which("ldconfig") or shutil.which("ldconfig", path="/sbin:/usr/sbin")
    if ldconfig is None or platform.system() != "Linux":
        return []
    listing = subprocess.run([ldconfig, "-p"], check=False, capture_output=True, text=True)
    return [Path(line.rpartition(" => ")[2])
            for line in listing.stdout.splitlines() if "libLLVM" in line]


def find() -> list[Candidate]:
    """Find every libLLVM on this machine, the newest first.

    The list includes the file that DRJIT_LIBLLVM_PATH names, even if it does not exist.
    """
    files = _loader_files()
    for folder in search_folders():
        files += sorted(file for pattern in ("libLLVM*", "LLVM-C.dll")
                        for file in folder.glob(pattern))
    # Links are resolved: one library has many names, and a link without a version points to one.
    paths = {file.resolve(): None for file in files
             if _NAME.fullmatch(file.name) and file.is_file()}
    if os.environ.get(VARIABLE):
        named = Path(os.environ[VARIABLE])
        paths[named.resolve() if named.is_file() else named] = None
    candidates = [Candidate(path, _version_in_name(path.name) or _version_in_library(path))
                  for path in paths]
    return sorted(candidates, key=lambda candidate: candidate.version or (0,), reverse=True)


def probe(path: Path) -> str | None:
    """Compile and run a kernel in a process of its own; return why it fails, None if it works."""
    try:
        done = _run_python(_PROBE, path)
    except subprocess.TimeoutExpired:
        return f"a kernel did not end within {PROBE_TIMEOUT_S} s"
    if done.returncode == 0:
        return None
    if done.returncode < 0:
        return f"a kernel killed the process (signal {-done.returncode})"
    lines = done.stderr.strip().splitlines()
    complaint = lines[-1] if lines else f"a kernel ended with exit status {done.returncode}"
    return complaint.removeprefix("OSError: ")


def _passed(path: Path) -> Path:
    """Return the file that exists once a library has passed, with this Dr.Jit and Python."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    status = path.stat()
    key = content_hash((str(path), status.st_mtime_ns, status.st_size, version("drjit"),
                        sys.executable))
    return caches / "radiotwin" / f"llvm-{key}"


@cache
def rejection(candidate: Candidate) -> str | None:
    """Return the reason why a library cannot be used, or None if it can.

    Successful probes are remembered between runs, failures are not.
    """
    if candidate.version and candidate.version[0] < MIN_VERSION:
        return f"too old: Dr.Jit needs version {MIN_VERSION} or newer"
    try:
        passed = _passed(candidate.path)
    except (OSError, RuntimeError, PackageNotFoundError):  # no such file, home, or Dr.Jit
        return probe(candidate.path)
    if passed.exists():
        return None
    reason = probe(candidate.path)
    if reason is None:
        with suppress(OSError):  # without a writable cache the next run probes again
            passed.parent.mkdir(parents=True, exist_ok=True)
            passed.touch()
    return reason


def _eligible() -> list[Candidate]:
    """Return the candidates; only that of DRJIT_LIBLLVM_PATH where it is set, as in Dr.Jit."""
    candidates = find()
    if not os.environ.get(VARIABLE):
        return candidates
    named = Path(os.environ[VARIABLE])
    return [candidate for candidate in candidates if candidate.path in (named, named.resolve())]


def choose() -> Candidate | None:
    """Return the newest libLLVM that works, or None.

    Where DRJIT_LIBLLVM_PATH is set, only that one is considered.
    """
    return next((candidate for candidate in _eligible() if rejection(candidate) is None), None)


def available() -> bool:
    """Return whether rays can be traced on this machine's processor."""
    return choose() is not None


def install_line() -> str:
    """Return the command that installs a libLLVM on this machine."""
    system = platform.system()
    if os.environ.get("CONDA_PREFIX"):
        package = "libllvm-c19" if system == "Windows" else "libllvm19"
        return f"conda install -y -c conda-forge {package}"
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
    if line is None:
        return "this system's package manager has it as libLLVM, llvm or llvm-libs"
    return sudo + line


def advice() -> str:
    """Explain which libraries were found, why none can be used, and how to get one."""
    named = os.environ.get(VARIABLE)
    return "\n".join([
        f"tracing needs libLLVM {MIN_VERSION} or newer, and "
        + (f"{VARIABLE} names one that does not work:" if named else "none that works was found."),
        *(f"  {candidate}: {rejection(candidate)}" for candidate in _eligible()),
        f"To search for another one: unset {VARIABLE}" if named
        else f"To install one: {install_line()}",
        f"To use one in another folder: name it in {VARIABLE}. Everything but tracing works "
        "without any.",
    ])


def prepare() -> None:
    """Choose a libLLVM and set DRJIT_LIBLLVM_PATH.

    Call it before drjit, mitsuba or sionna.rt is imported.

    Raises:
        RunFailed: no libLLVM works, or Dr.Jit was imported earlier and took one that does not.
    """
    if "drjit" in sys.modules:
        if sys.modules["drjit"].detail.llvm_version()[0] >= MIN_VERSION:
            return
        raise RunFailed("drjit was imported before radiotwin could choose its libLLVM, and has "
                        "none that works; import radiotwin.trace before drjit, mitsuba and "
                        "sionna.rt" if available() else advice())
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
