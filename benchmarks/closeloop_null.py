"""How often the loop finds something where nothing is missing.

    python benchmarks/closeloop_null.py -o docs/results/closeloop_null.json [--base twin] [--seeds 20]

Levels are drawn from the base itself, fitted to a traced case of `tests/undeclared` in which nothing is hidden: its
mean, Student-t errors of its own scales, blank below the limit, in the receivers' steps. Then the loop is run with
that base. A run that is in the file already is left out, so that a study that was stopped goes on.
"""

import argparse
import json
import time
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np

from radiotwin.closeloop.bases import TwinBase
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import make_records
from radiotwin.closeloop.regression import Solution
from radiotwin.closeloop.run import close_loop
from radiotwin.files import atomic_path
from radiotwin.measurements import Measurements
from tests.undeclared.cases import SEEDS, case, stored

STEP_DB = 0.25
DOF = 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--base", choices=["twin", "raytrace"], default="twin")
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    worlds = [seed for seed in SEEDS if stored("nothing", seed)]
    for seed in range(arguments.seeds):
        name = f"{arguments.base}:{seed}"
        if name in results:
            continue
        world = worlds[seed % len(worlds)]
        measurements, scene = drawn(world, arguments.base, seed), case("nothing", world).scene
        started = time.process_time()
        loop = close_loop(measurements, scene, arguments.base, seed, lambda text: None)
        results[name] = {
            "world": world, "verdict": loop.verdict,
            "named": [part.effect.name for part in loop.after.whole.parts],
            "drivers": [driver.variable for driver in loop.remaining],
            "best": sorted(((round(entry.nll_gain, 1), entry.name) for entry in loop.search.log
                            if np.isfinite(entry.nll_gain)), reverse=True)[:3],
            "cpu_s": round(time.process_time() - started)}
        print(name, json.dumps(results[name]), flush=True)
        with atomic_path(arguments.out) as temporary:
            temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")
    mine = [result["verdict"] for name, result in results.items() if name.startswith(f"{arguments.base}:")]
    print(f"verdict none in {mine.count('none')} of {len(mine)}")


def drawn(world: int, base: str, seed: int) -> Measurements:
    """Measurements of a base's own world."""
    measurements, side, fit = fitted(world, base)
    rng = np.random.default_rng(seed)
    level_db = side.expect(fit).mean_db + fit.scale_db[side.group] * rng.standard_t(DOF, len(side.records))
    level_db = np.round(level_db / STEP_DB) * STEP_DB
    table = measurements.table.copy()
    table["gain_db"] = np.where(level_db >= side.records.limit_db, level_db, np.nan)
    # A device that the base could not place has no links in its world.
    return Measurements(table[side.usable].reset_index(drop=True), measurements.devices)


@lru_cache
def fitted(world: int, base: str) -> tuple[Measurements, Side, Solution]:
    """What a base learns from a world in which nothing is hidden."""
    hidden = case("nothing", world)
    records, twin = make_records(hidden.measurements, hidden.scene), TwinBase(hidden.scene, 0)
    learnt = {"twin": twin, "raytrace": RaytraceBase(twin)}[base].fit(records)
    side = Side.make(records, np.ones(len(records), dtype=bool), learnt, DOF)
    return hidden.measurements, side, side.fit()


if __name__ == "__main__":
    main()
