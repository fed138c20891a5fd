"""What the loop found as `closeloop.json`: everything that the page and the terminal show."""

import json
from pathlib import Path

import numpy as np

from radiotwin import __version__
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.search import Judged, Model
from radiotwin.files import atomic_path

SCHEMA = "radiotwin.closeloop/1"


def make_report(loop: Loop) -> dict:
    """The content of `closeloop.json`; numbers that are not known are null."""
    kept = [entry for entry in loop.search.log if entry.kept]
    effects = [{"name": entry.name, "variant": part.effect.variant, "rank": rank, "setting": part.setting,
                "parameters": {name: vars(parameter) for name, parameter in parameters.items()},
                "confused_with": list(part.effect.confused_with), "indistinguishable_from": rivals,
                "evidence": {"heldout_nll_gain": entry.nll_gain, "p_value": entry.p_value}}
               for rank, (entry, part, parameters, rivals) in enumerate(
                   zip(kept, loop.after.whole.parts, loop.parameters, loop.search.rivals), start=1)]
    if loop.after.shadowing:
        effects.append(_shadowing(kept[-1], loop.after, len(effects) + 1))
    candidates = [{"name": entry.name, "step": entry.step + 1, "heldout_rmse_db": entry.rmse_db,
                   "heldout_nll_gain": entry.nll_gain, "p_value": entry.p_value, "kept": entry.kept,
                   "reason": entry.reason} for entry in loop.search.log]
    records = loop.after.whole.records
    error = {"before": scores(loop.before), "after": scores(loop.after), "noise_floor_db": loop.noise_floor_db}
    error |= {f"by_{name}": {label: {"before": scores(loop.before, rows), "after": scores(loop.after, rows)}
                             for label, rows in groups.items()} for name, groups in _groups(records).items()}
    baselines = {name: errors(records.level_db, mean_db) for name, mean_db in loop.baselines.items()}
    remaining = loop.remaining
    return _clean({
        "schema": SCHEMA, "radiotwin_version": __version__, "base": loop.base, "verdict": loop.verdict,
        "effects": effects, "candidates": candidates,
        "heldout": {"by": loop.folds.by, "folds": loop.folds.count,
                    "n": int(np.isfinite(loop.after.held_out_nll).sum())},
        "error": error, "baselines": baselines,
        "structure_before": [vars(driver) for driver in loop.drivers_before],
        "remaining": {"structured": bool(remaining), "drivers": [vars(driver) for driver in remaining]},
        "remarks": records.remarks})


def scores(model: Model, rows: np.ndarray | None = None) -> dict[str, float]:
    """Held-out errors of links (all, or those of a mask), as `errors` gives them, and the mean negative log-likelihood
    of detected and blank ones [nats]."""
    level_db, mean_db, nll = model.whole.records.level_db, model.held_out_mean_db, model.held_out_nll
    rows = np.ones(len(level_db), dtype=bool) if rows is None else rows
    return errors(level_db[rows], mean_db[rows]) | {
        "nll": float(np.nanmean(nll[rows])) if np.isfinite(nll[rows]).any() else np.nan}


def errors(level_db: np.ndarray, mean_db: np.ndarray) -> dict[str, float]:
    """Measured minus expected levels (n,) of detected links: number, mean, standard deviation, RMSE, MAE [dB], and the
    correlation of the two."""
    seen = np.isfinite(level_db) & np.isfinite(mean_db)
    if not seen.any():
        return {"n": 0} | dict.fromkeys(("bias_db", "std_db", "correlation", "rmse_db", "mae_db"), np.nan)
    level_db, mean_db = level_db[seen], mean_db[seen]
    error = level_db - mean_db
    alike = np.std(level_db) == 0 or np.std(mean_db) == 0
    return {"n": int(seen.sum()), "bias_db": float(error.mean()), "std_db": float(error.std()),
            "correlation": np.nan if alike else float(np.corrcoef(level_db, mean_db)[0, 1]),
            "rmse_db": float(np.sqrt((error**2).mean())), "mae_db": float(np.abs(error).mean())}


def _shadowing(entry: Judged, model: Model, rank: int) -> dict:
    field, sigma = model.shadowing[0].field, model.shadowing[0].sigma
    numbers = {"length_m": (field.length_m, "m"), "share": (field.share, "of the variance"),
               "receiver_share": (field.kind_share, "of the variance"),
               "sigma_db": (sigma * float(model.fits[0].scale_db.mean()), "dB")}
    return {"name": entry.name, "variant": "", "rank": rank, "setting": {},
            "parameters": {name: {"value": value, "low": np.nan, "high": np.nan, "unit": unit}
                           for name, (value, unit) in numbers.items()},
            "confused_with": [], "indistinguishable_from": [],
            "evidence": {"heldout_nll_gain": entry.nll_gain, "p_value": entry.p_value}}


def write_report(report: dict, path: Path) -> None:
    """Write `closeloop.json`, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False), encoding="utf-8")


def _groups(records) -> dict[str, dict[str, np.ndarray]]:
    groups = {"los": {"los": records.los, "nlos": ~records.los}}
    for name, index, labels in (("device", records.device, records.device_names),
                                ("receiver", records.receiver, records.receiver_names),
                                ("flight", records.flight, records.flight_names)):
        members = np.unique(index)
        if len(members) <= 100:  # thousands of transmitter positions tell nothing one by one
            groups[name] = {labels[member]: index == member for member in members}
    return groups


def _clean(value):
    """For JSON: NaN as null, numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {name: _clean(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
