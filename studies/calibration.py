"""Calibrate the posterior of effects: run the loop on cases, and fit the regression: `calibration`.

The cases are those of the foreign cities for calibration, with their maps and without; some of
those of the two traced cities whose maps are right within a survey's error (`tests/undeclared`),
the others of which are left for the study `hidden`; and campaigns over open ground.

    python -m studies calibration --resume      # rows: the loop on each case
    python -m studies.calibration           # rows -> radiotwin/closeloop/verdict/calibration.json
"""

import json
import warnings
from pathlib import Path

from radiotwin import close_loop
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict import posterior
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle
from radiotwin.io.files import atomic_path
from studies.calibration_fit import calibration_figures, calibration_table, fitted
from studies.foreign_roc import by_mistake_of_the_map, undeclared_besides
from studies.runner import RECORDS, Study, read_rows
from tests.undeclared.cases import FAMILIES, OUTSIDE, Case, case, stored
from tests.undeclared.foreign.cases import ForeignCase, foreign_case, names
from tests.undeclared.open_ground import CASES, OpenCase, open_case

KNOWN_SEEDS = (1, 2)  # of the traced cities' cases
PLACED = frozenset({"missing_obstacle", "removed_obstacle"})  # of these it is known what is right
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
    """Close the loop on a case; return the features of every candidate, and whether it is right."""
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
        undeclared |= undeclared_besides(nuisance) - PLACED
    if "shower" in right:  # see `studies.foreign`
        undeclared.add("episode")
    if not settings["map"]:
        undeclared |= PLACED
    return {
        "hidden": [[each["name"], each.get("in_catalogue", family not in OUTSIDE)]
                   for each in hidden.answer["effects"]],
        "open": sorted(undeclared - right),
        "named": [each.name for each in loop.after.whole.effects
                  if not each.is_declared],
        "candidates": [[*_row(score), score.name in right or _is_wrong_map(score, nuisance)]
                       for score in loop.found.log.trials if score.features],
        "steps": [[max([0.0, *(score.nats for score in loop.found.log.trials if score.features
                               and score.step == step.number)]),
                   step.best_unnamed_nats, step.rest_db, step.noise_db]
                  for step in loop.found.steps]}


def _case(family: str, number: str) -> Case | ForeignCase | OpenCase:
    if family == "open":
        return open_case(int(number))
    return case(family, int(number)) if number else foreign_case(family)


def _is_wrong_map(score: Trial, nuisance: dict | None) -> bool:
    """Return whether a candidate names a true error of the map that the case did not hide."""
    if isinstance(score.params, MissingObstacle.Params):
        x_m, y_m = score.params.box.x_m, score.params.box.y_m
    elif isinstance(score.params, RemovedObstacle.Params):
        x_m, y_m, _ = score.params.centre_m
    else:
        return False
    return nuisance is not None and by_mistake_of_the_map(score.name, x_m, y_m, nuisance)


def _row(score: Trial) -> list:
    return [score.step, score.name, score.passed, list(score.features),
            score.gain_by_fold.round(2).tolist()]


def main() -> None:
    """Fit the regressions to the rows and write `calibration.json`."""
    content = fitted(read_rows("calibration", RECORDS))
    with atomic_path(PATH) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {PATH}: {content['cases']} cases, {content['candidates']} candidates")


STUDIES = {"calibration": Study("What is evidence worth?", candidates_of, calibration_cases,
                                calibration_table, calibration_figures, seeds=1)}

if __name__ == "__main__":
    main()
