"""The kinds of runs, and the numbers of tables."""

import json
from pathlib import Path

import numpy as np
import pytest

from marl.experiments import earlier, tables
from marl.experiments.__main__ import main
from marl.experiments.closeloop import closeloop_table
from marl.experiments.disturbances import OFF_M, displaced, make_world
from marl.experiments.records import Run, filled, plain, write_record
from marl.experiments.studies import STUDIES, learning
from marl.experiments.summaries import Curve, over_seeds, quantiles
from marl.experiments.twins import fidelity
from marl.mission import Known, make_mission
from radiotwin.survey import segmented_truth

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def records(folder):
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}


def test_a_twin_is_judged_by_the_truth(small_scene, tmp_path):
    words = ["--seeds", "1", "--scenes", str(small_scene.folder), "--out", str(tmp_path), "--set", "truth=segmented"]
    assert main(["quality", *words, "--set", "survey_flights=1,3", "--only", "segmented,log,kriging"]) == 0
    found = records(tmp_path / "quality")
    network, line = (found[f"small-{name}-s0"]["curve"] for name in ("segmented_nn", "log_distance"))
    assert [row["real_episodes"] for row in network] == [1, 3] and network[0]["links"] * 3 == network[1]["links"]
    assert all(len(row["location_errors_m"]) == 4 for row in network)
    assert network[1]["map_rmse_db"] < 2 < line[1]["map_rmse_db"]  # the truth is segmented
    assert "| kriging | 3 |" in (tmp_path / "quality.md").read_text()
    assert (tmp_path / "figures" / "quality.png").is_file()


def test_training_in_a_twin_is_judged_in_the_truth(small_scene, tmp_path):
    words = ["--seeds", "1", "--scenes", str(small_scene.folder), "--out", str(tmp_path), "--set", "truth=segmented"]
    assert main(["twin", *words, "--only", "small-segmented,truth,log", "--set", "episodes=100", "--set", "flights=8",
                 "--set", "survey_flights=2", "--set", "planner_iterations=500"]) == 0
    found = records(tmp_path / "twin")
    assert found["small-segmented-s0"]["fidelity"]["correlation"] > 0.95
    assert found["small-segmented-s0"]["map_rmse_db"] < found["small-log-distance-s0"]["map_rmse_db"]
    truth = found["small-truth-s0"]
    assert "fidelity" not in truth and truth["plan_truth_ratio"] == pytest.approx(truth["plan_twin_ratio"], abs=0.05)
    assert truth["plan_truth_ratio"] > truth["trained_truth_ratio"] > 0  # a hundred episodes teach little
    assert "log-distance" in (tmp_path / "twin.md").read_text() and (tmp_path / "figures" / "twin.png").is_file()


def test_the_same_actions_collect_the_same_in_a_twin_without_error(small_scene):
    real = make_mission(small_scene, segmented_truth(small_scene), Known.truth(small_scene))
    silent = real._replace(sigma_db=np.zeros_like(real.sigma_db))
    same = fidelity(silent, silent, 10, 0)
    assert same["correlation"] == pytest.approx(1) and same["device_correlation"] == pytest.approx(1)
    assert abs(same["bias"]) < 1e-9 and same["rmse"] < 1e-9
    weaker = fidelity(silent, silent._replace(snr_db=silent.snr_db - 6), 10, 0)
    assert weaker["bias"] < -0.02 and weaker["rmse"] >= -weaker["bias"]


def test_every_method_flies_where_things_are_not_as_thought(small_scene, tmp_path):
    assert main(["pays", "--seeds", "1", "--scenes", str(small_scene.folder), "--out", str(tmp_path), "--only",
                 "everything", "--set", "episodes=100", "--set", "flights=6", "--set", "truths=2", "--set",
                 "planner_iterations=500", "--set", "replan_iterations=50"]) == 0
    found = records(tmp_path / "pays")
    assert len(found) == 8 and all(len(record["ratios"]) == 6 for record in found.values())
    assert all(0 <= ratio <= 1 for record in found.values() for ratio in record["ratios"])
    assert [row["episodes"] for row in found["small-everything-policy-s0"]["curve"]] == [100]
    table = (tmp_path / "pays.md").read_text()
    assert f"{np.mean(found['small-everything-plan-s0']['ratios']):.3f}" in table and "| all three |" in table


def test_displaced_devices_stand_on_free_ground_as_far_off_as_said(small_scene):
    moved = displaced(small_scene, np.random.default_rng(0))
    off_m = np.linalg.norm(moved.device_m - small_scene.device_m, axis=1)
    assert (off_m >= OFF_M[0]).all() and (off_m <= OFF_M[1]).all()
    assert not moved.city.inside(moved.device_m).any()
    world = make_world(small_scene, "positions", False, 3, np.random.default_rng(0))
    assert len(world.real) == 3 and not np.array_equal(world.real[0].snr_db, world.believed.snr_db)
    np.testing.assert_array_equal(world.real[0].known_m, world.believed.known_m)
    assert world.believed.uav_link_db[0] < world.believed.threshold_db


def test_every_run_of_every_study_has_its_own_file():
    for name, study in STUDIES.items():
        if study.runs is not None:
            runs = study.runs(["rbm", "rdm"], 3)
            paths = [run.path(Path("out")) for run in runs]
            assert len(set(paths)) == len(runs) and {run.study for run in runs} == {name}
            assert {run.seed for run in runs} == {0, 1, 2}


