"""Runs that were done before with the same settings and seed: taken as they are, not done again."""

import json
from pathlib import Path

from marl.experiments.records import Run, read_record, same

BENCHMARKS = Path(__file__).resolve().parents[2] / "docs" / "results"
_OWN = ("schema", "study", "name", "kind", "seed", "version", "code", "machine", "cpu_s", "wall_s", "taken_from",
        "settings")


def earlier_result(run: Run, out: Path) -> tuple[dict, float, float, str] | None:
    """What a run would come to, from another study or from `benchmarks/marl_claims.py`.

    Of the latter only runs in a ray-traced truth: those in the statistical one were flown over the paper's own maps,
    which have the names of our scenes.

    Returns:
        result, processor and wall seconds, and where it is from; None where there is no such run
    """
    for path in sorted(out.glob(f"*/*-s{run.seed}.json")):
        record = read_record(path)
        if record["seed"] == run.seed and same(run, record["kind"], record["settings"]):
            result = {name: value for name, value in record.items() if name not in _OWN}
            return result, record["cpu_s"], record["wall_s"], f"{record['study']}/{path.name}"
    if run.kind == "learning" and run.settings["run"]["truth"] == "traced":
        for path in sorted(BENCHMARKS.glob("marl_*_traced_*.json")):
            record = json.loads(path.read_text(encoding="utf-8"))
            for done in record["runs"] if same(run, "learning", record["settings"]) else ():
                if done["seed"] == run.seed:
                    return {"curve": done["rows"]}, done["cpu_s"], done["wall_s"], path.name
    return None
