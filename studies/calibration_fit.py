"""Logistic regression of effects' probabilities, with cross-validation over cities."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.special import expit

from marl.figures import COLOURS
from radiotwin.closeloop.verdict.criteria import NATS
from studies.tables import make_panels, markdown

PHYSICS = ("wall_reflection", "diffraction")  # in every traced world
# Prior: log-odds rise with each feature but the last two; few cases do not show otherwise.
MEAN, SD = (0.4, 0.5, 0.1, -0.5, -0.5), (0.3, 0.3, 0.3, 0.5, 0.5)
RISES = (True, True, True, False, False)
NAME_SD, NOTHING_SD = 1.0, 1.0  # of a name's own intercept, and of the weights of "nothing"
FOLDS = 10
THRESHOLDS = (0.2, 0.35, 0.5, 0.7, 0.9)
BINS = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0)


def usable(rows: list[dict]) -> pd.DataFrame:
    """Return the candidates that passed and whose truth is known."""
    found = [(row["name"], name, right, values) for row in rows
             for _, name, passed, values, *_, right in row["results"]["candidates"]
             if passed and name not in (*PHYSICS, *row["results"]["open"])]
    return pd.DataFrame(found, columns=["case", "name", "right", "features"])


def fitted(rows: list[dict]) -> dict:
    """Return the content of `calibration.json`.

    Args:
        rows: of the study, as its file has them.
    """
    table = usable(rows)
    labels = sorted(set(table["name"]))
    values = np.array(table["features"].tolist())
    own = table["name"].to_numpy()[:, None] == np.array(labels)
    p, q = values.shape[1], len(labels)
    effect = logistic(np.hstack([values, own]), table["right"].to_numpy(),
                      np.r_[MEAN, np.zeros(q)], np.r_[SD, np.full(q, NAME_SD)],
                      [(0.0, None) if rises else (None, 0.0) for rises in RISES]
                      + [(None, None)] * q)
    weights, shares = np.split(effect[1:], [p])
    without = [row["results"] for row in rows
               if not any(inside for _, inside in row["results"]["hidden"])]
    steps = np.array([each["steps"][0] for each in without])
    inputs = np.column_stack([np.arcsinh(steps[:, :2] / NATS),
                              np.log(np.maximum(steps[:, 2:], 0.1))])
    nothing = logistic(inputs, np.array([not each["hidden"] for each in without]),
                       np.zeros(4), np.full(4, NOTHING_SD), [(None, 0.0)] * 3 + [(None, None)])
    return {"effect": {"intercept": round(float(effect[0]), 3),
                       "weights": weights.round(3).tolist(),
                       "names": {name: round(float(share), 3)
                                 for name, share in zip(labels, shares, strict=True)}},
            "nothing": {"intercept": round(float(nothing[0]), 3),
                        "weights": nothing[1:].round(3).tolist()},
            "cases": len(rows), "candidates": len(table)}


def logistic(values: np.ndarray, right: np.ndarray, mean: np.ndarray, sd: np.ndarray,
             bounds: list[tuple[float | None, float | None]]) -> np.ndarray:
    """Return intercept and weights (1 + p,) of a logistic regression with normal priors.

    Args:
        values: (n, p).
        right: (n,) bool.
        mean: (p,) of the weights, before data.
        sd: (p,) standard deviations of them.
        bounds: p pairs: more evidence never makes a cause less probable.
    """
    sign = np.where(right, -1.0, 1.0)

    def loss(theta: np.ndarray) -> float:
        misfit = np.logaddexp(0.0, sign * (theta[0] + values @ theta[1:])).sum()
        return float(misfit + 0.5 * np.square((theta[1:] - mean) / sd).sum())

    return minimize(loss, np.r_[0.0, mean], bounds=[(None, None), *bounds]).x


def cross_validated(rows: list[dict]) -> pd.DataFrame:
    """Return `usable` with the `probability` by a regression on cases of other cities."""
    table = usable(rows)
    places = _places(rows)
    fold = dict(zip(np.random.default_rng(0).permutation(places),
                    np.arange(len(places)) % FOLDS, strict=True))
    probability = np.full(len(table), np.nan)
    for number in range(FOLDS):
        weights = fitted([row for row in rows if fold[_place(row["name"])] != number])["effect"]
        for i, (case, name, _, values) in enumerate(table.itertuples(index=False)):
            if fold[_place(case)] == number:
                log_odds = weights["intercept"] + weights["names"].get(name, 0.0)
                probability[i] = expit(log_odds + np.dot(weights["weights"], values))
    return table.assign(probability=probability)


def _places(rows: list[dict]) -> list[str]:
    return sorted({_place(row["name"]) for row in rows})


def _place(case: str) -> str:
    """Return the label of cases that are held out together: all of one city."""
    return case[:6] if case.startswith("city") else case.removesuffix("-no-map")


def _rows(rows: pd.DataFrame) -> list[dict]:
    return [{"name": row.name, "results": {key: getattr(row, key) for key in
                                           ("candidates", "open", "hidden", "steps")}}
            for row in rows.itertuples(index=False)]


def calibration_table(rows: pd.DataFrame) -> str:
    """Return tables of candidates over probability thresholds, and of right candidates by name.

    Of fewer than `FOLDS` cities only a sentence that says so.
    """
    cases = _rows(rows)
    if len(_places(cases)) < FOLDS:
        return f"Too few cities for a regression: {len(_places(cases))}, of at least {FOLDS}."
    table = cross_validated(cases)
    right = table["right"].to_numpy(dtype=bool)
    thresholds = []
    for least in THRESHOLDS:
        above = table["probability"].to_numpy() >= least
        thresholds.append([f"{least:g}", f"{(above & right).sum()} of {right.sum()}",
                           str((above & ~right).sum())])
    names = [[f"`{name}`", str(len(each)), str(int(each["right"].sum()))]
             for name, each in table.groupby("name")]
    return "\n\n".join([
        markdown(["probability of at least", "right candidates", "wrong ones"], thresholds,
                 "Named", f" ({len(rows)} cases; each city's by a regression on the others)"),
        markdown(["candidate that held-out links support", "times", "right"], names,
                 "By name")])


def calibration_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw the share of right candidates against their probability (reliability)."""
    cases = _rows(rows)
    if len(_places(cases)) < FOLDS:
        return {}
    table = cross_validated(cases)
    figure, (axes,) = make_panels(1, 1, 4.2)
    axes.plot([0, 1], [0, 1], color="black", linewidth=0.8)
    bins = np.digitize(table["probability"], BINS[1:-1])
    points = [(each["probability"].mean(), each["right"].mean(), len(each))
              for _, each in table.groupby(bins)]
    given, true, count = np.array(points, dtype=float).T
    error = np.sqrt(np.maximum(true * (1 - true), 0.25 / count) / count)
    axes.errorbar(given, true, error, marker="o", color=COLOURS[0], capsize=2)
    for x, y, n in points:
        axes.annotate(str(n), (x, y), xytext=(5, -10), textcoords="offset points", fontsize=8)
    axes.set(xlabel="probability, by cases of other cities", xlim=(-0.02, 1.02),
             ylabel="share of candidates that are right", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    return {"calibration": figure}