BEFORE = {"first_flight": "random", "measure": "policy", "twin_shadowing": "slot"}  # before these were settings


def test_runs_of_the_benchmark_are_taken_where_they_flew_over_the_same_map(tmp_path):
    def qmix(scene, truth, seed, **run):
        return learning("curve", scene, truth, seed, "qmix", changes={"excursion_slots": 1.0}, **BEFORE, **run)

    run = qmix("rbm", "traced", 1)
    result, cpu_s, _, by = earlier.earlier_result(run, tmp_path)
    kept = json.loads((RESULTS / by["taken_from"]).read_text())["runs"][1]
    assert result["curve"] == kept["rows"] and cpu_s == kept["cpu_s"]
    assert by["version"] == kept["version"] and by["code"] is None
    assert earlier.earlier_result(qmix("rbm", "segmented", 1), tmp_path) is None
    of_the_paper = earlier.earlier_result(qmix("runs/paper_rbm", "segmented", 1), tmp_path)
    assert of_the_paper[3]["taken_from"] == "marl_rbm_segmented_qmix.json"
    assert earlier.earlier_result(qmix("rbm", "traced", 9), tmp_path) is None
    assert earlier.earlier_result(qmix("rbm", "traced", 1, episodes=801), tmp_path) is None
    assert earlier.earlier_result(learning("curve", "rbm", "traced", 1, "qmix"), tmp_path) is None
    planned = learning("curve", "rbm", "traced", 1, "planner", **BEFORE)
    assert earlier.earlier_result(planned, tmp_path) is not None


def test_settings_from_before_a_setting_existed_have_its_default():
    settings = learning("curve", "rbm", "traced", 0, "qmix").settings
    old = settings | {"run": {name: value for name, value in settings["run"].items() if name != "guide"}}
    assert filled(old) == settings


def test_runs_from_before_a_setting_existed_did_what_was_done_then_which_matters_where_something_is_measured():
    for twin, alike in (("nn", False), ("truth", True)):
        settings = learning("curve", "rbm", "traced", 0, "qmix", twin=twin).settings
        old = settings | {"run": {name: value for name, value in settings["run"].items() if name not in BEFORE}}
        assert filled(old) == filled(learning("curve", "rbm", "traced", 0, "qmix", twin=twin, **BEFORE).settings)
        assert (filled(old) == filled(settings)) == alike


def test_learners_from_before_excursions_made_none():
    settings = learning("curve", "rbm", "traced", 0, "qmix", changes={"excursion_slots": 1.0}).settings
    old = settings | {"learner": {name: value for name, value in settings["learner"].items()
                                  if name != "excursion_slots"}}
    assert filled(old) == settings != filled(learning("curve", "rbm", "traced", 0, "qmix").settings)


def test_the_tuning_table_says_what_differs_from_the_defaults_as_options():
    run = learning("tuning", "rdm", "traced", 0, "qmix", measure="policy",
                   changes={"td_lambda": 0.6})
    assert tables.options(run.settings) == "`--measure policy --td-lambda 0.6`"
    assert tables.options(learning("tuning", "rdm", "traced", 0, "qmix").settings) == "as it is"


def test_a_record_has_only_what_json_has(tmp_path):
    assert plain({1: (np.float32(0.123456), np.nan, np.int64(3), np.bool_(True)), "a": np.array([np.inf, 2])}) == \
        {"1": [0.1235, None, 3, True], "a": [None, 2]}
    run = Run("study", "name", "kind", {"a": 1}, 0)
    write_record(run, tmp_path, {"curve": [{"x": np.nan}]}, 1.26, 2.0)
    record = json.loads(run.path(tmp_path).read_text())
    assert record["curve"] == [{"x": None}] and record["cpu_s"] == 1.3 and record["settings"] == {"a": 1}


def test_curves_are_means_over_seeds_and_say_what_a_ratio_takes():
    rows = [{"curve": [{"real_episodes": x, "truth_ratio": y} for x, y in zip((1, 2, 4), ratios)]}
            for ratios in ((0.2, 0.6, 0.5), (0.4, 0.8, 0.9))]
    curve = over_seeds(rows)
    np.testing.assert_allclose(curve.mean, [0.3, 0.7, 0.7])
    np.testing.assert_allclose(curve.spread, np.array([0.1, 0.1, 0.2]) * 2**0.5)  # estimated from two
    assert curve.needed(0.5) == 2 and np.isnan(curve.needed(0.71)) and curve.seeds == 2
    flat = Curve(np.array([1.0]), np.array([0.4]), np.zeros(1), 1)
    assert tables.common_ratio({"fedqmix-nn": curve, "qmix-truth": flat}) == pytest.approx(0.38)


def test_a_device_without_estimate_counts_as_far_away():
    assert quantiles([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.8, 3.0, 0.0))
    median, most, worst, far = quantiles([1.0, 2.0, None, 150.0])
    assert (median, worst, far) == (76.0, np.inf, 0.5) and most == np.inf


def test_the_table_of_close_loop_has_every_case_and_both_ends():
    table = closeloop_table(RESULTS)
    cases = json.loads((RESULTS / "closeloop_undeclared.json").read_text())
    for name, case in cases.items():
        family, seed = name.split(":")
        line = next(line for line in table.splitlines() if line.startswith(f"| `{family}` | {seed} |"))
        assert f"| {case['before']['rmse_db']:.2f} | {case['after']['rmse_db']:.2f} | " in line
    assert "`duke_cbrs`" in table and "verdict `none` in 20 of 20" in table
