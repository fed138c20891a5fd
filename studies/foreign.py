"""Results of `close-loop` in foreign cities; half of them calibrate, half judge: `foreign`.

    python -m studies foreign --only calibrate
    python -m studies foreign --only judge

The oracle is the same base on the same campaign with nothing hidden in it; the map's own errors and
the receivers' habits stay.
"""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from radiotwin import close_loop, make_report
from studies.closeloop import base_rmse_db, causes_of
from studies.foreign_figures import foreign_figures
from studies.foreign_roc import COLUMNS, LIMITS_DIFFER_DB, by_mistake_of_the_map
from studies.foreign_table import PHYSICS, UNNAMED, foreign_table
from studies.runner import Study
from tests.undeclared.foreign.cases import ForeignCase, families, foreign_case, names, split_of

NONE, OTHER = "none", "not in the catalogue"
FULL_WIDTH = 2 * np.sqrt(2 * np.log(2))  # at half, by the standard deviation of a normal curve


def foreign_cases(seed: int) -> dict[str, dict]:
    """Return every case whose world is traced, as `calibrate/city00-w0-c0`; seed 0 only."""
    if seed:
        return {}
    return {f"{split_of(name)}/{name}": {"case": name, "base": "auto", "hold_out": "auto"}
            for name in names()}


