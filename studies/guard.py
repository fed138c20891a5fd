"""Golden runs: the same commands on the same inputs, before and after a change, equal to the bit.

    python studies/guard.py run --tree . --inputs build/guard -o after.json    # resumes
    python studies/guard.py run --tree . --inputs build/guard --shard 0/2 -o after.json
    python studies/guard.py compare before.json after.json

`run` writes the inputs once and then calls the command line of the source tree given, every step
in processes of its own and from an empty cache. What a step wrote is kept as hashes: of each value
of a JSON file, each variable of a radio map, the pixels of a picture, the rows of a table, and of
what was printed. Times, versions and paths are left out. `compare` prints everything that differs.
"""

import argparse
import hashlib
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from radiotwin import Measurements

sys.path.insert(0, str(Path(__file__).parents[1]))

ROOT = Path(__file__).parents[1]
HIDDEN = ("antenna_pattern:1", "device_position_error:1", "excess_attenuation:1", "foliage:1",
          "missing_obstacle:1", "receiver_drift:1", "receiver_saturation:1", "removed_obstacle:1",
          "receiver_clock_offset:1", "pairs:1", "receiver_gain_offset:1", "device_drift:1")
NULLS = ("nothing:0", "nothing:1", "nothing:2", "nothing:3")
FOREIGN = ("city00-w0-c0", "city00-w0-c3", "city01-w0-c1", "city01-w1-c2", "city02-w1-c1",
           "city02-w1-c3")
MODELS = ("log_distance", "segmented_log_distance", "segmented_nn", "kriging",
          "path_kriging", "p1411", "cost231_wi", "cost231_wi_metropolitan",
          "tr36777_uma", "tr36777_umi", "al_hourani_urban", "al_hourani_suburban")
QUICK = ("import", "fit", "map", "coverage")  # beginnings of the steps that `--quick` runs
DATA = Path(os.environ.get("RADIOTWIN_DATA", ROOT.parent / "shared" / "data"))
THIN = 3  # one position in so many of the hidden and the null cases
EVERY = 12  # one transmitter position in so many of the POWDER set
CELL_M = 10.0  # one reading of a sector in each cell of the campus
LEFT_OUT = re.compile(r"(^|_)(seconds|version|versions|cpu|wall|created|time_utc|date|elapsed)"
                      r"(_s)?$|^peak_|^seconds_|^(learn_twin|round)_s$")
WORDS = re.compile(r"\b\d+(\.\d+)? (s|min|h|seconds|minutes)\b|\d\d:\d\d:\d\d|0\+source"
                   r"|/\S*guard\S*|/tmp/\S*|0\.1\.0\S*")
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
    run_parser.add_argument("--quick", action="store_true", help="only the steps of seconds")
    run_parser.add_argument("--shard", default="0/1", help="this of so many parts, as 0/2")
    run_parser.add_argument("-o", "--out", type=Path, required=True)
    compare_parser = commands.add_parser("compare")
    compare_parser.add_argument("before", type=Path)
    compare_parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        before, after = (json.loads(path.read_text())
                         for path in (arguments.before, arguments.after))
        sys.exit(print_differences(before, after))
    only = QUICK if arguments.quick else tuple(arguments.only or [""])
    run(arguments.tree.resolve(), arguments.inputs.resolve(), arguments.out, only,
        *map(int, arguments.shard.split("/")))


def run(tree: Path, inputs: Path, out: Path, only: tuple[str, ...], shard: int,
        shards: int) -> None:
    """Run every step that is not in `out` yet."""
    results = json.loads(out.read_text()) if out.exists() else {}
    chosen = [(name, step) for name, step in steps(inputs).items() if name.startswith(only)]
    for name, step in chosen[shard::shards]:
        if name in results:
            continue
        with tempfile.TemporaryDirectory(prefix="guard-") as scratch:
            print(name, flush=True)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            printed = step(partial(call, tree, Path(scratch)))
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            started, ended = (each.ru_utime + each.ru_stime for each in (before, after))
            results[name] = {"cpu_s": round(ended - started, 1), "printed": printed,
                             "files": dict(fingerprints(Path(scratch) / "out"))}
        out.write_text(json.dumps(results, indent=1), encoding="utf-8")


