"""Where unknown devices are found by a law of distance and by following paths, in ray-traced cities.

    python benchmarks/relocation.py rbm rdm --flights 2 5 --seeds 3 -o docs/results/relocation.json

For each city, number of random-waypoint flights and seed: the bases `twin` and `raytrace` of `close-loop`, fitted to
all links. A case that is in the file already is left out, so that a run that was stopped goes on.
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import numpy as np

from radiotwin.closeloop.bases import FittedBase, TwinBase
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import make_records
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey import fly_survey


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="names in scenes/")
    parser.add_argument("--flights", type=int, nargs="+", default=[2, 5])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for seed in range(arguments.seeds):
        for name in arguments.scenes:
            for flights in arguments.flights:
                case = f"{name}:{flights} flights:{seed}"
                if case in results:
                    continue
                results[case] = study(Path("scenes") / name, flights, seed)
                print(case, json.dumps(results[case]), flush=True)
                with atomic_path(arguments.out) as temporary:
                    temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")
    for name in arguments.scenes:
        for flights in arguments.flights:
            print(f"{name}, {flights} flights:", "; ".join(summary(results, name, flights)))


def study(folder: Path, flights: int, seed: int) -> dict:
    """Errors and radii of the unknown devices by both bases [m], and processor seconds."""
    scene = Scene.load(folder)
    truth = RadioMap.read(folder / "truth.nc")
    records = make_records(fly_survey(scene, truth, flights=flights, pattern="random-waypoint", seed=seed), scene)
    twin = TwinBase(scene, seed)
    result = {}
    for base in (twin, RaytraceBase(twin)):
        started = time.process_time()
        result[base.name] = errors(scene, base.fit(records)) | {"cpu_s": round(time.process_time() - started)}
    return result


def errors(scene: Scene, fitted: FittedBase) -> dict:
    """Distance to the true place, and radius, of each unknown device [m]; none where it is nowhere."""
    true_m = {device.device: (device.x_m, device.y_m) for device in scene.config.devices}
    unknown = [device for device in fitted.found if device.role == "unknown" and np.isfinite(device.x_m)]
    error_m = [np.hypot(*np.subtract((device.x_m, device.y_m), true_m[device.device])) for device in unknown]
    return {"device": [device.device for device in unknown], "error_m": np.round(error_m, 1).tolist(),
            "credible_radius_m": [round(device.credible_radius_m, 1) for device in unknown]}


def summary(results: dict, name: str, flights: int) -> list[str]:
    """Of all seeds: a sentence for each base."""
    cases = [result for case, result in results.items() if case.startswith(f"{name}:{flights} flights:")]
    lines = []
    for base in ("twin", "raytrace"):
        error_m = np.concatenate([case[base]["error_m"] for case in cases])
        radius_m = np.concatenate([case[base]["credible_radius_m"] for case in cases])
        lines.append(f"{base}: median {np.median(error_m):.1f} m, 90 % {np.quantile(error_m, 0.9):.1f} m, worst "
                     f"{error_m.max():.0f} m, {np.mean(error_m <= radius_m):.0%} of {len(error_m)} within the radius")
    return lines


if __name__ == "__main__":
    main()
