"""ROC curves: how well a score separates cases with an effect from cases without."""

from typing import Any

import numpy as np
import pandas as pd

NEAR_M = 25.0  # of a building that the map lacks or shows by mistake: a box there is no false name
LIMITS_DIFFER_DB = 2.0  # between receivers: then a limit of its own is no false name
FALSE_ALARMS = (0.01, 0.05)
SCORES = ("probability", "heldout_nll_gain")
MIN_CASES = 3  # with an effect, for a line of its own
COLUMNS = ("step", "name", "heldout_nll_gain", "p_value", "heldout_rmse_db", "kept",
           "evidence_nats", "features", "probability")
"""What a row keeps of each candidate, in this order: criteria are calibrated on it."""


def undeclared_besides(nuisance: dict) -> set[str]:
    """Return names that are true of what no foreign campaign declares right: neither counts."""
    names = {"missing_obstacle": bool(nuisance["unmapped"]),
             "removed_obstacle": bool(nuisance["gone"]),
             "noise_floor_censoring": nuisance["declared"] == "wrong"
             or np.ptp(nuisance["limit_db"]) > LIMITS_DIFFER_DB}
    return {name for name, there in names.items() if there}


def by_mistake_of_the_map(name: str, x_m: float, y_m: float, nuisance: dict) -> bool:
    """Return whether a building is rightly said to be missing or gone, though nobody hid it.

    Args:
        name: of the effect.
        x_m: its centre [m].
        y_m: likewise [m].
        nuisance: of a foreign case.
    """
    wrong = {"missing_obstacle": "unmapped", "removed_obstacle": "gone"}.get(name)
    return wrong is not None and any(
        np.linalg.norm(0.5 * (np.min(corners_m, axis=0) + np.max(corners_m, axis=0))
                       - (x_m, y_m)) < NEAR_M for corners_m in nuisance[wrong])


def scored(rows: pd.DataFrame, score: str) -> pd.DataFrame:
    """Return whether each effect is in each case, and its best score there.

    Args:
        rows: of the study.
        score: column of its candidates.

    Returns:
        `name`, `there`, `score` (-inf: not a candidate); effects that are hidden somewhere, and of
        each case those of which it is known.
    """
    families = sorted({each["name"] for hidden in rows["hidden"] for each in hidden
                       if each["in_catalogue"]})
    found: list[tuple[str, bool, float]] = []
    for row in rows.itertuples():
        best = _best(row, score)
        hidden = {each["name"] for each in row.hidden}
        found += [(name, name in hidden, best.get(name, -np.inf)) for name in families
                  if name in hidden or name not in undeclared_besides(row.nuisance)]
    return pd.DataFrame(found, columns=["name", "there", "score"])


def _best(row: Any, score: str) -> dict[str, float]:
    best: dict[str, float] = {}
    for each in row.candidates:
        candidate = dict(zip(COLUMNS, each, strict=True))
        if candidate[score] is not None:
            best[candidate["name"]] = max(best.get(candidate["name"], -np.inf), candidate[score])
    return best


def curve(there: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shares of false alarms and of detections (t,) over all thresholds, the highest first.

    Args:
        there: (n,) bool, some of each.
        score: (n,) higher where it is likelier; -inf is never detected.
    """
    thresholds = np.unique(score[np.isfinite(score)])[::-1]
    above = score[None, :] >= thresholds[:, None]
    false, true = (np.r_[0.0, above[:, mine].mean(axis=1)] for mine in (~there, there))
    return false, true


def detection_rates(rows: pd.DataFrame) -> dict[str, tuple[float, ...]]:
    """Return shares of detections at `FALSE_ALARMS`, by each of `SCORES`; by effect and of all."""
    tables = [scored(rows, score) for score in SCORES]
    result: dict[str, tuple[float, ...]] = {}
    for name in ["all", *np.unique(tables[0]["name"])]:
        shares: list[float] = []
        for table in tables:
            mine = table if name == "all" else table[table["name"] == name]
            there = mine["there"].to_numpy(dtype=bool)
            if there.sum() >= MIN_CASES and not there.all():
                false, true = curve(there, mine["score"].to_numpy())
                shares += [float(true[false <= most].max()) for most in FALSE_ALARMS]
        if shares:
            result[str(name)] = tuple(shares)
    return result
