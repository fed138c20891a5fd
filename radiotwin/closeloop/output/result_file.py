"""Make, write and read `closeloop.json`, the result of a loop that page and terminal show."""

from __future__ import annotations

import json
from collections.abc import Iterable, Set
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin import __version__
from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.output.result_schema import ReportRecord
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.scan import Anomaly
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import LIKELY
from radiotwin.closeloop.verdict.posterior import Step
from radiotwin.closeloop.verdict.sensitivity import Detectable
from radiotwin.effects.base import Effect
from radiotwin.effects.params import Parameter
from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import MAD_SD
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import read_record, validated
from radiotwin.links import Links
from radiotwin.links.sites import ReceiverDifference, receiver_differences
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING

AS_GOOD = 1.02  # ratio of RMSEs up to which one model is as good as another
# Names of the fitted baselines; all others are published laws.
_WORDS = {"log_distance": "the log-distance law", "segmented_log_distance": "the segmented law",
          "regression_kriging": "kriging", "extra_trees": "a tree ensemble (ExtraTrees)",
          "hist_gradient_boosting": "gradient boosting (HistGradientBoosting)"}
SCHEMA = "radiotwin.closeloop/3"
SCHEMA_NAMES = {"kriging": "regression_kriging"}  # channel models that the schema names otherwise
MIN_PART, AS_LARGE = 10, 0.5  # least links of a flight or octant; least share of a group's size
REMEDY = "run `radiotwin close-loop` again"
MAX_GROUPS = 100  # of more devices or receivers no single errors are listed
# Optional parts of a report.
ABSENT: dict[str, Any] = {"posterior": [], "detectable": [], "combination": [], "prediction": None,
                          "anomalies": [], "seen_from": [], "receivers_compared": []}
# Fields that interpolated shadowing does not have.
NOT_KNOWN: dict[str, Any] = {"size_db": None, "uses": [], "is_declared": False, "probability": None,
                             "anomalies": [], "places": []}


