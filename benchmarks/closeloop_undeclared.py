"""How well the loop names what is hidden, and how near its error comes to that of who knows.

    python benchmarks/closeloop_undeclared.py -o docs/results/closeloop_undeclared.json [--only FAMILY[:SEED] …]
    python benchmarks/closeloop_undeclared.py --write FOLDER --only FAMILY:SEED   # measurements, to try it on
    python benchmarks/closeloop_undeclared.py --table docs/results/closeloop_undeclared.json

Runs `close-loop` on the cases of `tests/undeclared` that are traced. A case that is in the file already is left out, so
that a run that was stopped goes on. The oracle is the same base, fitted to the same links with the effect taken out of
them; where a building is missing or gone, with the true map, and where a clock is wrong, with the true places.
"""

import argparse
import copy
import json
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import trimesh

from radiotwin.closeloop.bases import TwinBase
from radiotwin.closeloop.folds import make_folds
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import make_records
from radiotwin.closeloop.report import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.search import make_model, rmse_db
from radiotwin.files import atomic_path
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from tests.undeclared.cases import FAMILIES, OUTSIDE, SEEDS, Case, case, stored
from tests.undeclared.families import world_of

UNITS = {"db": "dB", "m": "m", "deg": "°", "s": "s"}
GEOMETRY = ("missing_obstacle", "removed_obstacle")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("-o", "--out", type=Path)
    what.add_argument("--write", type=Path, metavar="FOLDER")
    what.add_argument("--table", type=Path, metavar="RESULTS")
    parser.add_argument("--base", default="auto")
    parser.add_argument("--hold-out", default="auto")
    parser.add_argument("--only", nargs="*", default=[*FAMILIES, *OUTSIDE], help="FAMILY or FAMILY:SEED")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if arguments.table:
        print(table(json.loads(arguments.table.read_text())))
        return
    wanted = [(family, seed) for seed in SEEDS for family in (*FAMILIES, *OUTSIDE)
              if {family, f"{family}:{seed}"} & set(arguments.only)]
    if arguments.write:
        for family, seed in wanted:
            hidden = case(family, seed)
            hidden.measurements.write(arguments.write / f"{family}-{seed}" / "measurements.csv")
            print(f"wrote {arguments.write / f'{family}-{seed}'}; its scene is {hidden.scene.folder}")
        return
    results = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for family, seed in wanted:
        name = f"{family}:{seed}"
        if name in results or not stored(family, seed):
            continue
        results[name] = study(case(family, seed), arguments.base, arguments.hold_out)
        print(name, json.dumps({k: results[name][k] for k in ("named", "recovered", "before", "after", "oracle_rmse_db",
                                                              "cpu_s")}), flush=True)
        with atomic_path(arguments.out) as temporary:
            temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")


def study(hidden: Case, base: str, hold_out: str) -> dict:
    """What the loop says of a case, and how that compares with the truth."""
    started = time.process_time()
    report = make_report(close_loop(hidden.measurements, hidden.scene, base, 0, lambda text: None, hold_out))
    cpu_s = time.process_time() - started
    baselines = {name: round(scores["rmse_db"], 3) for name, scores in report["baselines"].items()}
    short = ("rmse_db", "bias_db", "std_db", "correlation", "nll")
    errors = {when: {name: round(report["error"][when][name], 3) for name in short} for when in ("before", "after")}
    nlos = {when: report["error"]["by_los"]["nlos"][when]["rmse_db"] for when in ("before", "after")}
    return {
        "hidden": hidden.answer["effects"], "base": report["base"], "verdict": report["verdict"],
        "named": [effect["name"] for effect in report["effects"]],
        "gains_nats": [round(effect["evidence"]["heldout_nll_gain"]) for effect in report["effects"]],
        "indistinguishable": [effect["indistinguishable_from"] for effect in report["effects"]],
        "recovered": [recovered(effect, report) for effect in hidden.answer["effects"]],
        "parameters": [effect["parameters"] for effect in report["effects"]],
        **errors, "nlos_rmse_db": nlos, "baselines": baselines,
        "oracle_rmse_db": round(oracle_rmse_db(hidden, report["base"], hold_out), 3),
        "drivers": [driver["variable"] for driver in report["remaining"]["drivers"]], "cpu_s": round(cpu_s)}


