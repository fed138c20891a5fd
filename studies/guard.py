"""Guard of behaviour: the same commands on the same inputs, before and after a change.

    python studies/guard.py run --tree . --inputs build/guard -o after.json    # resumes
    python studies/guard.py compare before.json after.json

`run` writes the inputs once (ten hidden cases and two null cases of tests/undeclared, a survey of
scenes/rbm, a part of the POWDER set where it is at hand) and then calls the command line of the
source tree given, one process a step. Results are names, errors, positions and shares, with the
step's processor seconds and peak memory. `compare` prints what differs by more than the tolerance:
names not at all, errors 0.02 dB, positions 0.05 m, shares not at all.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))

CASES = ("antenna_pattern:1", "device_position_error:1", "excess_attenuation:1", "foliage:1",
         "missing_obstacle:1", "receiver_drift:1", "receiver_saturation:1", "removed_obstacle:1",
         "receiver_clock_offset:1", "pairs:1", "nothing:1", "nothing:3")
MODELS = ("log_distance", "segmented_log_distance", "segmented_nn", "regression_kriging",
          "raytrace")
REAL_SET = Path("../shared/data/powder_frs")
EVERY = 12  # one transmitter position in so many of the real set
TOLERANCE = {"rmse_db": 0.02, "bias_db": 0.02, "x_m": 0.05, "y_m": 0.05, "radius_m": 0.5}
COST_RATIO = 1.1


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run_parser = commands.add_parser("run")
    run_parser.add_argument("--tree", type=Path, default=Path("."), help="source tree to run")
    run_parser.add_argument("--inputs", type=Path, required=True)
    run_parser.add_argument("--only", nargs="*", help="beginnings of steps")
    run_parser.add_argument("-o", "--out", type=Path, required=True)
    compare_parser = commands.add_parser("compare")
    compare_parser.add_argument("before", type=Path)
    compare_parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        before, after = (json.loads(path.read_text())
                         for path in (arguments.before, arguments.after))
        sys.exit(print_differences(before, after))
    run(arguments.tree.resolve(), arguments.inputs.resolve(), arguments.out, arguments.only)


def run(tree: Path, inputs: Path, out: Path, only: list[str] | None) -> None:
    """Run every step that is not in `out` yet."""
    results = json.loads(out.read_text()) if out.exists() else {}
    for name, step in steps(inputs).items():
        if name in results or (only and not name.startswith(tuple(only))):
            continue
        with tempfile.TemporaryDirectory() as scratch:
            print(name, flush=True)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            results[name] = step(tree, Path(scratch))
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            started, ended = (each.ru_utime + each.ru_stime for each in (before, after))
            results[name]["cpu_s"] = round(ended - started, 1)
            results[name]["peak_gib_so_far"] = round(after.ru_maxrss / 2**20, 2)
        out.write_text(json.dumps(results, indent=1), encoding="utf-8")


def steps(inputs: Path) -> dict[str, Callable[[Path, Path], dict]]:
    """Every step by name: (source tree, scratch folder) -> results."""
    write_inputs(inputs)
    rbm = inputs / "rbm"
    found: dict[str, Callable[[Path, Path], dict]] = {
        f"close-loop {case}": partial(close_loop, inputs=inputs / case.replace(":", "-"))
        for case in CASES}
    found |= {f"fit {model}": partial(fit, inputs=rbm, model=model) for model in MODELS}
    found |= {"compare": partial(compare, inputs=rbm), "marl": partial(marl, scene=rbm / "scene")}
    if (inputs / "powder").is_dir():
        found["locate powder"] = partial(locate, inputs=inputs / "powder")
    return found


def write_inputs(inputs: Path) -> None:
    """Write what every run reads, unless it is there."""
    from radiotwin.scene import Scene
    from tests.undeclared.cases import case

    for name in CASES:
        folder = inputs / name.replace(":", "-")
        if not folder.is_dir():
            family, seed = name.split(":")
            hidden = case(family, int(seed))
            hidden.measurements.write(folder / "measurements.csv")
            shutil.copytree(hidden.scene.folder, folder / "scene", dirs_exist_ok=True)
    if not (inputs / "rbm").is_dir():
        from radiotwin.radiomap import RadioMap
        from radiotwin.survey import fly_survey

        shutil.copytree("scenes/rbm", inputs / "rbm" / "scene")
        scene = Scene.load(inputs / "rbm" / "scene")
        survey = fly_survey(scene, RadioMap.read("scenes/rbm/truth.nc"), flights=3,
                            pattern="random-waypoint", seed=0)
        survey.write(inputs / "rbm" / "measurements.csv")
    if REAL_SET.is_dir() and not (inputs / "powder").is_dir():
        write_powder(inputs / "powder")


def write_powder(folder: Path) -> None:
    """Write a part of the real set: the last day's transmitters are unknown in `unknown/`."""
    from radiotwin.cells import write_csv

    table = pd.read_csv(REAL_SET / "measurements.csv.gz")
    devices = pd.read_csv(REAL_SET / "devices.csv")
    kept = devices["device"].iloc[::EVERY]
    table = table[table["device"].isin(kept)]
    last = table["flight"].max()
    for part, rows in (("known", table["flight"] != last), ("unknown", table["flight"] == last)):
        (folder / part).mkdir(parents=True)
        write_csv(table[rows], folder / part / "measurements.csv")
        mine = devices[devices["device"].isin(table[rows]["device"])].copy()
        write_csv(mine, folder / part / "truth.csv")
        if part == "unknown":
            mine["role"] = "unknown"
            mine[["x_m", "y_m"]] = float("nan")
        write_csv(mine, folder / part / "devices.csv")