Call = Callable[..., str]


def steps(inputs: Path) -> dict[str, Callable[[Call], list[str]]]:
    """Every step by name: it takes what calls a command, and returns what was printed."""
    write_inputs(inputs)
    rbm, readme = inputs / "rbm", inputs / "campaign"
    found: dict[str, Callable[[Call], list[str]]] = {
        "import and build the README's campaign": partial(run_readme, readme)}
    found |= {f"fit {model}": partial(fit, rbm, model) for model in MODELS}
    found |= {"coverage": partial(coverage, rbm), "compare": partial(compare, rbm),
              "fedqmix": partial(fedqmix, rbm / "scene")}
    if (inputs / "duke").is_dir():
        found["import the campus"] = partial(import_campus, inputs / "duke")
    if (inputs / "powder").is_dir():
        found["locate powder"] = partial(locate, inputs / "powder")
    found |= {f"close-loop {case}": partial(close_loop, inputs / case.replace(":", "-"))
              for case in (*HIDDEN, *NULLS, *FOREIGN)}
    found["close-loop campaign"] = partial(close_readme, readme)
    if (inputs / "campus").is_dir():
        found["close-loop campus"] = partial(close_loop, inputs / "campus")
    return found


def write_inputs(inputs: Path) -> None:
    """Write what every run reads, unless it is there."""
    if (inputs / "complete").is_file():
        return
    from radiotwin import RadioMap, Scene, fly_survey
    from tests.undeclared.cases import case
    from tests.undeclared.foreign.cases import foreign_case

    shutil.rmtree(inputs, ignore_errors=True)
    for name in (*HIDDEN, *NULLS, *FOREIGN):
        folder = inputs / name.replace(":", "-")
        hidden = foreign_case(name) if name in FOREIGN else case(
            name.split(":")[0], int(name.split(":")[1]))
        thinned(hidden.measurements, 1 if name in FOREIGN else THIN).save(
            folder / "measurements.csv")
        shutil.copytree(hidden.scene.folder, folder / "scene", dirs_exist_ok=True)
    shutil.copytree(ROOT / "examples" / "campaign", inputs / "campaign")
    shutil.copytree(ROOT / "scenes" / "rbm", inputs / "rbm" / "scene")
    scene = Scene.load(inputs / "rbm" / "scene")
    survey = fly_survey(scene, RadioMap.load(ROOT / "scenes" / "rbm" / "truth.nc"), flights=3,
                        pattern="random-waypoint", seed=0)
    survey.save(inputs / "rbm" / "measurements.csv")
    if (DATA / "powder_frs").is_dir():
        write_powder(inputs / "powder")
    if (DATA / "duke_cbrs" / "map.osm").is_file():
        write_campus(inputs)
    (inputs / "complete").touch()


def thinned(measurements: "Measurements", step: int) -> "Measurements":
    """Return one of so many positions of each receiver, with all its devices."""
    table = measurements.table
    at = table.groupby(["flight", "receiver", "time_s"], dropna=False, sort=False).ngroup()
    return replace(measurements, table=table[at % step == 0].reset_index(drop=True))


def write_powder(folder: Path) -> None:
    """Write a part of the real set: the last day's transmitters are unknown in `unknown/`."""
    table = pd.read_csv(DATA / "powder_frs" / "measurements.csv.gz")
    devices = pd.read_csv(DATA / "powder_frs" / "devices.csv")
    kept = devices["device"].iloc[::EVERY]
    table = table[table["device"].isin(kept)]
    last = table["flight"].max()
    for part, rows in (("known", table["flight"] != last), ("unknown", table["flight"] == last)):
        (folder / part).mkdir(parents=True)
        table[rows].to_csv(folder / part / "measurements.csv", index=False)
        heard = devices[devices["device"].isin(table[rows]["device"])].copy()
        if part == "unknown":
            heard["role"] = "unknown"
            heard[["x_m", "y_m"]] = float("nan")
        heard.to_csv(folder / part / "devices.csv", index=False)


