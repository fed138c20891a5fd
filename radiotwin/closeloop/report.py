"""What the loop found as `closeloop.json`: everything that the page and the terminal show."""

import json
from pathlib import Path

import numpy as np

from radiotwin import __version__
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.search import Model
from radiotwin.files import atomic_path

SCHEMA = "radiotwin.closeloop/1"


def make_report(loop: Loop) -> dict:
    """The content of `closeloop.json`; numbers that are not known are null."""
    kept = [entry for entry in loop.search.log if entry.kept]
    effects = [{"name": entry.name, "variant": part.effect.variant, "rank": rank, "setting": part.setting,
                "parameters": {name: vars(parameter) for name, parameter in parameters.items()},
                "confused_with": list(part.effect.confused_with),
                "evidence": {"heldout_nll_gain": entry.nll_gain, "p_value": entry.p_value}}
               for rank, (entry, part, parameters) in enumerate(
                   zip(kept, loop.after.whole.parts, loop.parameters()), start=1)]
    candidates = [{"name": entry.name, "step": entry.step + 1, "heldout_rmse_db": entry.rmse_db,
                   "heldout_nll_gain": entry.nll_gain, "p_value": entry.p_value, "kept": entry.kept,
                   "reason": entry.reason} for entry in loop.search.log]
    records = loop.after.whole.records
    error = {"before": scores(loop.before), "after": scores(loop.after), "noise_floor_db": loop.noise_floor_db}
    error |= {f"by_{name}": {label: {"before": scores(loop.before, rows), "after": scores(loop.after, rows)}
                             for label, rows in groups.items()} for name, groups in _groups(records).items()}
    remaining = loop.remaining
    return _clean({
        "schema": SCHEMA, "radiotwin_version": __version__, "base": loop.base, "verdict": loop.verdict,
        "effects": effects, "candidates": candidates,
        "heldout": {"by": loop.folds.by, "folds": loop.folds.count,
                    "n": int(np.isfinite(loop.after.held_out_nll()).sum())},
        "error": error, "baselines": {name: {"rmse_db": value} for name, value in loop.baselines.items()},
        "structure_before": [vars(driver) for driver in loop.drivers_before],
        "remaining": {"structured": bool(remaining), "drivers": [vars(driver) for driver in remaining]},
        "remarks": records.remarks})


def scores(model: Model, rows: np.ndarray | None = None) -> dict[str, float]:
    """Held-out errors of links (all, or those of a mask): mean, standard deviation, correlation, RMSE, MAE [dB] of
    detected ones, and mean negative log-likelihood of all [nats]."""
    level_db, mean_db = model.whole.records.level_db, model.held_out_mean_db()
    rows = np.ones(len(level_db), dtype=bool) if rows is None else rows
    seen = rows & np.isfinite(level_db) & np.isfinite(mean_db)
    nll = model.held_out_nll()[rows]
    if not seen.any():
        return {"n": 0, "bias_db": np.nan, "std_db": np.nan, "correlation": np.nan, "rmse_db": np.nan,
                "mae_db": np.nan, "nll": np.nan}
    error = (level_db - mean_db)[seen]
    alike = np.std(level_db[seen]) == 0 or np.std(mean_db[seen]) == 0
    return {"n": int(seen.sum()), "bias_db": float(error.mean()), "std_db": float(error.std()),
            "correlation": np.nan if alike else float(np.corrcoef(level_db[seen], mean_db[seen])[0, 1]),
            "rmse_db": float(np.sqrt((error**2).mean())), "mae_db": float(np.abs(error).mean()),
            "nll": float(np.nanmean(nll)) if np.isfinite(nll).any() else np.nan}


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