def call(tree: Path, scratch: Path, *words: object, module: str = "") -> None:
    """Call `radiotwin`, or a module, of the source tree; show its output only where it fails."""
    command = ["-m", module] if module else ["-c", "from radiotwin.cli import main; main()"]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command, *map(str, words)], cwd=scratch,
                          env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: status {done.returncode}\n"
                         f"{done.stdout}{done.stderr}")


def close_loop(tree: Path, scratch: Path, inputs: Path,
               options: tuple[object, ...] = ()) -> dict:
    """Verdict, names and errors of one loop."""
    options = options or ("--scene", inputs / "scene")
    call(tree, scratch, "close-loop", inputs / "measurements.csv", *options, "-o", "loop")
    report = json.loads((scratch / "loop" / "closeloop.json").read_text())
    # Version 1 had the bias as measured minus predicted.
    sign = -1 if report["schema"].endswith("/1") else 1
    keep = {"rmse_db": 1, "bias_db": sign}
    return {"base": report["base"], "verdict": report["verdict"],
            "names": [effect["name"] for effect in report["effects"]],
            "parameters": {f"{effect['rank']} {name}": parameter["value"]
                           for effect in report["effects"]
                           for name, parameter in effect["parameters"].items()},
            "error": {when: {name: keep[name] * value
                             for name, value in report["error"][when].items() if name in keep}
                      for when in ("before", "after")},
            "baselines": {name: {"rmse_db": each["rmse_db"]}
                          for name, each in report["baselines"].items()}}


def fit(tree: Path, scratch: Path, inputs: Path, model: str) -> dict:
    """Positions of the devices by one channel model, and the mean of its radio map."""
    import xarray as xr

    call(tree, scratch, "fit", inputs / "measurements.csv", "--scene", inputs / "scene",
         "--model", model, "-o", "twin")
    call(tree, scratch, "map", "twin", "--scene", inputs / "scene", "-o", "map.nc")
    twin = json.loads((scratch / "twin" / "twin.json").read_text())
    with xr.open_dataset(scratch / "map.nc") as radio_map:
        level_db = float(radio_map["gain_db"].mean())
    return {"devices": {each["device"]: {"x_m": each["x_m"], "y_m": each["y_m"],
                                         "radius_m": each["credible_radius_m"]}
                        for each in twin["devices"]},
            "map": {"bias_db": level_db}}


def compare(tree: Path, scratch: Path, inputs: Path) -> dict:
    """Errors of every model on the held-out flight and the whole map."""
    call(tree, scratch, "compare", inputs / "measurements.csv", "--scene", inputs / "scene",
         "--truth", "traced", "-o", "comparison")
    return {"report": json.loads((scratch / "comparison" / "compare.json").read_text())}


def locate(tree: Path, scratch: Path, inputs: Path) -> dict:
    """Names on the known days of the real set, and places of the last day's transmitters."""
    found = close_loop(tree, scratch, inputs / "known", ("--base", "log-distance"))
    call(tree, scratch, "locate", inputs / "unknown" / "measurements.csv", "--twin", "loop/twin",
         "-o", "located.csv")
    places = pd.read_csv(scratch / "located.csv").set_index("device")
    return found | {"places": places[["x_m", "y_m", "radius_m"]].to_dict("index")}


def marl(tree: Path, scratch: Path, scene: Path) -> dict:
    """Shares that a small federated run collects."""
    call(tree, scratch, "--scene", scene, "--real-episodes", 2, "--episodes", 40, "--flights", 16,
         "--planner-iterations", 2000, "--out", "run", module="marl.fedqmix")
    table = pd.read_csv(scratch / "run" / "comparison.csv")
    seconds = [name for name in table if name.endswith("_s")]
    return {"rows": table.drop(columns=seconds).to_dict("records")}


def print_differences(before: dict, after: dict) -> int:
    """Print what differs by more than is allowed; the number of such values."""
    bad = 0
    for name in before:
        if name not in after:
            print(f"{name}: not run")
            bad += 1
            continue
        differences = list(differing(before[name], after[name], ()))
        bad += len(differences)
        cost = after[name]["cpu_s"] / max(before[name]["cpu_s"], 0.1)
        print(f"{name}: {len(differences)} differences, {cost:.2f} x the processor time"
              + (" (more than allowed)" if cost > COST_RATIO else ""))
        for path, one, other in differences:
            print(f"    {'.'.join(path)}: {one} -> {other}")
    return bad


def differing(one: object, other: object,
              path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], object, object]]:
    """Yield (path, before, after) of values that differ by more than their tolerance."""
    if path and path[-1] in ("cpu_s", "peak_gib_so_far", "provenance", "seconds", "version"):
        return
    if isinstance(one, dict) and isinstance(other, dict):
        for key in one.keys() | other.keys():
            yield from differing(one.get(key), other.get(key), (*path, key))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for index, pair in enumerate(zip(one, other, strict=True)):
            yield from differing(*pair, (*path, str(index)))
    elif isinstance(one, float) and isinstance(other, (int, float)):
        usual = 0.02 if path[-1].endswith("_db") else 1e-3 * abs(one) + 1e-9
        allowed = TOLERANCE.get(path[-1], usual)
        if abs(one - other) > allowed:
            yield path, one, other
    elif one != other:
        yield path, one, other


if __name__ == "__main__":
    main()
