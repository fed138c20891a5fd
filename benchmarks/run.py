"""How fast everything is, in one run: `docs/results/benchmarks.md`.

    python benchmarks/run.py [-o docs/results/benchmarks.md] [--only PART …]

Every part is a process of its own with one thread, one after the other; ratios are within the run. A part that cannot
run here (tracing needs libLLVM, close-loop the cases of `tests/undeclared`) is named with the reason.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HERE = ROOT / "benchmarks"
PARTS = {
    "environment, update, replicas, the paper's scale": ["marl_speed.py"],
    "line of sight": ["line_of_sight.py"],
    "channel fit": ["channel_fit.py"],
    "localisation": ["localize.py"],
    "ray tracing": ["trace.py", "scenes/rbm", "--receivers", "40", "--only", "fast", "default"],
    "close-loop": ["run.py", "--close-loop"],
}
CASE = ("nothing", 0)  # of `tests/undeclared`: 10,800 links


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs" / "results" / "benchmarks.md")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--close-loop", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.close_loop:
        close_loop_seconds()
        return
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    sections = [f"# Speed\n\n`python benchmarks/run.py`, {time.strftime('%Y-%m-%d', time.gmtime())}, version "
                f"{_version()}.\n\n{machine()}\n\nLoad of the machine before the run: {load:.1f}. Environment, update, "
                "line of sight, close-loop and links/s for two cores are from processor time; replicas, channel fit, "
                "localisation and the other links/s are wall time and suffer from what else runs."]
    for name in arguments.only:
        print(name, flush=True)
        output, seconds = part(PARTS[name])
        sections.append(f"## {name[0].upper()}{name[1:]}\n\n`python benchmarks/{' '.join(PARTS[name])}`, "
                        f"{seconds:.0f} s\n\n```\n{output}\n```")
        print(output, flush=True)
    from radiotwin.files import atomic_path

    with atomic_path(arguments.out) as temporary:
        temporary.write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def part(words: list[str]) -> tuple[str, float]:
    """What a benchmark prints, or why it cannot run, and the seconds that it took."""
    started = time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(HERE / words[0]), *words[1:]], cwd=ROOT, capture_output=True, text=True,
                          env=environment)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return f"cannot run here: {last}", time.perf_counter() - started
    return done.stdout.strip(), time.perf_counter() - started


def close_loop_seconds() -> None:
    """Close the loop on one traced case; the reference is fitting the base that it starts from, once."""
    import warnings

    from radiotwin.closeloop.bases import TwinBase
    from radiotwin.closeloop.raytraced import RaytraceBase
    from radiotwin.closeloop.records import make_records
    from radiotwin.closeloop.run import close_loop
    from tests.undeclared.cases import case

    warnings.simplefilter("ignore")
    hidden = case(*CASE)
    records = make_records(hidden.measurements, hidden.scene)
    started = time.process_time()
    RaytraceBase(TwinBase(hidden.scene, 0)).fit(records)
    fitted_s = time.process_time() - started
    started = time.process_time()
    loop = close_loop(hidden.measurements, hidden.scene, "auto", 0, lambda text: None)
    seconds = time.process_time() - started
    print(f"close-loop, base auto (it took {loop.base}), {len(records):,} links: {seconds:.0f} s of one core")
    print(f"one fit of the base raytrace: {fitted_s:.1f} s; ratio {seconds / fitted_s:.1f}")


def machine() -> str:
    """Processor, cores, memory, system and the libraries that decide, in words."""
    import importlib.metadata

    from marl.experiments.records import machine as processor
    from marl.threads import usable_cores

    memory = ""
    if Path("/proc/meminfo").is_file():
        kib = int(re.search(r"MemTotal:\s+(\d+)", Path("/proc/meminfo").read_text()).group(1))
        memory = f", {kib / 2**20:.0f} GiB"
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in
                         ("numpy", "numba", "torch", "sionna-rt", "drjit"))
    return (f"Machine: {processor()}, {usable_cores()} cores{memory}, {platform.system()} {platform.release()}, "
            f"Python {platform.python_version()}, {versions}.")


def _version() -> str:
    from marl.experiments.records import code_version
    from radiotwin import __version__

    return f"{__version__} ({code_version()})"


if __name__ == "__main__":
    main()
