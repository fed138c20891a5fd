"""What each study runs, on settings that take seconds, and the numbers of its tables."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies import closeloop, closeloop_real, learning, models, speed
from studies.runner import make_row, read_rows
from studies.tables import Curve, over_seeds, read_frame, with_sd
from tests.undeclared.cases import case

RESULTS = Path(__file__).parents[2] / "docs" / "results"
QUICK = {"episodes": 40, "real_episodes": 2, "batch": 8, "replay": 40, "flights": 4, "selection_flights": 4,
         "planner_iterations": 200, "federate_every": 20}


def rows_of(run, scene, all_settings, seed=0):
    """Rows as a study keeps them, in the statistical truth of a small scene."""
    return read_frame([make_row("study", run, name, seed, settings | {"scene": str(scene.folder), "truth": "segmented"})
                       for name, settings in all_settings.items()])


@pytest.mark.slow
def test_algorithm_1_has_a_row_for_each_round_and_the_seed_decides(small_scene):
    settings = {f"small-segmented-{name}": {key: QUICK.get(key, value) for key, value in learning.case(
        "rbm", "segmented", **changes).items()} for name, changes in {
            "fedqmix-nn": {"algorithm": "fedqmix"}, "qmix-truth": {"algorithm": "qmix", "twin": "truth"},
            "greedy": {"algorithm": "greedy", "twin": "truth"}}.items()}
    rows = rows_of(learning.learn, small_scene, settings)
    curve = rows.set_index("name")["curve"]["small-segmented-fedqmix-nn"]
    assert curve["real_episodes"] == [1, 2] and 0 < curve["truth_ratio"][-1] <= 1
    del settings["small-segmented-fedqmix-nn"]
    ratios = [rows_of(learning.learn, small_scene, settings, seed)["curve"].str["truth_ratio"].tolist()
              for seed in (0, 1)]
    assert rows["curve"].str["truth_ratio"].tolist()[1:] == ratios[0] != ratios[1]
    table = learning.curve_table(rows)
    assert f"| model-aided FedQMIX | 2 | {curve['truth_ratio'][-1]:.3f} |" in table
    assert set(learning.curve_figures(rows)) == {"curve"}
    assert set(rows["flight"][0]) == {"cell", "battery", "assigned", "collected"}


@pytest.mark.slow
def test_channel_models_are_scored(small_scene):
    rows = rows_of(models.score_models, small_scene, {"small-segmented": models.models_cases(0)["rbm-segmented"]
                                                      | {"flights": 2}})
    assert "| `segmented_nn` | 1." in models.models_table(rows)


@pytest.mark.parametrize("part", ["environment", "update", "channel fit"])
def test_speeds_are_measured(small_scene, part, monkeypatch):
    monkeypatch.setattr(speed, "FLIGHTS", 4)
    rows = rows_of(speed.measure_speed, small_scene,
                   {part: speed.speed_cases(0)[part] | {"links": 1000, "predicted": 1000}})
    assert all(value > 0 for value in rows["quantities"][0].values())
    assert f"| {part} | " in speed.speed_table(rows)


def test_curves_are_means_over_seeds_and_say_what_a_ratio_takes():
    curve = over_seeds(pd.Series([{"real_episodes": [1, 2, 4], "truth_ratio": ratios}
                                  for ratios in ([0.2, 0.6, 0.5], [0.4, 0.8, 0.9])]))
    np.testing.assert_allclose(curve.mean, [0.3, 0.7, 0.7])
    np.testing.assert_allclose(curve.sd, np.array([0.1, 0.1, 0.2]) * 2**0.5)  # estimated from two
    assert curve.needed(0.5) == 2 and np.isnan(curve.needed(0.71))
    flat = Curve(np.array([1.0]), np.array([0.4]), np.zeros(1))
    assert learning.common_ratio({"fedqmix-nn": curve, "qmix-truth": flat}) == pytest.approx(0.38)
    assert with_sd([0.5]) == "0.500" and with_sd([]) == "–"


def test_what_was_recovered_follows_from_the_parameters_that_were_found():
    for row in read_rows("hidden", RESULTS):
        results = row["results"]
        effects = [{"name": name, "parameters": found} for name, found in
                   zip(results["named"], results["parameters"])]
        for effect, kept in zip(results["hidden"], results["recovered"]):
            found = {name: None if value != value else value for name, value in
                     closeloop.recovered(effect, effects).items()}
            assert found == {name: value if value is None else pytest.approx(value, abs=0.006)
                             for name, value in kept.items()}


@pytest.mark.parametrize("family", ["missing_obstacle", "removed_obstacle"])
def test_the_oracle_has_the_true_city(family):
    hidden = case(family, 0)
    (effect,) = hidden.answer["effects"]
    true = closeloop.with_true_city(hidden.scene, effect)
    where = np.array(effect["obstacles"][0]["centre_m"] if family == "missing_obstacle" else
                     np.mean(effect["corners_m"], axis=0))[None]
    heights_m = [float(scene.city.height_at(*where.T)[0]) for scene in (hidden.scene, true)]
    assert (heights_m[1] > heights_m[0] + 20) if family == "missing_obstacle" else (heights_m[1] < heights_m[0] - 3)


def test_permuted_levels_stay_with_their_device():
    measurements = case("nothing", 0).measurements
    permuted = closeloop_real.permuted(measurements, 0)
    assert not permuted.table["gain_db"].equals(measurements.table["gain_db"])
    before, after = (each.table.groupby("device")["gain_db"].apply(lambda levels: sorted(levels.dropna()))
                     for each in (measurements, permuted))
    assert before.equals(after)