def close_foreign(seed: int, settings: dict) -> dict:
    """Close the loop on a case, and compare what it says with the truth."""
    hidden, hold_out = foreign_case(settings["case"]), settings["hold_out"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = make_report(close_loop(hidden.measurements, hidden.scene, settings["base"], seed,
                                        hold_out=hold_out))
        oracle_rmse_db = _oracle_rmse_db(settings["case"], report["base"], hold_out)
    effects, error = causes_of(report), report["error"]
    right = {each["name"] for each in hidden.answer["effects"]}
    mistaken = {each["name"] for each in effects
                if _by_mistake_of_the_map(each, hidden) or _is_a_shower(each, hidden)}
    return {
        "split": hidden.split, "hidden": hidden.answer["effects"], "size_db": hidden.size_db,
        "families": list(families(hidden.name)), "nuisance": _plain(hidden.answer["nuisance"]),
        "base": report["base"], "verdict": report["verdict"],
        "named": [each["name"] for each in effects],
        "probabilities": [each.get("probability") for each in effects],
        "rivals": [each["indistinguishable_from"] for each in effects],
        "tolerated": sorted(mistaken - right),
        "statements": [[name, probability, _is_true(name, hidden, right | mistaken)]
                       for name, probability in _first_posterior(report)],
        "parameters": [each for truth in hidden.answer["effects"]
                       for each in compared(truth, effects, hidden)],
        "seen": [sizes for truth in hidden.answer["effects"]
                 for sizes in _sizes(truth, hidden, report["detectable"])],
        **{when: {name: error[when].get(name) for name in ("rmse_db", "bias_db", "nll")}
           for when in ("before", "after", "combined")},
        "oracle_rmse_db": oracle_rmse_db,
        "baselines": {name: each["rmse_db"] for name, each in report["baselines"].items()},
        "candidates": [[each.get(key) for key in COLUMNS] for each in report["candidates"]
                       if each["heldout_nll_gain"] is not None]}


def _plain(nuisance: dict) -> dict:
    """Return what a row keeps of what no effect explains: numbers of buildings for their plans."""
    return {key: len(value) if key in ("unmapped", "gone") else value
            for key, value in nuisance.items()}


def _oracle_rmse_db(name: str, base: str, hold_out: str) -> float:
    """Return the held-out error of the base where nothing is hidden from it [dB]."""
    without = foreign_case(name, hidden=False)
    return base_rmse_db(without.measurements, without.scene, base, hold_out)


def _first_posterior(report: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield names and probabilities of the first step that are at least a hundredth."""
    steps = report.get("posterior") or [{}]
    for each in steps[0].get("probabilities", steps if "name" in steps[0] else []):
        if each["probability"] is not None and each["probability"] >= 0.01:
            yield each["name"], each["probability"]


def _is_true(name: str, hidden: ForeignCase, right: set[str]) -> bool:
    """Return whether an effect, nothing, or something without a name is in a case."""
    effects = hidden.answer["effects"]
    if name == NONE:
        return not effects
    if name == OTHER:
        return any(not each["in_catalogue"] for each in effects)
    return name in right | UNNAMED | PHYSICS


def _by_mistake_of_the_map(effect: dict, hidden: ForeignCase) -> bool:
    """Return whether a name is true of what no campaign declares right, though nobody hid it."""
    nuisance, values = hidden.answer["nuisance"], effect["parameters"]
    if "x_m" in values and by_mistake_of_the_map(
            effect["name"], values["x_m"]["value"], values["y_m"]["value"], nuisance):
        return True
    if effect["name"] == "noise_floor_censoring":
        return nuisance["declared"] == "wrong" or np.ptp(nuisance["limit_db"]) > LIMITS_DIFFER_DB
    return False


def _is_a_shower(effect: dict, hidden: ForeignCase) -> bool:
    """Return whether an episode is named while it rained: true, though rain is no plain episode."""
    rain: dict = next((each for each in hidden.answer["effects"] if each["name"] == "shower"), {})
    times_s = [value["value"] for name, value in effect["parameters"].items()
               if name.startswith(("start_s", "end_s"))]
    return (effect["name"] == "episode" and bool(rain) and len(times_s) == 2
            and rain["start_s"] <= np.mean(times_s) <= rain["end_s"])


def compared(truth: dict, effects: list[dict], hidden: ForeignCase) -> list[dict]:
    """Return the parameters of a hidden effect as reported, each with its true value.

    Args:
        truth: entry of the answer.
        effects: of the report.
        hidden: the case.

    Returns:
        name of the effect, name of the parameter without the end, `truth`, `value`, `low`, `high`,
        `unit`, `determined`; empty where no effect has its name.
    """
    mine: dict[str, dict] = next((each["parameters"] for each in effects
                                  if each["name"] == truth["name"]), {})
    end = f"[{truth.get('device', truth.get('receiver'))}]"
    true = _true_parameters(truth, hidden)
    if truth["name"].endswith("gain_offset"):
        # Reported relative to one of them, whose own is 0.
        reference = next((key for key, each in mine.items() if each["low"] == each["high"]), "")
        shift = true["offset_db"] if reference == f"offset_db{end}" else 0.0
        true = {key: true["offset_db"] * (key == f"offset_db{end}") - shift
                for key in mine if key != reference}
    found = []
    for name, value in true.items():
        key = next((key for key in (name, f"{name}{end}") if key in mine), None)
        if key is None or mine[key]["value"] is None or value is None:
            continue
        each = mine[key]
        if each["unit"] == "deg" and "azimuth" in name:  # the nearest of equal angles
            value = each["value"] + (value - each["value"] + 180) % 360 - 180
        found.append({"name": truth["name"], "parameter": name.partition("[")[0], "truth": value,
                      "determined": each.get("determined", True),
                      **{part: each[part] for part in ("value", "low", "high", "unit")}})
    return found


def _true_parameters(truth: dict, hidden: ForeignCase) -> dict[str, Any]:
    """Return true values by the names that the report gives them, ends left out."""
    sent_db = hidden.answer["nuisance"]["sent_dbm"] or 0.0
    kind = truth.get("kind")
    flight = f"[{truth.get('receiver')}, flight {truth.get('flight')}]"
    return {
        "receiver_gain_offset": lambda: {"offset_db": truth["offset_db"]},
        "device_gain_offset": lambda: {"offset_db": truth["offset_db"]},
        "receiver_drift": lambda: _course(truth), "device_drift": lambda: _course(truth),
        "receiver_saturation": lambda: {"saturation_level": truth["saturation_db"] + sent_db},
        "noise_floor_censoring": lambda: {"floor": truth["floor_db"] + sent_db},
        "receiver_clock_offset": lambda: {"positions_late_by_s": truth["late_s"]},
        "antenna_pattern": lambda: (
            {"azimuth_deg": truth["azimuth_deg"], "beamwidth_deg": truth["beamwidth_deg"],
             "front_to_back_db": truth["front_to_back_db"], "tilt_deg": -truth["downtilt_deg"]}
            if kind == "sector" else
            {"tilt_deg": truth["tilt_deg"], "lean_azimuth_deg": truth["tilt_towards_deg"]}),
        "body_shadowing": lambda: {
            "body_depth_db": truth["depth_db"], "body_azimuth_deg": truth["direction_deg"],
            "body_elevation_deg": -truth["below_deg"],
            "body_width_deg": FULL_WIDTH * truth["width_deg"]},
        "foliage": lambda: {"x_m": truth["centre_m"][0], "y_m": truth["centre_m"][1]},
        "excess_attenuation": lambda: {"specific_attenuation_db_km": truth["per_km_db"]},
        "missing_obstacle": lambda: {"x_m": truth["centre_m"][0], "y_m": truth["centre_m"][1],
                                     "height_m": truth["height_m"]},
        "removed_obstacle": lambda: {"x_m": truth["centre_m"][0], "y_m": truth["centre_m"][1]},
        "device_position_error": lambda: {"x_m": truth["true_m"][0], "y_m": truth["true_m"][1]},
        "interference": lambda: {"x_m": truth["centre_m"][0], "y_m": truth["centre_m"][1]},
        "lock_loss": lambda: {"lost_share": truth["lost_share"],
                              "drop_db": truth.get("drop_db")},
        "faulty_flight": lambda: {f"offset_db{flight}": truth.get("offset_db", 0.0),
                                  f"added_noise_db{flight}": truth.get("noise_db")},
        "episode": lambda: {"loss_db": truth["loss_db"], "start_s": truth["start_s"],
                            "end_s": truth["end_s"]},
    }.get(truth["name"], dict)()


def _sizes(truth: dict, hidden: ForeignCase, detectable: list[dict]) -> Iterator[list]:
    """Yield the name of an effect, its size, and the least size that would have been named."""
    size = {"receiver_gain_offset": "offset_db", "device_gain_offset": "offset_db",
            "antenna_pattern": "front_to_back_db", "excess_attenuation": "per_km_db",
            "body_shadowing": "depth_db", "episode": "loss_db", "faulty_flight": "offset_db"
            }.get(truth["name"])
    value = truth.get(size or "")
    if truth["name"].endswith("_drift"):
        value = next(iter(_course(truth).values()))
    elif truth["name"] == "device_position_error":
        device = list(hidden.measurements.devices["device"]).index(truth["device"])
        written_m = hidden.measurements.devices[["x_m", "y_m"]].to_numpy(float)[device]
        value = float(np.linalg.norm(np.array(truth["true_m"][:2]) - written_m))
    least = [each["size"] for each in detectable if each["name"] == truth["name"]]
    if value is not None and least and least[0] is not None:
        yield [truth["name"], abs(value), least[0]]


def _course(truth: dict) -> dict[str, Any]:
    """Return the amplitude of a drift, which warming up gives relative to the warm state."""
    if truth["kind"] == "step":
        return {"step_db": truth["step_db"]}
    if truth["kind"] == "ageing":
        return {"ageing_db": truth["last_db"]}
    return {"warm_up_db": -truth["final_db"], "time_constant_s": truth["time_constant_s"]}


STUDIES = {"foreign": Study("What does close-loop say of foreign worlds?", close_foreign,
                            foreign_cases, foreign_table, foreign_figures, seeds=1)}