def write_campus(inputs: Path) -> None:
    """Write the campus' raw files, and its readings thinned to cells with the scene."""
    import gzip

    from studies.campus import campus
    from studies.closeloop_real import one_in_each_cell

    folder = inputs / "duke"
    folder.mkdir(parents=True)
    for name in ("sites.csv", "import.toml", "map.osm"):
        shutil.copy(DATA / "duke_cbrs" / name, folder / name)
    (folder / "raw.csv").write_bytes(gzip.decompress(
        (DATA / "duke_cbrs" / "raw.csv.gz").read_bytes()))
    with campus() as (measurements, scene):
        table = one_in_each_cell(measurements.table, CELL_M, ("device",), seed=0)
        replace(measurements, table=table).save(inputs / "campus" / "measurements.csv")
        shutil.copytree(scene.folder, inputs / "campus" / "scene")


def call(tree: Path, scratch: Path, *words: object, module: str = "radiotwin.cli") -> str:
    """Call a command of the source tree in the scratch folder; return what it printed."""
    command = ["-m", module] if module != "radiotwin.cli" else [
        "-c", "from radiotwin.cli import main; main()"]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1",
                                "RADIOTWIN_CACHE": str(scratch / "cache"), "COLUMNS": "160",
                                "OGR_CURRENT_DATE": "2026-01-01T00:00:00.000Z"}
    done = subprocess.run([sys.executable, *command, *map(str, words)], cwd=scratch,
                          env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: status {done.returncode}\n"
                         f"{done.stdout}{done.stderr}")
    return "\n".join(line.rstrip() for line in WORDS.sub("…", done.stdout).splitlines()
                     if "…" not in line)


def run_readme(inputs: Path, call: Call) -> list[str]:
    """Do what the README does, up to the map."""
    return [
        call("build-scene", inputs / "town.geojson", "--frequency-hz", 2.4e9, "-o", "out/town"),
        call("import", inputs / "log.csv", "--columns", inputs / "log.toml", "-o", "out/measured"),
        call("fit", "out/measured/measurements.csv", "--scene", "out/town", "-o", "out/twin"),
        *(call("map", "out/twin", "--scene", "out/town", "-o", f"out/level{ending}")
          for ending in (".png", ".nc", ".csv", ".tif", ".kmz"))]


def close_readme(inputs: Path, call: Call) -> list[str]:
    """Close the loop on the README's campaign, and write its page."""
    call("build-scene", inputs / "town.geojson", "--frequency-hz", 2.4e9, "-o", "town")
    call("import", inputs / "log.csv", "--columns", inputs / "log.toml", "-o", "measured")
    return [call("close-loop", "measured/measurements.csv", "--scene", "town", "-o", "out/loop"),
            call("report", "out/loop", "--scene", "town"),
            call("map", "out/loop/twin", "--scene", "town", "-o", "out/level.nc")]


def close_loop(inputs: Path, call: Call) -> list[str]:
    """Close the loop on measurements over a scene."""
    return [call("close-loop", inputs / "measurements.csv", "--scene", inputs / "scene",
                 "-o", "out/loop")]


def fit(inputs: Path, model: str, call: Call) -> list[str]:
    """Learn a channel model, find the devices, and draw the twin's map."""
    return [call("fit", inputs / "measurements.csv", "--scene", inputs / "scene",
                 "--model", model, "-o", "out/twin"),
            call("map", "out/twin", "--scene", inputs / "scene", "-o", "out/map.nc")]


def coverage(inputs: Path, call: Call) -> list[str]:
    """Predict coverage of the scene's devices."""
    return [call("coverage", inputs / "scene", "--tx-power-dbm", 10, "-o", "out/coverage")]


def compare(inputs: Path, call: Call) -> list[str]:
    """Compare every model on the held-out flight and the whole map."""
    return [call("compare", inputs / "measurements.csv", "--scene", inputs / "scene",
                 "--truth", "traced", "-o", "out/comparison")]


def import_campus(inputs: Path, call: Call) -> list[str]:
    """Import the campus' raw readings."""
    return [call("import", inputs / "raw.csv", "--columns", inputs / "import.toml", "-o",
                 "out/measured")]


def locate(inputs: Path, call: Call) -> list[str]:
    """Name what the known days of POWDER show, and locate the last day's transmitters."""
    return [call("close-loop", inputs / "known" / "measurements.csv", "--base", "log-distance",
                 "-o", "out/loop"),
            call("locate", inputs / "unknown" / "measurements.csv", "--twin", "out/loop/twin",
                 "-o", "out/located.csv")]


