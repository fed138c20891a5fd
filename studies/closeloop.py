"""What `close-loop` finds in traced cities where an effect is hidden: `hidden`.

The oracle is the same base, fitted to the same links with the effect taken out of them;
where a building is missing or gone, with the true map, and where a clock is wrong, with the true
positions.
"""

import copy
import warnings
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
import trimesh

from radiotwin import Measurements, Scene, close_loop, make_report
from radiotwin.closeloop.crossfit import cross_validate, make_bases, make_folds
from radiotwin.closeloop.search.declared import add_declared
from radiotwin.closeloop.search.stages import SearchInputs, SearchState, search
from radiotwin.effects.registry import catalogue
from radiotwin.links import prepare_links
from radiotwin.scene.citymap import CityMap
from studies.runner import Study
from studies.tables import markdown
from tests.undeclared.cases import FAMILIES, OUTSIDE, SEEDS, Case, case, stored
from tests.undeclared.families import world_of
from tests.undeclared.shapes import prism

UNITS = {"db": "dB", "m": "m", "deg": "°", "s": "s"}
GEOMETRY = ("missing_obstacle", "removed_obstacle")
ALL = (*FAMILIES, *OUTSIDE)
BY_TWIN = {f"nothing-twin-{by}": {"family": "nothing", "base": "twin", "hold_out": by}
           for by in ("flight", "device")}


def hidden_cases(seed: int) -> dict[str, dict]:
    """Return every case, and for each city what the base `twin` lacks of a ray tracer."""
    cases = {family: {"family": family, "base": "auto", "hold_out": "auto"}
             for family in ALL if seed in SEEDS and stored(family, seed)}
    return cases | (BY_TWIN if seed in (0, 1) else {})


