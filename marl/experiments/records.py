"""One run of a study on disk: a small JSON file with settings, code version, seed, times and curve."""

import hashlib
import json
import math
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import marl
import radiotwin
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput
from radiotwin.files import atomic_path

SCHEMA = "radiotwin.experiment/1"
EARLIER: dict[str, dict[str, Any]] = {
    "run": {"first_flight": "random", "measure": "policy", "twin_shadowing": "slot"},
    "learner": {"excursion_slots": 1.0}}
"""What was done before there was a setting for it, where that is not its default."""
LEARNERS = ("fedqmix", "qmix", "iql")
DELETED = {"mix": (True, False), "fly_again": (False,), "restart_epsilon": (0.0,), "restart_slots": (25_000,)}
"""Settings of learning that old records have, with the values that say nothing."""
MEASURING = ("first_flight", "measure", "twin_shadowing")


@dataclass(frozen=True)
class Run:
    """What is to be run.

    Attributes:
        study: it belongs to.
        name: of its file, without seed.
        kind: a key of `work.KINDS`.
        settings: all of them, as JSON has them.
        seed: of everything random.
    """

    study: str
    name: str
    kind: str
    settings: dict[str, Any]
    seed: int

    def path(self, out: Path) -> Path:
        """Its JSON file."""
        return out / self.study / f"{self.name}-s{self.seed}.json"

    def unfinished(self, out: Path) -> Path:
        """The folder of what it needs to go on after a stop."""
        return out / self.study / "unfinished" / f"{self.name}-s{self.seed}"


def finished(run: Run, out: Path) -> bool:
    """Whether its file is there.

    Raises:
        BadInput: it is damaged, or holds a run with other settings.
    """
    path = run.path(out)
    if not path.is_file():
        return False
    record = read_record(path)
    _refuse_others(run, record["kind"], record["settings"], path)
    return True


def begun(run: Run, out: Path) -> bool:
    """Whether something is left of it that was stopped.

    Raises:
        BadInput: that is damaged, or was done with other settings.
    """
    path = run.unfinished(out) / "run.json"
    if not path.is_file():
        return False
    try:
        left = json.loads(path.read_text(encoding="utf-8"))
        kind, settings = left["kind"], left["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{path} is damaged ({type(error).__name__}: {error}); remove the folder") from None
    _refuse_others(run, kind, settings, path)
    return True


def begin(run: Run, out: Path) -> None:
    """Write down what is begun, so that it goes on with the same settings only."""
    with atomic_path(run.unfinished(out) / "run.json") as temporary:
        temporary.write_text(json.dumps({"kind": run.kind, "settings": run.settings}), encoding="utf-8")


def _refuse_others(run: Run, kind: str, settings: dict, path: Path) -> None:
    if not same(run, kind, settings):
        differ = _difference(filled(settings), filled(run.settings))
        raise BadInput(f"{path} holds a run with other settings ({differ}); give another --out, or remove it")


def write_record(run: Run, out: Path, result: dict, cpu_s: float, wall_s: float, **more) -> None:
    """Write the file of a finished run.

    Args:
        result: what the kind returns; numbers are rounded, what is not finite becomes null.
        cpu_s, wall_s: processor and wall seconds, stops not counted.
        more: further entries, and others in place of this code's version and this machine.
    """
    by = {"version": radiotwin.__version__, "code": code_version(), "machine": machine()}
    record = {"schema": SCHEMA, "study": run.study, "name": run.name, "kind": run.kind, "seed": run.seed, **by,
              "cpu_s": round(cpu_s, 1), "wall_s": round(wall_s, 1)} | more | {"settings": run.settings} | plain(result)
    with atomic_path(run.path(out)) as temporary:
        temporary.write_text(_lines(record), encoding="utf-8")


def same(run: Run, kind: str, settings: dict) -> bool:
    """Whether these are the settings of a run."""
    return kind == run.kind and filled(settings) == filled(run.settings)


def filled(settings: dict) -> dict:
    """Settings with what those were that did not exist when they were written, and without what does not matter."""
    groups = {"run": RunSettings().model_dump(mode="json", exclude={"seed", "compare"}) | EARLIER["run"],
              "learner": LearnerSettings().model_dump() | EARLIER["learner"]}
    run = settings.get("run", {})
    if run.get("algorithm", LEARNERS[0]) not in LEARNERS:
        settings = settings | {"learner": {}}
    if run.get("twin") == "truth":  # nothing is measured
        settings = settings | {"run": {name: value for name, value in run.items() if name not in MEASURING}}
    return settings | {name: {key: value for key, value in (group | settings[name]).items()
                              if value not in DELETED.get(key, ())}
                       for name, group in groups.items() if name in settings}


def read_record(path: Path) -> dict:
    """Read what `write_record` wrote.

    Raises:
        BadInput: it is not that.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["schema"] != SCHEMA:
            raise BadInput(f"{path}: schema is {record['schema']!r}, this version reads {SCHEMA!r}")
        for key in ("name", "kind", "seed", "settings", "cpu_s", "wall_s"):
            record[key]
        return record
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{path} is not the record of a run ({type(error).__name__}: {error}); remove it and run the "
                       "study with --resume") from None


def read_study(study: str, out: Path) -> list[dict]:
    """All finished runs of a study, by name and seed."""
    records = [read_record(path) for path in sorted((out / study).glob("*.json"))]
    return sorted(records, key=lambda record: (record["name"], record["seed"]))


def plain(value: Any) -> Any:
    """Numbers, texts, lists and dicts of them, as JSON has them."""
    if isinstance(value, dict):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(each) for each in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return round(float(value), 4) if math.isfinite(value) else None
    return value


@cache
def code_version() -> str:
    """The first digits of a hash of the sources of both packages: the same for the same code, committed or not."""
    digest = hashlib.sha256()
    for package in (marl, radiotwin):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(path.relative_to(root.parent).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@cache
def machine() -> str:
    """The processor in words."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _lines(record: dict) -> str:
    """JSON with a line for each entry, and one for each row of the curve."""
    parts = []
    for name, value in record.items():
        if name == "curve":
            rows = ",\n  ".join(json.dumps(row, allow_nan=False) for row in value)
            parts.append(f' "curve": [\n  {rows}\n ]')
        else:
            parts.append(f" {json.dumps(name)}: {json.dumps(value, allow_nan=False)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _difference(before: dict, now: dict) -> str:
    """The first setting that differs, in words."""
    for name in sorted(set(before) | set(now)):
        one, other = before.get(name), now.get(name)
        if isinstance(one, dict) and isinstance(other, dict) and one != other:
            return _difference(one, other)
        if one != other:
            return f"{name} = {one}, not {other}"
    return "another kind of run"