def compare_with_baselines(error: dict[str, Any],
                           baselines: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Compare the combination (the weighted prediction of all models) with the best baseline.

    Args:
        error: scores of `combined` and `after`, each with `n` and `rmse_db`.
        baselines: scores of the baselines by name.

    Returns:
        `best_baseline`, `best_baseline_rmse_db`, `combined_rmse_db`, and `advice`, a sentence;
        None if no baseline predicts as many links.
    """
    rmse_db = {name: each["rmse_db"] for name, each in baselines.items()
               if each["n"] == error["combined"]["n"]}
    combined_db = error["combined"]["rmse_db"]
    if not rmse_db or not error["combined"]["n"]:
        return None
    best = min(rmse_db, key=lambda name: rmse_db[name])
    words, best_db = _WORDS.get(best, best), rmse_db[best]
    links = f"all {error['combined']['n']:,} held-out links"
    if best_db <= AS_GOOD * combined_db:
        plain = "a plain regression" if best in _WORDS else "a published law"
        advice = (f"For prediction alone {plain} would do: {words} {best_db:.2f} dB, all that was "
                  f"learnt together {combined_db:.2f} dB, on {links}.")
    else:
        gain = 100 * (1 - combined_db / best_db)
        advice = (f"All that was learnt together predicts {links} to {combined_db:.2f} dB, "
                  f"{gain:.0f} % better than the best other model ({words} alone: "
                  f"{best_db:.2f} dB).")
    after_db = error["after"]["rmse_db"]
    if after_db is not None and after_db > AS_GOOD * best_db:
        advice += f" The base with all that was found is behind {words}: {after_db:.2f} dB."
    return {"best_baseline": best, "best_baseline_rmse_db": best_db,
            "combined_rmse_db": combined_db, "advice": advice}


def make_report(loop: Loop) -> dict[str, Any]:
    """Return the content of `closeloop.json` for a loop; unknown numbers are None."""
    kept = loop.found.log.kept
    named = [trial for trial in kept if trial.name != SHADOWING]
    effects = [each.record() | {
                "rank": rank, "uses": list(each.uses), "is_declared": each.is_declared,
                "parameters": {name: parameter.record() for name, parameter in parameters.items()},
                "size_db": size.record(), "places": _places(each, parameters, loop.after.links),
                "confused_with": list(each.confused_with),
                "indistinguishable_from": sorted({*trial.rivals,
                                                  *each.rivals(loop.after.links, parameters)}),
                "probability": trial.probability, "anomalies": explained,
                "evidence": {"heldout_nll_gain": trial.nll_gain,
                             "evidence_nats": trial.evidence_nats}}
               for rank, (trial, each, parameters, size, explained) in enumerate(
                   zip(named, loop.after.whole.effects, loop.parameters, loop.sizes_db,
                       explained_anomalies(loop), strict=True), start=1)]
    if loop.after.whole.shadowing:
        effects.append(_shadowing(kept[-1], loop.after, len(effects) + 1))
    candidates = [{"name": trial.name, "variant": trial.variant, "step": trial.step + 1,
                   "heldout_rmse_db": trial.rmse_db,
                   "heldout_nll_gain": trial.nll_gain, "kept": trial.kept,
                   "reason": trial.reason, "passed": trial.passed,
                   "evidence_nats": trial.evidence_nats, "features": list(trial.features),
                   "probability": trial.probability,
                   "devices": list(trial.devices), "receivers": list(trial.receivers)}
                  for trial in loop.found.log.trials]
    links = loop.after.links
    error: dict[str, Any] = {"before": scores(loop.before), "after": scores(loop.after),
                             "noise_floor_db": loop.noise_floor_db}
    both = np.isfinite(loop.before.on_map[0]) & np.isfinite(links.level_db)
    if error["before"]["n"] != error["after"]["n"]:  # a device could be located only afterwards
        error["after_same_links"] = scores(loop.after, both)
    learnable = loop.after.learnable
    if not learnable.all():
        error["learnable"] = {when: scores(model, both & learnable) for when, model in
                              (("before", loop.before), ("after", loop.after))}
    if loop.after.reads_quality:
        error["after_with_quality"] = _scores(links.level_db, loop.after.held_out_mean_db,
                                              loop.after.held_out_nll)
    for name, groups in _groups(links).items():
        error[f"by_{name}"] = {label: {"before": scores(loop.before, rows),
                                       "after": scores(loop.after, rows)}
                               for label, rows in groups.items()}
    predicted = loop.prediction
    error["combined"] = errors(links.level_db, predicted.reading_db) | {
        "in_90_percent_interval": predicted.coverage}
    error["map"] = errors(links.level_db, predicted.map_db)
    baselines = {SCHEMA_NAMES.get(name, name): errors(links.level_db, mean_db)
                 for name, mean_db in predicted.baselines.items()}
    combination = [{"name": SCHEMA_NAMES.get(name, name), "weight_near": near, "weight_far": far}
                   for name, (near, far) in predicted.combination.weights.items()]
    return for_json({
        "schema": SCHEMA, "radiotwin_version": __version__, "base": loop.base,
        "verdict": loop.verdict, "effects": effects, "candidates": candidates,
        "anomalies": [_anomaly(each) | {"same_over": constant_over(each, loop.before)}
                      for each in loop.found.anomalies],
        "posterior": [_step(each) for each in loop.found.steps],
        "detectable": [vars(each) for each in consistent_sizes(
            loop.detectable, {each["name"] for each in effects}, loop.found.steps)],
        "seen_from": [vars(each) for each in loop.seen_from],
        "receivers_compared": [_difference(each, links) for each in receiver_differences(links)],
        "heldout": {"by": loop.folds.by, "folds": loop.folds.count,
                    "n": int(np.isfinite(loop.after.held_out_nll).sum())},
        "error": error, "baselines": baselines, "combination": combination,
        "prediction": compare_with_baselines(error, baselines),
        "dependences_before": [vars(each) for each in loop.dependences_before],
        "remaining": {"structured": bool(loop.remaining),
                      "drivers": [vars(each) for each in loop.remaining]},
        "criteria": vars(loop.criteria), "notes": [*links.notes, *loop.found.notes]})


def consistent_sizes(found: Iterable[Detectable], named: Set[str],
             steps: Iterable[Step]) -> list[Detectable]:
    """Drop least detectable sizes that contradict the search.

    Dropped are those of named effects, and infinite ones of effects that any step of the search
    gave a probability of at least `LIKELY`.

    Args:
        found: least size from which each effect would have been named.
        named: names of the effects found.
        steps: summaries of the search with probabilities.
    """
    likely = {name for step in steps for name, each in step.probabilities.items()
              if each >= LIKELY}
    return [each for each in found if each.name not in named
            and (np.isfinite(each.size) or each.name not in likely)]


def scores(model: CrossFit, rows: np.ndarray | None = None) -> dict[str, float]:
    """Return the held-out errors of a model used as a map, on a mask (n,) of links (None: all).

    Returns:
        those of `errors`, and `nll`, mean negative log-likelihood of detected and blank links
        [nats].
    """
    rows = np.ones(len(model.index), dtype=bool) if rows is None else rows
    return _scores(model.links.level_db[rows], *(each[rows] for each in model.on_map))


def _scores(level_db: np.ndarray, mean_db: np.ndarray, nll: np.ndarray) -> dict[str, float]:
    """Return `errors` of levels (n,) [dB], and the mean of negative log-likelihoods (n,) [nats]."""
    mean_nll = float(np.nanmean(nll)) if np.isfinite(nll).any() else np.nan
    return errors(level_db, mean_db) | {"nll": mean_nll}


def errors(level_db: np.ndarray, mean_db: np.ndarray) -> dict[str, float]:
    """Return error statistics of the detected links that have a prediction.

    Args:
        level_db: (n,) measured level [dB]; NaN = not detected.
        mean_db: (n,) predicted level [dB]; NaN = not predicted.

    Returns:
        `n` links, `bias_db` (mean of predicted minus measured), `std_db`, `rmse_db`, `mae_db`, and
        `correlation` of measured and predicted levels.
    """
    seen = np.isfinite(level_db) & np.isfinite(mean_db)
    if not seen.any():
        names = ("bias_db", "std_db", "correlation", "rmse_db", "mae_db")
        return {"n": 0} | dict.fromkeys(names, np.nan)
    level_db, mean_db = level_db[seen], mean_db[seen]
    error = mean_db - level_db
    constant = np.std(level_db) == 0 or np.std(mean_db) == 0
    correlation = np.nan if constant else float(np.corrcoef(level_db, mean_db)[0, 1])
    return {"n": int(seen.sum()), "bias_db": float(error.mean()), "std_db": float(error.std()),
            "correlation": correlation, "rmse_db": float(np.sqrt((error**2).mean())),
            "mae_db": float(np.abs(error).mean())}


def write_report(report: dict[str, Any], path: Path) -> None:
    """Write `closeloop.json` atomically."""
    with atomic_path(path) as temporary:
        text = json.dumps(report, indent=1, allow_nan=False)
        temporary.write_text(text, encoding="utf-8")


def read_report(path: Path) -> dict[str, Any]:
    """Read and check a `closeloop.json`; fields have the types of `ReportRecord`.

    Raises:
        BadInput: it cannot be read, has another version, or is damaged.
    """
    return check_report(read_record(path, "result of a close-loop (closeloop.json)"), path)


def check_report(report: dict[str, Any], source: object = "closeloop.json") -> dict[str, Any]:
    """Check the content of a `closeloop.json`, and return its known fields.

    Args:
        report: content of the file.
        source: name of the file, for messages.

    Raises:
        BadInput: another version, or a field is missing or has another type.
    """
    if report.get("schema") != SCHEMA:
        raise BadInput(f"{source}: schema is {repr(report.get('schema'))[:60]}, this version reads "
                       f"{SCHEMA!r}; make the run again")
    return validated(ReportRecord, ABSENT | report, source, REMEDY)


def _places(effect: Effect, parameters: Iterable[str], links: Links) -> list[dict[str, Any]]:
    """Return the places of an effect: its mark on the map, or the devices named in parameters."""
    named = {name.partition("[")[2].removesuffix("]") for name in parameters}
    mark = effect.mark(links)
    if mark is not None:
        return [{"x_m": float(mark.at_m[0]), "y_m": float(mark.at_m[1]),
                 "outline_m": None if mark.outline_m is None else mark.outline_m.tolist()}]
    if effect.of_receiver:  # a receiver has no fixed place
        return []
    return [{"device": name, "x_m": x_m, "y_m": y_m} for name, (x_m, y_m) in
            zip(links.device_names, links.device_m[:, :2].tolist(), strict=True)
            if name in named and np.isfinite(x_m)]


def _step(step: Step) -> dict[str, Any]:
    """Return the `StepRecord` of a step for `closeloop.json`, the most probable effect first."""
    ordered = sorted(step.probabilities.items(), key=lambda item: -item[1])
    return {"step": step.number + 1, "unnamed_nats": step.unnamed_nats, "rest_db": step.rest_db,
            "noise_db": step.noise_db,
            "probabilities": [{"name": name, "probability": each} for name, each in ordered]}


def _anomaly(found: Anomaly) -> dict[str, Any]:
    """Return the `AnomalyRecord` of an anomaly for `closeloop.json`, without `same_over`."""
    return {"family": found.family, "members": {key: list(names) for key, names in
                                                found.members.items()},
            "ranges": {key: list(ends) for key, ends in found.ranges.items()},
            "sight": found.sight, "statistic": found.statistic, "along": found.along,
            "size": found.size.record(),
            "probability": found.probability, "links": int(found.rows.sum()),
            "causes": [{"name": name, "probability": probability}
                       for name, probability in found.causes.items()]}


def constant_over(found: Anomaly, base: CrossFit) -> list[str]:
    """Return whether the level of a device or receiver deviates in all flights and directions.

    In each flight (or octant of azimuth) it must differ from the other links by at least half of
    the anomaly's size.

    Returns:
        `flight`, `direction`, both or neither; empty for other groups and other statistics.
    """
    links = base.links
    if found.statistic != "level" or found.family not in ("device", "receiver"):
        return []
    residual_db = links.level_db - base.held_out_mean_db
    angle_deg = links.azimuth_deg if found.family == "device" else links.body_azimuth_deg
    parts = {"flight": links.flight, "direction": np.floor(angle_deg / 45.0)}
    seen = np.isfinite(residual_db)
    peers_db = np.median(residual_db[seen & ~found.rows])
    holding = []
    for name, label in parts.items():
        rows = seen & found.rows & np.isfinite(label)
        _, index, count = np.unique(label[rows], return_inverse=True, return_counts=True)
        shifts_db = [np.median(residual_db[rows][index == number]) - peers_db
                     for number in np.flatnonzero(count >= MIN_PART)]
        if len(shifts_db) > 1 and (np.array(shifts_db) / found.size.value >= AS_LARGE).all():
            holding.append(name)
    return holding


def explained_anomalies(loop: Loop) -> list[list[int]]:
    """Return for each cause found the indices of the anomalies that it explains at least by half.

    The list is empty for descriptive and declared effects.
    """
    whole, found = loop.after.whole, []
    if not loop.found.anomalies:
        return [[] for _ in whole.effects]
    residual_db = whole.links.level_db - loop.before.held_out_mean_db
    for number, effect in enumerate(whole.effects):
        change_db = whole.readings().mean_db - whole.without(number).readings().mean_db
        scatter_sd_db = whole.model.terms[number].random_effect_sd_db
        shares = [_explained_share(each, residual_db, change_db, scatter_sd_db)
                  for each in loop.found.anomalies]
        found.append([index for index, share in enumerate(shares)
                      if share >= AS_LARGE and effect.is_cause and not effect.is_declared])
    return found


def _explained_share(anomaly: Anomaly, residual_db: np.ndarray, change_db: np.ndarray,
                     scatter_sd_db: np.ndarray | None) -> float:
    """Return the share of an anomaly that an effect explains; about 1 = all.

    For a level, this is the effect's change of the group relative to its peers. A scatter or curve
    is explained as far as the residual's spread shrinks when the change is subtracted, or as far as
    the effect adds scatter to the group's readings alone.
    """
    seen = np.isfinite(residual_db) & np.isfinite(change_db)
    rows, size = seen & anomaly.rows, anomaly.size.value
    if anomaly.statistic == "level":
        peers_db = np.median(change_db[seen & ~rows]) if (seen & ~rows).any() else 0.0
        return float((np.median(change_db[rows]) - peers_db) / size) if rows.any() else 0.0
    if anomaly.statistic not in ("scatter", "curve") or not rows.any():
        return 0.0
    if scatter_sd_db is not None:
        return float((scatter_sd_db[rows] > 0).mean() - (scatter_sd_db[seen & ~rows] > 0).mean())
    spread_db = [np.subtract(*np.quantile(each, [0.75, 0.25])) for each in
                 (residual_db[rows], (residual_db - change_db)[rows])]
    if anomaly.statistic == "curve":
        sd_db = 0.5 * MAD_SD * np.array(spread_db)
        return float(np.sqrt(max(sd_db[0] ** 2 - sd_db[1] ** 2, 0.0)) / size)
    return float(np.log(spread_db[0] / max(spread_db[1], 1e-9)) / np.log(size))


def _difference(found: ReceiverDifference, links: Links) -> dict[str, Any]:
    """Return the `ReceiverDifferenceRecord` of two receivers' mean difference of level [dB]."""
    value = Parameter(found.difference_db, found.low_db, found.high_db, "dB")
    return {"first": links.receiver_names[found.first],
            "second": links.receiver_names[found.second], "difference_db": value.record(),
            "pairs": found.pairs, "places": found.places}


def _shadowing(trial: Trial, model: CrossFit, rank: int) -> dict[str, Any]:
    """Return the entry of interpolated shadowing under `effects` of `closeloop.json`.

    Its parameters are the correlation length, the shares of the variance that are correlated over
    positions and common to a receiver, and the standard deviation; they have no intervals.
    """
    shadowing = model.whole.shadowing
    assert shadowing is not None
    field, relatives = shadowing.field, shadowing.relatives
    sd_db = shadowing.relative_sd * float(model.whole.scale_db.mean())
    numbers = {"length_m": (field.length_m, "m"), "share": (field.share, "of the variance"),
               "receiver_share": (field.kind_share, "of the variance"), "sigma_db": (sd_db, "dB")}
    if relatives is not None:
        share = float(np.mean(list(relatives.passed_on.values())))
        numbers["relatives_share"] = share, "of their residual"
    return {"name": trial.name, "variant": "", "rank": rank, "params": {},
            "parameters": {name: {"value": value, "low": np.nan, "high": np.nan, "unit": unit}
                           for name, (value, unit) in numbers.items()},
            "confused_with": [], "indistinguishable_from": [],
            "evidence": {"heldout_nll_gain": trial.nll_gain}} | NOT_KNOWN


def _groups(links: Links) -> dict[str, dict[str, np.ndarray]]:
    """Return masks (n,) of links by line of sight, device, … (if at most `MAX_GROUPS`), by name."""
    groups = {"los": {"los": links.los, "nlos": ~links.los}}
    for name, index, labels in (("device", links.device, links.device_names),
                                ("receiver", links.receiver, links.receiver_names),
                                ("flight", links.flight, links.flight_names)):
        members = np.unique(index)
        if len(members) <= MAX_GROUPS:
            groups[name] = {labels[member]: index == member for member in members}
    return groups


def for_json(value: Any) -> Any:
    """Convert NaN and inf to None and NumPy numbers to Python's, also within dicts and lists."""
    if isinstance(value, dict):
        return {name: for_json(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [for_json(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
