"""How good the models are, over seeds: errors on held-out flights and on the whole map, and of located devices.

    python benchmarks/claims.py scenes/rbm --truth traced --seeds 10 -o docs/results/rbm_traced.json

Each seed is a survey of 5 flights to learn from and 5 to judge on. The JSON holds every number with the settings that
made it; a run that was stopped goes on where it was.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd

import radiotwin
from radiotwin.compare import compare_models, split_flights
from radiotwin.files import atomic_path
from radiotwin.scene import Scene
from radiotwin.survey import fly_survey, read_truth

FLIGHTS = 5


def one_seed(scene: Scene, truth, noise_db: float, seed: int) -> dict:
    flown = fly_survey(scene, truth, flights=2 * FLIGHTS, pattern="random-waypoint", seed=seed, noise_db=noise_db)
    comparison = compare_models(*split_flights(flown, FLIGHTS), scene, truth, seed=seed)
    return {"seed": seed, "scores": comparison.scores.round(4).to_dict("records"),
            "locations": comparison.locations.round(3).to_dict("records")}


def summarise(record: dict) -> None:
    """Print means over the seeds, and the share by which each model is below the log-distance model."""
    scores = pd.concat(pd.DataFrame(run["scores"]).assign(seed=run["seed"]) for run in record["runs"])
    mean = scores.groupby(["against", "positions", "links", "model"], sort=False)["rmse_db"].mean().unstack()
    below = 1 - mean.div(mean["log_distance"], axis=0)
    print(f"\n{record['scene']}, truth {record['truth']}, {len(record['runs'])} seeds: mean RMSE [dB]")
    print(mean.round(2).to_string())
    print("\nbelow the log-distance model")
    print((100 * below).round(0).astype(int).astype(str).add(" %").to_string())
    locations = pd.concat(pd.DataFrame(run["locations"]) for run in record["runs"])
    print("\nposition error [m] and share within the 90 % radius")
    for model, part in locations.groupby("model", sort=False):
        error_m = part["error_m"]
        within = (error_m <= part["credible_radius_m"]).mean()
        print(f"{model:24s} n {len(error_m):3d}  median {error_m.median():6.2f}  "
              f"90 % {np.quantile(error_m, 0.9):7.2f}  worst {error_m.max():7.2f}  "
              f"above 50 m {(error_m > 50).mean():5.1%}  within radius {within:4.0%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", default="traced", help="traced, segmented, or a radio map")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    scene = Scene.load(options.scene)
    truth = read_truth(scene, options.truth)
    noise_db = 0.0 if options.truth == "segmented" else 1.0
    settings = {"scene": scene.config.name, "scene_hash": scene.content_hash(), "truth": options.truth,
                "flights": FLIGHTS, "pattern": "random-waypoint", "noise_db": noise_db,
                "command": f"python benchmarks/claims.py {options.scene} --truth {options.truth}",
                "radiotwin_version": radiotwin.__version__}
    record = settings | {"runs": []}
    if options.out.is_file():
        earlier = json.loads(options.out.read_text())
        if {key: earlier.get(key) for key in settings} == settings:
            record = earlier
    done = {run["seed"] for run in record["runs"]}
    for seed in sorted(set(range(options.seeds)) - done):
        record["runs"].append(one_seed(scene, truth, noise_db, seed))
        with atomic_path(options.out) as temporary:
            temporary.write_text(json.dumps(record, indent=None, separators=(",", ":")))
        print(f"seed {seed} done", flush=True)
    summarise(record)


if __name__ == "__main__":
    main()
