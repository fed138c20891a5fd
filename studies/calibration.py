"""What evidence is worth: the loop on cases for calibration, and the regression upon it.

The cases are those of the foreign cities for calibration, with their maps and without; some of
those of the two traced cities whose maps are right within a survey's error (`tests/undeclared`),
the others of which are left for the studies `hidden` and `null`; and campaigns over open ground.

    python -m studies calibration --resume      # rows: the loop on each case
    python -m studies.calibration               # rows -> radiotwin/closeloop/calibration.json
"""

import json
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize

from radiotwin import close_loop
from radiotwin.closeloop import posterior
from radiotwin.closeloop.scoring import CandidateScore
from radiotwin.files import atomic_path
from studies.foreign_roc import undeclared_besides
from studies.runner import RECORDS, Study, read_rows
from studies.tables import markdown
from tests.undeclared.cases import FAMILIES, OUTSIDE, Case, case, stored
from tests.undeclared.foreign.cases import ForeignCase, foreign_case, names
from tests.undeclared.open_ground import CASES, OpenCase, open_case

KNOWN_SEEDS = (1, 2)  # of the traced cities' cases
PHYSICS = ("wall_reflection", "diffraction")  # in every traced world
# Prior: log-odds rise with each feature but the last; few cases do not show otherwise.
MEAN, SD = (0.4, 0.3, 0.5, 0.1, 0.2, -0.5), (0.3, 0.3, 0.3, 0.3, 0.3, 0.5)
RISES = (True, True, True, True, True, False)
NAME_SD, NOTHING_SD = 1.0, 1.0  # of a name's own intercept, and of the weights of "nothing"
PATH = Path(posterior.__file__).with_name("calibration.json")


def calibration_cases(seed: int) -> dict[str, dict]:
    """Return all cases: `city00-w0-c0`, with `-no-map`, `foliage:1`, `open:7`; seed 0 only."""
    if seed:
        return {}
    known = [f"{family}:{number}" for number in KNOWN_SEEDS for family in (*FAMILIES, *OUTSIDE)
             if stored(family, number)]
    named = [*names("calibrate"), *known, *(f"open:{number}" for number in range(CASES))]
    return {name: {"case": name, "map": True} for name in named} | {
        f"{name}-no-map": {"case": name, "map": False} for name in names("calibrate")}


def candidates_of(seed: int, settings: dict) -> dict:
    """Close the loop on a case, and keep what every candidate's probability depends on."""
    family, _, number = settings["case"].partition(":")
    hidden = _case(family, number)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = hidden.scene if settings["map"] else None
        loop = close_loop(hidden.measurements, scene, seed=seed)
    right = {each["name"] for each in hidden.answer["effects"]}
    nuisance = hidden.answer.get("nuisance")  # of a foreign case
    undeclared = set(hidden.answer.get("besides", ()))  # of a campaign over open ground
    if nuisance:
        undeclared |= undeclared_besides(nuisance)
    if not settings["map"]:
        undeclared |= {"missing_obstacle", "removed_obstacle"}
    return {
        "hidden": [[each["name"], each.get("in_catalogue", family not in OUTSIDE)]
                   for each in hidden.answer["effects"]],
        "open": sorted(undeclared - right),
        "named": [each.effect.name for each in loop.after.whole.effects],
        "candidates": [[*_row(score), score.name in right] for score in loop.selection.scores
                       if score.features],
        "steps": [[max([0.0, *(score.nats for score in loop.selection.scores if score.features
                               and score.step == step.number)]),
                   step.best_unnamed, step.rest_db, step.noise_db]
                  for step in loop.selection.steps]}


def _case(family: str, number: str) -> Case | ForeignCase | OpenCase:
    if family == "open":
        return open_case(int(number))
    return case(family, int(number)) if number else foreign_case(family)


def _row(score: CandidateScore) -> list:
    return [score.step, score.name, score.passed, list(score.features),
            score.gain_by_fold.round(2).tolist(), round(score.p_value, 6)]


def usable(rows: list[dict]) -> pd.DataFrame:
    """Return candidates that passed and of which it is known whether they are right."""
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
    inputs = np.column_stack([np.arcsinh(steps[:, :2] / posterior.NATS),
                              np.log(np.maximum(steps[:, 2:], 0.1))])
    nothing = logistic(inputs, np.array([not each["hidden"] for each in without]),
                       np.zeros(4), np.full(4, NOTHING_SD), [(None, 0.0)] * 2 + [(None, None)] * 2)
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


def calibration_table(rows: pd.DataFrame) -> str:
    """Return how often a candidate that passed was right, by name."""
    table = usable([{"name": row.name, "results": {
        "candidates": row.candidates, "open": row.open}} for row in rows.itertuples()])
    lines = [[f"`{name}`", str(len(each)), str(int(each["right"].sum()))]
             for name, each in table.groupby("name")]
    return markdown(["candidate that held-out links support", "times", "right"], lines,
                    "Calibration", f" ({len(rows)} cases)")


def main() -> None:
    """Fit the regressions to the rows and write `calibration.json`."""
    content = fitted(read_rows("calibration", RECORDS))
    with atomic_path(PATH) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {PATH}: {content['cases']} cases, {content['candidates']} candidates")


STUDIES = {"calibration": Study("What is evidence worth?", candidates_of, calibration_cases,
                                calibration_table, seeds=1)}

if __name__ == "__main__":
    main()
