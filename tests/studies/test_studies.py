"""What each study runs, on settings that take seconds, and the numbers of its tables."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marl.mission import Known, make_mission
from radiotwin.maps.survey import segmented_truth
from studies import (
    closeloop,
    closeloop_real,
    disturbances,
    learning,
    models,
    speed,
    twins,
)
from studies.runner import make_row, read_rows
from studies.tables import Curve, over_seeds, quantiles, read_frame, with_sd
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
def test_a_twin_is_judged_by_the_truth(small_scene):
    settings = {f"small-{model}": {"model": model, "survey_flights": [1, 3], "noise_db": 1.0}
                for model in ("segmented_nn", "log_distance", "kriging")}
    rows = rows_of(twins.judge_twin, small_scene, settings)
    curves = rows.set_index("name")["curve"]
    network, line = curves["small-segmented_nn"], curves["small-log_distance"]
    assert network["real_episodes"] == [1, 3] and network["links"][0] * 3 == network["links"][1]
    assert all(len(errors_m) == 4 for errors_m in network["location_errors_m"])
    assert network["map_rmse_db"][1] < 2 < line["map_rmse_db"][1]  # the truth is segmented
    assert "| kriging | 3 |" in twins.quality_table(rows) and set(twins.quality_figures(rows)) == {"quality"}


def test_training_in_a_twin_is_judged_in_the_truth(small_scene):
    base = twins.twin_cases(0)["rbm-nn"] | {"episodes": 100, "flights": 8, "survey_flights": 2,
                                            "planner_iterations": 500}
    rows = rows_of(twins.train_in, small_scene, {f"small-{name}": base | {"twin": name} for name in
                                                 ("segmented", "log-distance", "truth")})
    by_name = rows.set_index("name")
    assert by_name["fidelity"]["small-segmented"]["correlation"] > 0.95
    assert by_name["map_rmse_db"]["small-segmented"] < by_name["map_rmse_db"]["small-log-distance"]
    truth = by_name.loc["small-truth"]
    assert truth["plan_truth_ratio"] == pytest.approx(truth["plan_twin_ratio"], abs=0.05)
    assert truth["plan_truth_ratio"] > truth["trained_truth_ratio"] > 0  # a hundred episodes teach little
    assert "log-distance" in twins.twin_table(rows) and set(twins.twin_figures(rows)) == {"twin"}


def test_the_same_actions_collect_the_same_in_a_twin_without_error(small_scene):
    real = make_mission(small_scene, segmented_truth(small_scene), Known.truth(small_scene))
    silent = real._replace(sigma_db=np.zeros_like(real.sigma_db))
    same = twins.fidelity(silent, silent, 10, 0)
    assert same["correlation"] == pytest.approx(1) and same["device_correlation"] == pytest.approx(1)
    assert abs(same["bias"]) < 1e-9 and same["rmse"] < 1e-9
    weaker = twins.fidelity(silent, silent._replace(snr_db=silent.snr_db - 6), 10, 0)
    assert weaker["bias"] < -0.02 and weaker["rmse"] >= -weaker["bias"]


def test_every_method_flies_where_things_are_not_as_thought(small_scene):
    quick = {"episodes": 40, "flights": 6, "truths": 2, "planner_iterations": 200, "replan_iterations": 20}
    settings = {name.replace("rbm", "small"): {key: quick.get(key, value) for key, value in each.items()}
                for name, each in disturbances.pays_cases(0).items() if name.startswith("rbm-everything")}
    rows = rows_of(disturbances.fly_disturbed, small_scene, settings)
    assert len(rows) == 6 and all(len(ratios) == 6 for ratios in rows["ratios"])
    by_name = rows.set_index("name")
    assert by_name["curve"]["small-everything-policy"]["episodes"] == [40]
    table = disturbances.pays_table(rows)
    assert f"{np.mean(by_name['ratios']['small-everything-plan']):.3f}" in table and "| all three |" in table


def test_displaced_devices_are_on_free_ground_as_far_off_as_said(small_scene):
    moved = disturbances.displaced(small_scene, np.random.default_rng(0))
    off_m = np.linalg.norm(moved.device_m - small_scene.device_m, axis=1)
    low_m, high_m = disturbances.OFF_M
    assert (off_m >= low_m).all() and (off_m <= high_m).all()
    assert not moved.city.inside(moved.device_m).any()
    world = disturbances.make_world(small_scene, "positions", False, 3, np.random.default_rng(0))
    assert len(world.real) == 3 and not np.array_equal(world.real[0].snr_db, world.believed.snr_db)
    np.testing.assert_array_equal(world.real[0].known_m, world.believed.known_m)
    assert world.believed.uav_link_db[0] < world.believed.threshold_db


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


def test_the_tuning_table_says_what_differs_from_the_defaults_as_options():
    settings = learning.case("rdm", "traced", "qmix", measure="policy", td_lambda=0.6) | {"fly_again": True}
    assert learning.options(settings) == "`--measure policy --td-lambda 0.6 --fly-again true`"  # of version 0.1
    assert learning.options(learning.case("rdm", "traced", "qmix")) == "as it is"


def test_curves_are_means_over_seeds_and_say_what_a_ratio_takes():
    curve = over_seeds(pd.Series([{"real_episodes": [1, 2, 4], "truth_ratio": ratios}
                                  for ratios in ([0.2, 0.6, 0.5], [0.4, 0.8, 0.9])]))
    np.testing.assert_allclose(curve.mean, [0.3, 0.7, 0.7])
    np.testing.assert_allclose(curve.sd, np.array([0.1, 0.1, 0.2]) * 2**0.5)  # estimated from two
    assert curve.needed(0.5) == 2 and np.isnan(curve.needed(0.71))
    flat = Curve(np.array([1.0]), np.array([0.4]), np.zeros(1))
    assert learning.common_ratio({"fedqmix-nn": curve, "qmix-truth": flat}) == pytest.approx(0.38)
    assert with_sd([0.5]) == "0.500" and with_sd([]) == "–"


def test_a_device_without_estimate_counts_as_far_away():
    assert quantiles([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.8, 3.0, 0.0))
    median, most, worst, far = quantiles([1.0, 2.0, None, 150.0])
    assert (median, worst, far) == (76.0, np.inf, 0.5) and most == np.inf


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