def fedqmix(scene: Path, call: Call) -> list[str]:
    """Run a small federated experiment."""
    return [call("--scene", scene, "--real-episodes", 2, "--episodes", 40, "--flights", 16,
                 "--planner-iterations", 2000, "--out", "out/run", module="marl.fedqmix")]


def fingerprints(folder: Path) -> Iterator[tuple[str, object]]:
    """Yield the name of each file of a folder and the hashes of its parts."""
    for path in sorted(folder.rglob("*")):
        # Events and checkpoints of planning repeat the rows of metrics.csv with their times.
        if path.is_file() and not path.name.startswith(("events.out", "checkpoint")):
            yield path.relative_to(folder).as_posix(), fingerprint(path)


def fingerprint(path: Path) -> object:
    """Return the hash of a file, or of each of its parts by name."""
    if path.suffix == ".json":
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            return hash_of(repr(plain(content)))
        return {key: hash_of(repr(plain(value))) for key, value in content.items()
                if not LEFT_OUT.search(key)} | headline(content)
    if path.suffix == ".nc":
        import xarray as xr

        with xr.open_dataset(path) as opened:
            return {str(name): hash_of(np.ascontiguousarray(each.values).tobytes())
                    for name, each in opened.variables.items() if each.dtype != object}
    if path.suffix == ".png":
        from PIL import Image

        with Image.open(path) as picture:
            return hash_of(picture.tobytes())
    if path.suffix == ".csv":
        table = pd.read_csv(path)
        return hash_of(table[[name for name in table if not LEFT_OUT.search(str(name))
                              and not str(name).endswith("_seconds")]].to_csv())
    if path.suffix in (".kmz", ".zip", ".npz"):
        import zipfile

        with zipfile.ZipFile(path) as archive:
            return {name: hash_of(archive.read(name)) for name in sorted(archive.namelist())}
    if path.suffix in (".html", ".txt", ".md", ".toml", ".geojson", ".jsonl"):
        return hash_of(WORDS.sub("…", path.read_text(encoding="utf-8")))
    return hash_of(path.read_bytes())


def headline(content: dict) -> dict[str, object]:
    """Return the few values of a loop's report that a reader wants to see."""
    if "verdict" not in content:
        return {}
    return {"says": {"base": content["base"], "verdict": content["verdict"],
                     "names": [effect["name"] for effect in content["effects"]],
                     **{when: content["error"][when].get("rmse_db")
                        for when in ("before", "after")}}}


def plain(value: object) -> object:
    """Return a JSON value without times, versions and paths."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in sorted(value.items())
                if not LEFT_OUT.search(key)}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return WORDS.sub("…", value) if isinstance(value, str) else value


def hash_of(content: str | bytes) -> str:
    """Return a short hash."""
    data = content.encode() if isinstance(content, str) else content
    return hashlib.blake2b(data, digest_size=8).hexdigest()


def print_differences(before: dict, after: dict) -> int:
    """Print what differs; return the number of such values."""
    bad = 0
    for name in before:
        if name not in after:
            print(f"{name}: not run")
            bad += 1
            continue
        found = list(differing(before[name], after[name], ()))
        bad += len(found)
        cost = after[name]["cpu_s"] / max(before[name]["cpu_s"], 0.1)
        print(f"{name}: {len(found)} differences, {cost:.2f} x the processor time"
              + (" (more than allowed)" if cost > COST_RATIO else ""))
        for path, one, other in found:
            print(f"    {' / '.join(path)}: {one} -> {other}")
    print(f"{len(before)} steps, {bad} differences")
    return bad


def differing(one: object, other: object,
              path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], object, object]]:
    """Yield (path, before, after) of values that are not equal."""
    if path == ("cpu_s",):
        return
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted(one.keys() | other.keys()):
            yield from differing(one.get(key), other.get(key), (*path, key))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for number, pair in enumerate(zip(one, other, strict=True)):
            yield from differing(*pair, (*path, str(number)))
    elif one != other:
        yield path, one, other


if __name__ == "__main__":
    main()
