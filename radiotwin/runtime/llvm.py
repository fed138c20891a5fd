"""Choose a libLLVM that Dr.Jit can use, before Dr.Jit is imported.

Dr.Jit loads the first libLLVM that it finds, once. A version below 15 leaves it without a CPU
backend ("could not be found", though it was); 15 and 16 abort the process at the first kernel that
they cannot compile. So the newest library from `MIN_VERSION` on that loads is chosen. Libraries are
tried in another process.

`python -m radiotwin.runtime.llvm` prints the library that would be used, or the reason why there is
none, with exit status 1.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from radiotwin.errors import RunFailed
from radiotwin.runtime.processes import try_program

VARIABLE = "DRJIT_LIBLLVM_PATH"
MIN_VERSION = 17  # of Dr.Jit 1.5
TIMEOUT_S = 120

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


@dataclass(frozen=True)
class Candidate:
    """A libLLVM on this machine.

    Attributes:
        path: of the file.
        version: from the file name, else as reported by the library; None if unknown.
    """

    path: Path
    version: tuple[int, ...] | None

    def __str__(self) -> str:
        version = ".".join(map(str, self.version)) if self.version else "unknown"
        return f"{self.path} (version {version})"


@cache
def reported_version(path: Path) -> tuple[int, ...] | str:
    """Return the version that a libLLVM reports, or the reason why it reports none, as a text.

    Versions below 16 cannot report it.
    """
    answer, failure = try_program(_ASK_VERSION, str(path), TIMEOUT_S)
    return failure.removeprefix("OSError: ") or tuple(map(int, answer.split()))


def search_folders() -> list[Path]:
    """Return the folders where Linux, Homebrew, MacPorts, conda and LLVM put libLLVM."""
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
    """Return the libLLVM files that the dynamic loader of Linux knows."""
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
    # Links are resolved, as one library has many names.
    paths = {file.resolve(): None for file in files
             if _NAME.fullmatch(file.name) and file.is_file()}
    if os.environ.get(VARIABLE):
        named = Path(os.environ[VARIABLE])
        paths[named.resolve() if named.is_file() else named] = None
    candidates = []
    for path in paths:
        match = _NAME.fullmatch(path.name)
        digits = match and (match["before"] or match["after"])
        version = tuple(map(int, digits.split("."))) if digits else reported_version(path)
        candidates.append(Candidate(path, None if isinstance(version, str) else version))
    return sorted(candidates, key=lambda candidate: candidate.version or (0,), reverse=True)


def rejection(candidate: Candidate) -> str | None:
    """Return the reason why a libLLVM cannot be used; None if it can."""
    too_old = f"too old: Dr.Jit needs version {MIN_VERSION} or newer"
    if candidate.version is not None and candidate.version[0] < MIN_VERSION:
        return too_old
    reported = reported_version(candidate.path)
    if isinstance(reported, str):
        return reported
    return too_old if reported[0] < MIN_VERSION else None


def _eligible() -> list[Candidate]:
    """Return the libraries that may be used: that in DRJIT_LIBLLVM_PATH if set, else all found."""
    candidates = find()
    if not os.environ.get(VARIABLE):
        return candidates
    named = Path(os.environ[VARIABLE])
    return [candidate for candidate in candidates if candidate.path in (named, named.resolve())]


def choose() -> Candidate | None:
    """Return the newest libLLVM that works, or that in DRJIT_LIBLLVM_PATH; None if none works."""
    return next((candidate for candidate in _eligible() if rejection(candidate) is None), None)


def available() -> bool:
    """Return whether rays can be traced on this machine's CPU."""
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
    """Set DRJIT_LIBLLVM_PATH to a libLLVM that works; call it before Dr.Jit is imported.

    Raises:
        RunFailed: no libLLVM works, or Dr.Jit was imported already with one that does not.
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
