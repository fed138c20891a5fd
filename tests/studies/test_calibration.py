"""The regression that says what evidence is worth, on made-up candidates of which the truth is known."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.search.trials import Trial
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle
from studies import calibration, calibration_fit

WEIGHTS = np.array([0.5, 0.6, 0.1, -0.8, -0.3])


def rows(seed, cases=120):
    """Rows of the study: four candidates a case, right with log-odds of -2 + `WEIGHTS` · features."""
    rng, found = np.random.default_rng(seed), []
    for case in range(cases):
        features = rng.normal(1.0, 2.0, (4, 5))
        right = rng.random(4) < 1 / (1 + np.exp(2 - features @ WEIGHTS))
        candidates = [[0, name, True, values.tolist(), [1.0], bool(there)] for name, values, there in
                      zip(("foliage", "episode", "lock_loss", "interference"), features, right, strict=True)]
        found.append({"name": f"city{case // 5:02d}-w0-c{case % 5}", "results": {
            "candidates": candidates, "open": [], "steps": [[5.0, 3.0, 1.0, 2.0]],
            "hidden": [["foliage", True]] if case % 3 else []}})
    return found


def test_weights_come_back():
    fit = calibration_fit.fitted(rows(0, 400))["effect"]
    assert fit["weights"] == pytest.approx(WEIGHTS, abs=0.15) and fit["intercept"] == pytest.approx(-2.0, abs=0.4)


def test_signs_are_kept_whatever_the_cases_say():
    weights = calibration_fit.logistic(np.random.default_rng(1).normal(size=(50, 2)), np.arange(50) % 2 == 0,
                                       np.zeros(2), np.ones(2), [(0.0, None), (None, 0.0)])
    assert weights[1] >= 0 >= weights[2]


def test_probabilities_of_other_cities_are_as_often_right_as_they_say():
    table = calibration_fit.cross_validated(rows(2))
    assert table["probability"].between(0, 1).all() and len(table) == 480
    for _, each in table.groupby(pd.cut(table["probability"], [0, 0.2, 0.5, 0.8, 1])):
        spread = 3 * np.sqrt(0.25 / len(each))
        assert each["right"].mean() == pytest.approx(each["probability"].mean(), abs=spread)


def test_few_cities_give_a_sentence_and_no_figure():
    few = pd.DataFrame([{"name": each["name"], **each["results"]} for each in rows(4, 5)])
    assert "1, of at least 10" in calibration_fit.calibration_table(few)
    assert calibration_fit.calibration_figures(few) == {}


def test_what_is_open_and_what_held_out_links_do_not_support_is_left_out():
    (one,) = rows(3, 1)
    one["results"]["open"] = ["foliage"]
    one["results"]["candidates"][1][2] = False
    assert sorted(calibration_fit.usable([one])["name"]) == ["interference", "lock_loss"]


def test_a_building_is_right_where_the_map_is_wrong_and_nowhere_else():
    nuisance = {"unmapped": [[[0.0, 0.0], [20.0, 0.0], [20.0, 10.0]]], "gone": [[[100.0, 0.0], [120.0, 10.0]]]}
    new, gone = MissingObstacle.Params, RemovedObstacle.Params
    for params, right in ((new(box=(12.0, 9.0, 10.0, 10.0, 20.0, 0.0)), True), (new(box=(110.0, 5.0, 10.0, 10.0, 20.0, 0.0)), False),
                          (gone(building=0, centre_m=(110.0, 9.0, 20.0)), True), (gone(building=0, centre_m=(10.0, 5.0, 20.0)), False)):
        name = "missing_obstacle" if isinstance(params, new) else "removed_obstacle"
        assert calibration._is_wrong_map(Trial(name, params=params), nuisance) is right
        assert not calibration._is_wrong_map(Trial(name, params=params), None)