def find_hidden(seed: int, settings: dict) -> dict:
    """Close the loop on the case `family`, `seed`, and compare what it says with the truth."""
    hidden, hold_out = case(settings["family"], seed), settings["hold_out"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = make_report(close_loop(hidden.measurements, hidden.scene, settings["base"], 0,
                                        hold_out=hold_out))
        oracle_rmse_db = _oracle_rmse_db(hidden, report["base"], hold_out)
    effects, error, truth = causes_of(report), report["error"], hidden.answer["effects"]
    columns = ("rmse_db", "bias_db", "std_db", "correlation", "nll")
    return {
        "hidden": truth, "base": report["base"], **summary(report),
        "gains_nats": [round(effect["evidence"]["heldout_nll_gain"]) for effect in effects],
        "indistinguishable": [effect["indistinguishable_from"] for effect in effects],
        "recovered": [recovered(effect, effects) for effect in truth],
        "parameters": [effect["parameters"] for effect in effects],
        **{when: {name: error[when][name] for name in columns} for when in ("before", "after")},
        "nlos_rmse_db": {when: each["rmse_db"] for when, each in error["by_los"]["nlos"].items()},
        "baselines": {name: each["rmse_db"] for name, each in report["baselines"].items()},
        "oracle_rmse_db": oracle_rmse_db}


def causes_of(report: dict) -> list[dict]:
    """Return the effects of a `closeloop.json` that were looked for, and found."""
    return [effect for effect in report["effects"] if not effect["is_declared"]]


def summary(report: dict) -> dict:
    """Return verdict, names and remaining drivers of a `closeloop.json`."""
    return {"verdict": report["verdict"], "named": [each["name"] for each in causes_of(report)],
            "drivers": [driver["variable"] for driver in report["remaining"]["drivers"]]}


def _oracle_rmse_db(hidden: Case, base: str, hold_out: str) -> float:
    """Return the held-out error of the base where nothing is hidden from it [dB]."""
    measurements, scene, effects = hidden.measurements, hidden.scene, hidden.answer["effects"]
    table = measurements.table.copy()
    if not any(effect["name"] in GEOMETRY for effect in effects):
        table["gain_db"] = table["gain_db"] - (hidden.clean_gain_db - hidden.plain_gain_db)
    for effect in effects:
        if effect["name"] in GEOMETRY:
            scene = with_true_city(scene, effect)
        if effect["name"] == "receiver_clock_offset":
            where = world_of(hidden.family, hidden.seed)
            points_m = np.repeat(where.points_m, len(where.names), axis=0)
            table[[f"receiver_{axis}_m" for axis in "xyz"]] = points_m
    return base_rmse_db(Measurements(table, measurements.devices), scene, base, hold_out)


def base_rmse_db(measurements: Measurements, scene: Scene, base: str, hold_out: str) -> float:
    """Return the held-out error of a base with what belongs to it [dB]."""
    links = prepare_links(measurements, scene)
    folds = make_folds(links, 0, hold_out)
    kind = make_bases(scene, 0)[base]
    model = cross_validate(links, kind, folds)
    inputs = SearchInputs(links, kind, folds, tuple(effect() for effect in catalogue()))
    return search(SearchState(model), [add_declared], inputs).model.rmse_db()


def with_true_city(scene: Scene, effect: dict) -> Scene:
    """Return the scene with its missing towers, or without the building that is gone."""
    mesh: Any = trimesh.Trimesh(scene.city.vertices, scene.city.faces, process=False)
    if effect["name"] == "removed_obstacle":
        corners_m = np.array(effect["corners_m"])
        low, high = corners_m.min(axis=0) - 1.5, corners_m.max(axis=0) + 1.5
        middle = mesh.triangles_center[:, :2]
        mesh = mesh.submesh([~((middle > low) & (middle < high)).all(axis=1)], append=True)
    for tower in effect.get("obstacles", []):
        tower_mesh = prism(np.array(tower["corners_m"]), tower["height_m"])
        mesh = trimesh.util.concatenate([mesh, tower_mesh])
    other = copy.copy(scene)
    other.__dict__["city"] = CityMap(mesh.vertices, mesh.faces)
    return other


def recovered(hidden: dict, effects: list[dict]) -> dict:
    """Return errors of the parameters of a hidden effect; empty where no effect has its name."""
    name, end = hidden["name"], f"[{hidden.get('receiver', hidden.get('device'))}]"
    mine = [each["parameters"] for each in effects if each["name"] == name]
    values = {key: parameter["value"] for key, parameter in mine[0].items()} if mine else {}
    here = {key.removesuffix(end): value for key, value in values.items() if key.endswith(end)}
    if name == "receiver_gain_offset" and here:
        return {"offset_error_db": here["offset_db"] - hidden["offset_db"]}
    if name in ("receiver_drift", "device_drift") and here:
        size_db = {"step": hidden.get("step_db"), "ageing": hidden.get("last_db"),
                   "warm_up": -hidden.get("final_db", np.nan)}[hidden["kind"]]
        found_db = next(value for key, value in here.items() if key.endswith("_db"))
        return {"amplitude_error_db": found_db - size_db}
    if name == "receiver_clock_offset" and values:
        return {"clock_error_s": here.get("positions_late_by_s", np.nan) - hidden["late_s"]}
    if name == "missing_obstacle" and mine:
        centre_m, height, true_m = min((
            (np.hypot(box["x_m"]["value"] - tower["centre_m"][0],
                      box["y_m"]["value"] - tower["centre_m"][1]),
             box["height_m"], tower["height_m"]) for box in mine for tower in hidden["obstacles"]),
            key=lambda pair: pair[0])
        return {"centre_error_m": centre_m, "height_error_m": height["value"] - true_m,
                "height_in_interval": height["low"] <= true_m <= height["high"],
                "boxes": len(mine), "towers": len(hidden["obstacles"])}
    if name == "removed_obstacle" and values:
        corners = np.array(hidden["corners_m"])
        away_m = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) - (values["x_m"], values["y_m"])
        return {"centre_error_m": np.hypot(*away_m)}
    if name == "device_position_error" and values:
        found_m = here.get("x_m", np.nan), here.get("y_m", np.nan)
        return {"position_error_m": np.hypot(*np.subtract(found_m, hidden["true_m"][:2]))}
    if name == "antenna_pattern":
        for kind, key in (("receiver", "tilt"), ("device", "azimuth")):
            if kind in hidden and f"{key}_deg" in here:
                off_deg = here[f"{key}_deg"] - hidden[f"{key}_deg"]
                return {f"{key}_error_deg": (off_deg + 180) % 360 - 180}
    return {}


