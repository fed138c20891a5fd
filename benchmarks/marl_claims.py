"""How much of the data is collected, over seeds: one configuration of `python -m marl.fedqmix`, run several times.

    python benchmarks/marl_claims.py --seeds 3 -o docs/results/NAME.json --scene scenes/rbm --algorithm qmix …

Takes the options of `python -m marl.fedqmix`. The JSON holds every round of every seed, with the settings and the CPU
seconds; a run that was stopped goes on with the next seed.
"""

import json
import resource
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import radiotwin
from marl.algorithm1 import run_algorithm
from marl.experiments.records import filled
from marl.options import settings_of, with_settings
from marl.settings import LearnerSettings, RunSettings
from marl.threads import keep_memory, limit_threads
from radiotwin.command import exit_status
from radiotwin.files import atomic_path
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.survey import read_truth


def cpu_s() -> float:
    """Of this process and of those that have ended."""
    return sum(usage.ru_utime + usage.ru_stime
               for usage in (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


@with_settings(RunSettings, LearnerSettings, without={"seed", "compare"})
def main(given: dict[str, str], out: Annotated[Path, typer.Option("--out", "-o")], seeds: int = 3) -> None:
    """Run one configuration with several seeds; takes the options of `python -m marl.fedqmix`."""
    run, learner = settings_of(given)
    limit_threads(1)
    keep_memory()
    scene = Scene.load(run.scene)
    truth = read_truth(scene, run.truth)
    settings = {"run": run.model_dump(mode="json", exclude={"seed", "compare"}) | {"scene": run.scene.name},
                "learner": learner.model_dump(mode="json")}
    record = json.loads(out.read_text()) if out.exists() else {"settings": settings, "runs": []}
    if filled(record["settings"]) != filled(settings):
        raise SystemExit(f"{out} holds other settings; give another --out")
    for seed in range(len(record["runs"]), seeds):
        started, cpu_before = time.perf_counter(), cpu_s()
        with progress(f"seed {seed}", total=run.real_episodes * run.episodes) as advance:
            outcome = run_algorithm(run.model_copy(update={"seed": seed}), learner, scene, truth, None, False,
                                    lambda rows, blocks: None, advance)
        rows = [{name: round(value, 4) for name, value in row.items()} for row in outcome.rows]
        record["runs"].append({"seed": seed, "wall_s": round(time.perf_counter() - started, 1),
                               "cpu_s": round(cpu_s() - cpu_before, 1), "version": radiotwin.__version__,
                               "rows": rows})
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(record, indent=1))
    last = np.array([each["rows"][-1]["truth_ratio"] for each in record["runs"]])
    cpu = np.mean([each["cpu_s"] for each in record["runs"]])
    print(f"{out.stem}: collected {last.mean():.3f} (seeds: {' '.join(f'{ratio:.3f}' for ratio in last)}), "
          f"{cpu:.0f} CPU s each")


if __name__ == "__main__":
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command()(main)
    sys.exit(exit_status(app, "finished seeds are kept"))
