"""Run studies and keep their rows: one JSON file a study, the source of its table and figures."""

import json
import platform
import re
import resource
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

import radiotwin
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_path
from radiotwin.runtime.execution import Job, open_executor

SCHEMA, RECORDS = "radiotwin.study/1", Path(__file__).parents[1] / "docs" / "results"
MODULES = {"models": "models", "curve": "learning", "federation": "learning",
           "tuning": "learning", "belief": "belief", "foreign": "foreign",
           "where": "where", "hidden": "closeloop", "calibration": "calibration",
           "real": "closeloop_real", "injected": "injected", "campus": "campus",
           "away": "campus_learning", "readings": "campus_learning", "speed": "speed"}
"""Name of a study -> its module in this package."""
Run = Callable[[int, dict], dict]
Todo = list[tuple[str, int, dict]]


@dataclass(frozen=True)
class Study:
    """A question, and the rows that answer it.

    Attributes:
        question: one line.
        run: `(seed, settings) -> results`: numbers, texts, and lists and dicts of them.
        cases: seed -> name -> settings, one row each; the most important ones first.
        table: finished rows, a column for each result -> Markdown.
        figures: finished rows -> file name without suffix -> figure.
        seeds: default number of seeds.
    """

    question: str
    run: Run
    cases: Callable[[int], dict[str, dict]]
    table: Callable[[pd.DataFrame], str]
    figures: Callable[[pd.DataFrame], dict[str, Figure]] = lambda rows: {}
    seeds: int = 3


def load_study(name: str) -> Study:
    """Import a study; raise BadInput where there is none of that name."""
    if name not in MODULES:
        raise BadInput(f"study {name!r} is unknown; allowed are {', '.join(MODULES)}")
    return import_module(f"studies.{MODULES[name]}").STUDIES[name]


def read_rows(name: str, out: Path) -> list[dict]:
    """Read the finished rows of a study; raise BadInput where the file is not a study's."""
    path = out / f"{name}.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA:
            raise BadInput(f"{path}: schema is {content['schema']!r}, not {SCHEMA!r}")
        return content["rows"]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{path} is not the record of a study ({type(error).__name__}: {error}); "
                       "move it away") from None


def write_rows(name: str, rows: list[dict], out: Path) -> None:
    """Write the rows of a study, one a line, by name and seed."""
    rows.sort(key=lambda row: (row["name"], row["seed"]))
    lines = ",\n".join(json.dumps(row, allow_nan=False) for row in rows)
    with atomic_path(out / f"{name}.json") as temporary:
        head = f'"schema": "{SCHEMA}", "study": "{name}"'
        temporary.write_text(f'{{{head}, "rows": [\n{lines}\n]}}\n', encoding="utf-8")


def missing_rows(name: str, seeds: int, only: str | None, out: Path) -> Todo:
    """Return (name, seed, settings) of the rows that a study lacks, of so many seeds from 0.

    `only` has parts of names, or NAME:SEED, with commas; None stands for all rows. Raises BadInput
    where nothing has such a name, or a finished row has other settings.
    """
    wanted = [(case, seed, settings) for seed in range(seeds)
              for case, settings in load_study(name).cases(seed).items()
              if not only or any(part in case or f"{case}:{seed}".endswith(part)
                                 for part in only.split(","))]
    if not wanted:
        raise BadInput(f"--only {only}: no row of {name} has that in its name; they are "
                       f"{', '.join(load_study(name).cases(0))}")
    done = {(row["name"], row["seed"]): row["settings"] for row in read_rows(name, out)}
    for case, seed, settings in wanted:
        before = done.get((case, seed), settings)
        for key in {**before, **settings}:
            if before.get(key) != settings.get(key):
                raise BadInput(
                    f"{out / name}.json holds {case}:{seed} with other settings ({key} = "
                    f"{before.get(key)}, not {settings.get(key)}); choose another --out")
    return [each for each in wanted if each[:2] not in done]


def run_rows(name: str, todo: Todo, out: Path, jobs: int,
             show: Callable[[dict], None] = lambda row: None) -> None:
    """Run rows in `jobs` processes (1: this one); show each as soon as the file holds it."""
    job = Job(name, _Rows(name, load_study(name).run))
    with open_executor(str(jobs), say=lambda text: None) as executor:
        executor.run(job, todo, _RecordFile(name, out, read_rows(name, out), show))


@dataclass(frozen=True)
class _Rows:
    """Runs rows of a study."""

    name: str
    run: Run

    def __call__(self, row: tuple[str, int, dict]) -> dict:
        return make_row(self.name, self.run, *row)


@dataclass(frozen=True)
class _RecordFile:
    """The file of a study, as the cache of a job: what it holds already is not asked for."""

    name: str
    out: Path
    rows: list[dict]
    show: Callable[[dict], None]

    def get(self, piece: object) -> None:
        return None

    def put(self, piece: object, row: dict, messages: list[str], seconds: float) -> None:
        self.rows.append(row)
        write_rows(self.name, self.rows, self.out)
        self.show(row)


def make_row(study: str, run: Run, name: str, seed: int, settings: dict) -> dict:
    """Run a row with one thread and return its record; numbers have four decimals."""
    from marl.replicas import keep_memory, limit_threads  # torch: not for --help

    limit_threads(1)
    keep_memory()
    started, cpu_s = time.perf_counter(), _cpu_s()
    results = json.loads(pd.Series(run(seed, settings), dtype=object).to_json(double_precision=4))
    return {"study": study, "name": name, "seed": seed, "version": code_version(),
            "machine": machine(), "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "cpu_s": round(_cpu_s() - cpu_s, 1), "wall_s": round(time.perf_counter() - started, 1),
            "settings": settings, "results": results}


def machine() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.+)", info.read_text()) if info.is_file() else []
    return names[0] if names else platform.processor() or platform.machine()


@cache
def code_version() -> str:
    """Return the package's version and the commit of the sources."""
    try:
        done = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True,
                              text=True, cwd=Path(__file__).parent, check=True)
        return f"{radiotwin.__version__} ({done.stdout.strip()})"
    except (OSError, subprocess.CalledProcessError):
        return radiotwin.__version__


def _cpu_s() -> float:
    usages = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)  # of children that have ended