def hidden_table(rows: pd.DataFrame) -> str:
    """Return the cases by family, one by one, and what the base `twin` lacks."""
    twins = rows[rows["name"].isin(BY_TWIN)]
    cases = rows[~rows["name"].isin(BY_TWIN)].copy()
    cases["named"] = [[name for name in names if name != "correlated_shadowing"]  # explains nothing
                      for names in cases["named"]]
    families = [family for family in ALL if family in set(cases["name"])]
    heads = ["hidden", "named first", "also named", "errors of what was recovered", "before [dB]",
             "after", "oracle", "log-distance", "kriging"]
    by_family = [_family_line(name, cases[cases["name"] == name]) for name in families]
    found = markdown(heads, by_family, "Hidden effects in traced cities",
                     f" ({len(cases)} cases; RMSE of held-out links)")
    ordered = sorted(cases.itertuples(), key=lambda row: (row.seed, families.index(row.name)))
    heads = ["hidden", "seed", *heads[1:3], "recovered", *heads[4:7]]
    one_by_one = markdown(heads, [_case_line(row) for row in ordered], "Case by case")
    lines = [[("first city", "second city")[row.seed], row.settings["hold_out"],
              counted(name for name in row.named
                      if name not in ("correlated_shadowing", "unexplained_trend")),
              *(f"{row.nlos_rmse_db[when]:.2f}" for when in ("before", "after")),
              f"{100 * (row.nlos_rmse_db['after'] / row.nlos_rmse_db['before'] - 1):.0f} %"]
             for name in BY_TWIN for row in twins[twins["name"] == name].itertuples()]
    of_twin = markdown(["city", "held out by", "named", "before", "after", ""], lines,
                       "Nothing is hidden, base `twin`",
                       ": RMSE of links without line of sight [dB]")
    return "\n\n".join([found, one_by_one, *([of_twin] if lines else [])])


def _family_line(family: str, cases: pd.DataFrame) -> list[str]:
    truth = [{effect["name"] for effect in each} for each in cases["hidden"]]
    pairs = list(zip(cases["named"], truth))
    right = f"{sum(bool(named) and named[0] in hidden for named, hidden in pairs)} of {len(cases)}"
    if not truth[0] or family in OUTSIDE:
        right = f"no name in {sum(not named for named, _ in pairs)} of {len(cases)}"
    elif family == "pairs":
        right += f"; both in {sum(hidden <= set(named) for named, hidden in pairs)}"
    others = Counter(sorted(name for named, hidden in pairs for name in set(named) - hidden))
    errors: dict[str, list[str]] = {}
    for name, value in _errors(cases["recovered"]):
        errors.setdefault(name, []).append(f"{value:+.1f}")
    texts = [f"{name.rsplit('_error_', 1)[0]} {', '.join(values)} {UNITS[name.split('_')[-1]]}"
             for name, values in errors.items()]
    scores = [*(cases[when].str["rmse_db"] for when in ("before", "after")),
              cases["oracle_rmse_db"],
              *(cases["baselines"].str[key] for key in ("log_distance", "regression_kriging"))]
    return [f"`{family}`", right,
            ", ".join(f"`{name}` {count}" for name, count in others.most_common()),
            "; ".join(texts), *(f"{each.mean():.2f}" for each in scores)]


def _errors(recovered_lists: Iterable[list[dict]]) -> list[tuple[str, float]]:
    return [(name, value) for each in recovered_lists for found in each
            for name, value in found.items() if "_error_" in name and value is not None]


def _case_line(row: Any) -> list[str]:
    hidden = {effect["name"] for effect in row.hidden}
    first = "–" if hidden else "no effect ✓"
    if row.named:
        first = f"`{row.named[0]}`" + (" ✓" if row.named[0] in hidden else "")
    errors = ", ".join(f"{name.split('_error_')[0]} {value:+.1f} {UNITS[name.split('_')[-1]]}"
                       for name, value in _errors([row.recovered]))
    rmse_db = (row.before["rmse_db"], row.after["rmse_db"], row.oracle_rmse_db)
    return [f"`{row.name}`", str(row.seed), first, counted(row.named[1:]), errors,
            *(f"{value:.2f}" for value in rmse_db)]


def counted(names: Iterable[str]) -> str:
    """Return names with how often each occurs."""
    return ", ".join(f"`{name}`" + (f" × {count}" if count > 1 else "")
                     for name, count in Counter(names).items())


STUDIES = {
    "hidden": Study("What does close-loop find?", find_hidden, hidden_cases, hidden_table,
                    seeds=len(SEEDS))}