def table(results: dict) -> str:
    """Results as Markdown, a line for each family; mean errors over its cases."""
    lines = ["| hidden | named first | also named | errors of what was recovered | before [dB] | after | oracle "
             "| log-distance | kriging |", "|---|---|---|---|---|---|---|---|---|"]
    for family in (*FAMILIES, *OUTSIDE):
        cases = [results[f"{family}:{seed}"] for seed in SEEDS if f"{family}:{seed}" in results]
        if not cases:
            continue
        hidden = [{effect["name"] for effect in each["hidden"]} for each in cases]
        named = [[name for name in each["named"] if name != "correlated_shadowing"] for each in cases]
        first = sum(bool(names) and names[0] in truth for names, truth in zip(named, hidden))
        if not hidden[0] or family in OUTSIDE:
            right = f"no name in {sum(not names for names in named)} of {len(cases)}"
        elif family == "pairs":
            both = sum(truth <= set(names) for names, truth in zip(named, hidden))
            right = f"{first} of {len(cases)}; both in {both}"
        else:
            right = f"{first} of {len(cases)}"
        others = Counter(name for names, truth in zip(named, hidden) for name in set(names) - truth)
        errors: dict[str, list[str]] = {}
        for each in cases:
            for found in each["recovered"]:
                for name, value in found.items():
                    if name.rsplit("_", 1)[-1] in UNITS and value is not None:
                        errors.setdefault(name, []).append(f"{value:+.1f}")
        told = "; ".join(f"{name.rsplit('_error_', 1)[0]} {', '.join(values)} {UNITS[name.split('_')[-1]]}"
                         for name, values in errors.items())
        scores = [np.mean([each[when]["rmse_db"] for each in cases]) for when in ("before", "after")]
        scores.append(np.mean([each["oracle_rmse_db"] for each in cases]))
        scores += [np.mean([each["baselines"][name] for each in cases]) for name in ("log_distance",
                                                                                   "regression_kriging")]
        also = ", ".join(f"`{name}` {count}" for name, count in others.most_common())
        lines.append(f"| `{family}` | {right} | {also} | {told} | " + " | ".join(f"{s:.2f}" for s in scores) + " |")
    return "\n".join(lines)


def oracle_rmse_db(hidden: Case, base: str, hold_out: str) -> float:
    """Held-out error of the base where nothing is hidden from it."""
    measurements, scene = hidden.measurements, hidden.scene
    effects = hidden.answer["effects"]
    table = measurements.table.copy()
    if not any(effect["name"] in GEOMETRY for effect in effects):
        table["gain_db"] = table["gain_db"] - (hidden.clean_gain_db - hidden.plain_gain_db)
    for effect in effects:
        if effect["name"] in GEOMETRY:
            scene = with_true_city(scene, effect)
        if effect["name"] == "receiver_clock_offset":
            where = world_of(hidden.family, hidden.seed)
            table[[f"receiver_{axis}_m" for axis in "xyz"]] = np.repeat(where.points_m, len(where.names), axis=0)
    records = make_records(Measurements(table, measurements.devices), scene)
    twin = TwinBase(scene, 0)
    folds = make_folds(records, 0, hold_out)
    fitted = make_model(records, {"twin": twin, "raytrace": RaytraceBase(twin)}[base], folds)
    return rmse_db(fitted, np.ones(len(records), dtype=bool))


