"""Runs that were done before with the same settings and seed: taken as they are, not done again."""

import json
from dataclasses import replace
from pathlib import Path

from marl.experiments.records import Run, read_record, same

BENCHMARKS = Path(__file__).resolve().parents[2] / "docs" / "results"
PAPER = "paper_"
_OWN = ("schema", "study", "name", "kind", "seed", "version", "code", "machine", "cpu_s", "wall_s", "taken_from",
        "settings")


def earlier_result(run: Run, out: Path) -> tuple[dict, float, float, dict] | None:
    """What a run would come to, from another study or from `benchmarks/marl_claims.py`.

    Those of the latter in the statistical truth were flown over the paper's own maps, which have the names of our
    scenes there; here their folders are called `paper_rbm` and `paper_rdm`.

    Returns:
        result, processor and wall seconds, and where it is from (`taken_from`, and the `version`, `code` and `machine`
        that did it, None where nobody wrote that down); None where there is no such run
    """
    for path in sorted(out.glob(f"*/*-s{run.seed}.json")):
        record = read_record(path)
        if record["seed"] == run.seed and same(run, record["kind"], record["settings"]):
            result = {name: value for name, value in record.items() if name not in _OWN}
            by = {name: record.get(name) for name in ("version", "code", "machine")}
            return result, record["cpu_s"], record["wall_s"], by | {"taken_from": f"{record['study']}/{path.name}"}
    if run.kind == "learning":
        wanted = _as_the_benchmark_says(run)
        for path in sorted(BENCHMARKS.glob("marl_*.json")) if wanted is not None else ():
            record = json.loads(path.read_text(encoding="utf-8"))
            for done in record["runs"] if wanted and same(wanted, "learning", record["settings"]) else ():
                if done["seed"] == run.seed:
                    by = {"version": done["version"], "code": None, "machine": None, "taken_from": path.name}
                    return {"curve": done["rows"]}, done["cpu_s"], done["wall_s"], by
    return None


def _as_the_benchmark_says(run: Run) -> Run | None:
    """The run with the name that the benchmark has for its scene; None where it has none."""
    settings = run.settings["run"]
    scene = Path(settings["scene"]).name
    if settings["truth"] == "segmented":
        if not scene.startswith(PAPER):
            return None
        scene = scene.removeprefix(PAPER)
    return replace(run, settings=run.settings | {"run": settings | {"scene": scene}})
