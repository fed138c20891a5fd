"""Runs that `benchmarks/marl_claims.py` has done before, with the same settings: taken as they are, not done again."""

import json
from functools import cache
from pathlib import Path

from marl.experiments.records import Run

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "results"


def earlier_result(run: Run) -> tuple[dict, float, float, str] | None:
    """Result, processor and wall seconds, and the file's name; None where there is no such run.

    Only runs in a ray-traced truth: those in the statistical one were flown over the paper's own maps, which have the
    names of our scenes.
    """
    if run.kind != "learning" or run.settings["run"]["truth"] != "traced":
        return None
    for name, record in _records():
        if record["settings"] == run.settings:
            for done in record["runs"]:
                if done["seed"] == run.seed:
                    return {"curve": done["rows"]}, done["cpu_s"], done["wall_s"], name
    return None


@cache
def _records() -> list[tuple[str, dict]]:
    return [(path.name, json.loads(path.read_text(encoding="utf-8")))
            for path in sorted(FOLDER.glob("marl_*_traced_*.json"))]