def with_true_city(scene: Scene, effect: dict) -> Scene:
    """A scene with the towers that stand there, or without the building that does not."""
    city = scene.city
    mesh = trimesh.Trimesh(city.vertices, city.faces, process=False)
    if effect["name"] == "removed_obstacle":
        corners_m = np.array(effect["corners_m"])
        low, high = corners_m.min(axis=0) - 1.5, corners_m.max(axis=0) + 1.5
        middle = mesh.triangles_center[:, :2]
        mesh = mesh.submesh([~((middle > low) & (middle < high)).all(axis=1)], append=True)
    else:
        mesh = trimesh.util.concatenate([mesh, *(_prism(tower) for tower in effect["obstacles"])])
    other = copy.copy(scene)
    other.__dict__["city"] = CityMap(mesh.vertices, mesh.faces)
    return other


def _prism(tower: dict) -> trimesh.Trimesh:
    corners = np.array(tower["corners_m"])
    fan = [(0, i, i + 1) for i in range(1, len(corners) - 1)]
    mesh = trimesh.creation.extrude_triangulation(corners, fan, tower["height_m"])
    mesh.fix_normals()
    return mesh


def recovered(effect: dict, report: dict) -> dict:
    """Errors of the parameters of a hidden effect; empty where it was not named."""
    found = next((each for each in report["effects"] if each["name"] == effect["name"]), None)
    if found is None:
        return {}
    values = {name: parameter["value"] for name, parameter in found["parameters"].items()}
    name = effect["name"]
    if name == "receiver_gain_offset":
        return {"offset_error_db": _near(values[f"offset_db[{effect['receiver']}]"] - effect["offset_db"])}
    if name in ("receiver_drift", "device_drift"):
        size = {"step": effect.get("step_db"), "ageing": effect.get("last_db"),
                "warm_up": -effect.get("final_db", np.nan)}[effect["kind"]]
        end = effect[name.removesuffix("_drift")]
        mine = [value for label, value in values.items() if label.endswith(f"_db[{end}]")]
        return {"amplitude_error_db": _near(mine[0] - size)} if mine else {}
    if name == "receiver_clock_offset":
        late_s = values.get(f"positions_late_by_s[{effect['receiver']}]", np.nan)
        return {"clock_error_s": _near(late_s - effect["late_s"])}
    if name == "missing_obstacle":
        every = [each["parameters"] for each in report["effects"] if each["name"] == name]
        errors = []
        for box in every:
            place = np.array([box["x_m"]["value"], box["y_m"]["value"]])
            apart = [np.linalg.norm(place - tower["centre_m"]) for tower in effect["obstacles"]]
            tower = effect["obstacles"][int(np.argmin(apart))]
            inside = box["height_m"]["low"] <= tower["height_m"] <= box["height_m"]["high"]
            errors.append((min(apart), box["height_m"]["value"] - tower["height_m"], inside))
        centre_m, height_m, inside = min(errors, key=lambda error: error[0])
        return {"centre_error_m": _near(centre_m), "height_error_m": _near(height_m), "height_in_interval": inside,
                "boxes": len(every), "towers": len(effect["obstacles"])}
    if name == "removed_obstacle":
        corners = np.array(effect["corners_m"])
        place = np.array([values["x_m"], values["y_m"]])
        return {"centre_error_m": _near(np.linalg.norm(place - 0.5 * (corners.min(axis=0) + corners.max(axis=0))))}
    if name == "device_position_error":
        x_m, y_m = (values.get(f"{axis}_m[{effect['device']}]", np.nan) for axis in "xy")
        return {"position_error_m": _near(np.hypot(x_m - effect["true_m"][0], y_m - effect["true_m"][1]))}
    if name == "antenna_pattern" and f"tilt_deg[{effect.get('receiver')}]" in values:
        return {"tilt_error_deg": _near(values[f"tilt_deg[{effect['receiver']}]"] - effect["tilt_deg"])}
    if name == "antenna_pattern" and f"azimuth_deg[{effect.get('device')}]" in values:
        apart = values[f"azimuth_deg[{effect['device']}]"] - effect["azimuth_deg"]
        return {"azimuth_error_deg": _near((apart + 180) % 360 - 180)}
    return {}


def _near(value: float) -> float | None:
    return round(float(value), 2) if np.isfinite(value) else None


if __name__ == "__main__":
    main()
