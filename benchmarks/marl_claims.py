"""How much of the data is collected, over seeds: one configuration of `python -m marl.fedqmix`, run several times.

    python benchmarks/marl_claims.py --seeds 3 -o docs/results/NAME.json --scene scenes/rbm --algorithm qmix …

Takes the options of `python -m marl.fedqmix`. The JSON holds every round of every seed, with the settings and the CPU
seconds; a run that was stopped goes on with the next seed.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

import radiotwin
from marl.algorithm import run_algorithm
from marl.experiments.records import filled
from marl.fedqmix import settings_of
from marl.options import add_options
from marl.settings import LearnerSettings, RunSettings
from marl.threads import keep_memory, limit_threads
from radiotwin.files import atomic_path
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.survey import read_truth


def cpu_s() -> float:
    """Of this process and of those that have ended."""
    return sum(usage.ru_utime + usage.ru_stime
               for usage in (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("-o", "--out", type=Path, required=True)
    add_options(parser, RunSettings, "run", without={"seed", "compare"})
    add_options(parser, LearnerSettings, "learning", without={"mix"})
    arguments = parser.parse_args()
    run, learner = settings_of(arguments)
    limit_threads(1)
    keep_memory()
    scene = Scene.load(run.scene)
    truth = read_truth(scene, run.truth)
    settings = {"run": run.model_dump(mode="json", exclude={"seed", "compare"}) | {"scene": run.scene.name},
                "learner": learner.model_dump(mode="json")}
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"settings": settings, "runs": []}
    if filled(record["settings"]) != filled(settings):
        raise SystemExit(f"{arguments.out} holds other settings; give another --out")
    for seed in range(len(record["runs"]), arguments.seeds):
        started, cpu_before = time.perf_counter(), cpu_s()
        with progress(f"seed {seed}", total=run.real_episodes * run.episodes) as advance:
            outcome = run_algorithm(run.model_copy(update={"seed": seed}), learner, scene, truth, None, False,
                                    lambda rows, blocks: None, advance)
        rows = [{name: round(value, 4) for name, value in row.items()} for row in outcome.rows]
        record["runs"].append({"seed": seed, "wall_s": round(time.perf_counter() - started, 1),
                               "cpu_s": round(cpu_s() - cpu_before, 1), "version": radiotwin.__version__,
                               "rows": rows})
        with atomic_path(arguments.out) as temporary:
            temporary.write_text(json.dumps(record, indent=1))
    last = np.array([each["rows"][-1]["truth_ratio"] for each in record["runs"]])
    cpu = np.mean([each["cpu_s"] for each in record["runs"]])
    print(f"{arguments.out.stem}: collected {last.mean():.3f} (seeds: {' '.join(f'{ratio:.3f}' for ratio in last)}), "
          f"{cpu:.0f} CPU s each")


if __name__ == "__main__":
    main()
