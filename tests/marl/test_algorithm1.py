"""Algorithm 1 on the small scene: what it measures, what it knows, and that a stopped run ends as an unbroken one."""

from dataclasses import replace

import numpy as np
import pytest

import marl.algorithm1
import marl.qmix
import marl.replanning
from marl.algorithm1 import (
    Campaign,
    Reality,
    location_errors_m,
    run_algorithm,
)
from marl.flights import evaluate
from marl.heuristics import HeuristicPolicy, waypoint_actions
from marl.mission import Known, make_mission
from marl.planner import PlanPolicy
from marl.qmix import Trainer
from marl.settings import PRESETS, RunSettings
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.twin import fit_twin

LEARNER = PRESETS["fast"].model_copy(update={"parallel": 10, "batch": 8, "replay": 60, "federate_every": 20,
                                             "selection_flights": 8})


def run_settings(**changes) -> RunSettings:
    return RunSettings(truth="segmented", real_episodes=3, episodes=40, flights=8, planner_iterations=500, **changes)


def execute(scene, run, folder=None, resume=False, on_round=lambda rows, blocks: None):
    return run_algorithm(run, LEARNER, scene, segmented_truth(scene), folder, resume, on_round, lambda *_: None)


def without_times(rows):
    return [{name: repr(value) for name, value in row.items() if not name.endswith("_s")} for row in rows]


@pytest.fixture(scope="module")
def reality(small_scene):
    """One random flight in the statistical truth, without noise of the receivers."""
    world = Reality(small_scene, segmented_truth(small_scene), "matching", 0.0, 5)
    world.fly(HeuristicPolicy("random", np.random.default_rng(0)), Known.anchors(small_scene))
    return world


def test_a_real_flight_measures_every_device_in_every_slot_until_it_lands(small_scene, reality):
    measured = reality.measurements()
    table = measured.table
    for uav in small_scene.config.uavs:
        own = table[table["receiver"] == uav.uav]
        first = own.iloc[0]
        assert (first["receiver_x_m"], first["receiver_y_m"], first["receiver_z_m"]) == (
            uav.start_x_m, uav.start_y_m, uav.altitude_m)
        slots = len(own) // len(small_scene.config.devices)
        positions = own[["receiver_x_m", "receiver_y_m"]].to_numpy()[::len(small_scene.config.devices)]
        moves = int((np.abs(np.diff(positions, axis=0)).sum(axis=1) > 0).sum())
        # The last slot is flown, and what it leads to is no longer measured.
        assert moves + 0.5 * (slots - 1 - moves) <= uav.battery
        assert moves + 0.5 * (slots - moves) >= uav.battery - 1
    assert measured.devices.loc[measured.devices["role"] == "unknown", ["x_m", "y_m"]].isna().all().all()


def test_measurements_are_the_gains_that_the_mission_drew(small_scene, reality):
    table = reality.measurements().table
    truth = segmented_truth(small_scene)
    index = truth.lattice.index_of(table[["receiver_x_m", "receiver_y_m", "receiver_z_m"]].to_numpy())
    rows = [truth.devices.index(name) for name in table["device"]]
    flat = truth.gain_db.reshape(len(truth.devices), -1)
    sigma_db = truth.dataset["sigma_db"].values.reshape(flat.shape)
    deviation = (table["gain_db"] - flat[rows, index]) / sigma_db[rows, index]
    assert len(table) > 500 and table["gain_db"].notna().all()
    assert abs(deviation.mean()) < 0.15 and abs(deviation.std() - 1) < 0.1


def test_below_sensitivity_is_blank(small_scene):
    radio = small_scene.config.radio.model_copy(update={"sensitivity_dbm": -80.0})
    deaf = type(small_scene)(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    world = Reality(deaf, segmented_truth(deaf), "matching", 0.0, 5)
    world.fly(HeuristicPolicy("random", np.random.default_rng(0)), Known.anchors(deaf))
    level_db = world.measurements().level_db
    assert np.isnan(level_db).any() and np.nanmin(level_db) >= -80.0


def test_positions_of_unknown_devices_come_from_measurements_only(small_scene, reality):
    known = Known.of(fit_twin(reality.measurements(), small_scene, model="segmented_nn", seed=0).devices)
    errors_m = location_errors_m(small_scene, known)
    assert len(errors_m) == sum(d.role == "unknown" for d in small_scene.config.devices)
    assert (errors_m > 0).all() and np.median(errors_m) < 25
    assert np.isnan(location_errors_m(small_scene, Known.anchors(small_scene))).all()


@pytest.mark.parametrize("algorithm", ["qmix", "planner", "belief"])
def test_a_stopped_run_ends_as_an_unbroken_one(small_scene, tmp_path, algorithm, monkeypatch):
    monkeypatch.setattr(marl.replanning, "ITERATIONS", 20)
    run = run_settings(algorithm=algorithm, twin="log-distance", seed=1).model_copy(update={
        "real_episodes": 2, "episodes": 20, "planner_iterations": 100, "flights": 2})
    unbroken = execute(small_scene, run)

    class Killed(Exception):
        pass

    def kill_after_one(rows, blocks):
        raise Killed

    with pytest.raises(Killed):
        execute(small_scene, run, tmp_path, on_round=kill_after_one)
    resumed = execute(small_scene, run, tmp_path, resume=True)
    assert without_times(resumed.rows) == without_times(unbroken.rows)
    assert resumed.blocks == unbroken.blocks
    np.testing.assert_array_equal(resumed.flights.action, unbroken.flights.action)
    assert resumed.known == unbroken.known


def test_a_perfect_twin_counts_every_episode_as_real_and_every_flight_that_chooses_the_policy(small_scene):
    rows = execute(small_scene, run_settings(algorithm="qmix", twin="truth")).rows
    # 40 of training a round and 8 after each 20 of them; from the second round on the best so far flies once more.
    assert [row["real_episodes"] for row in rows] == [40 + 16, 80 + 40, 120 + 64]
    assert [(row["measuring_flights"], row["training_flights"], row["selection_flights"]) for row in rows] == [
        (0, 40, 16), (0, 80, 40), (0, 120, 64)]
    assert [row["evaluation_flights"] for row in rows] == [8, 16, 24]
    assert all(np.isnan(row["twin_ratio"]) for row in rows)


def test_training_happens_in_the_twins_map_with_its_positions_and_judging_in_the_truths(small_scene, monkeypatch):
    trained, chosen, judged = [], [], []
    enter = Trainer.enter

    def spy_enter(self, mission):
        trained.append(mission)
        enter(self, mission)

    def spy_on(log):
        def spy(mission, policy, flights, rng):
            log.append(mission)
            return evaluate(mission, policy, flights, rng)
        return spy

    monkeypatch.setattr(Trainer, "enter", spy_enter)
    monkeypatch.setattr(marl.qmix, "evaluate", spy_on(chosen))
    monkeypatch.setattr(marl.algorithm1, "evaluate", spy_on(judged))
    outcome = execute(small_scene, run_settings(algorithm="qmix", twin="log-distance"))
    expected = make_mission(small_scene, outcome.twin.radio_map(small_scene), outcome.known)
    real = make_mission(small_scene, segmented_truth(small_scene), outcome.known)
    assert np.abs(expected.snr_db - real.snr_db).max() > 1
    for mission in (trained[-1], chosen[-1]):
        np.testing.assert_array_equal(mission.snr_db, expected.snr_db)
    for mission in trained + chosen:
        assert not np.array_equal(mission.snr_db, real.snr_db)
    np.testing.assert_array_equal(judged[-1].snr_db, real.snr_db)
    for mission in (trained[-1], judged[-1]):  # agents see estimates of unknown devices, here and there
        np.testing.assert_array_equal(mission.known_m, expected.known_m)
    off_m = np.abs(expected.known_m - small_scene.device_m[:, :2]).max(axis=1)
    assert ((off_m > 1e-9) == [device.role == "unknown" for device in small_scene.config.devices]).all()


def test_location_errors_are_the_twins_even_if_agents_see_true_positions(small_scene):
    outcome = execute(small_scene, run_settings(algorithm="greedy", twin="log-distance", privileged=True))
    assert outcome.rows[-1]["location_error_median_m"] > 0 and outcome.known == Known.truth(small_scene)


@pytest.mark.parametrize("measure, first_flight, is_first, planned", [
    ("policy", "waypoints", True, True), ("policy", "random", True, False),
    ("waypoints", "random", False, True), ("policy", "waypoints", False, False)])
def test_who_flies_a_real_flight(small_scene, measure, first_flight, is_first, planned):
    class Trained:
        def policy(self, rng):
            return "its own"

    campaign = Campaign(run_settings(measure=measure, first_flight=first_flight), small_scene, segmented_truth(small_scene))
    campaign.twin = None if is_first else "a twin"
    policy = campaign.measuring_policy(Trained(), np.random.default_rng(0))
    assert isinstance(policy, PlanPolicy) == planned
    assert planned or (isinstance(policy, HeuristicPolicy) if is_first else policy == "its own")


def test_receivers_err_anew_in_each_flight(small_scene):
    """In a truth of values, by what is asked for; the same plan is flown twice."""
    statistical = segmented_truth(small_scene)
    values = replace(statistical, dataset=statistical.dataset.drop_vars("sigma_db"))
    known, worlds = Known.anchors(small_scene), []
    for noise_db in (0.0, 3.0):
        world = Reality(small_scene, values, "matching", noise_db, 5)
        for _ in range(2):
            plan = waypoint_actions(small_scene, world.mission(known), np.random.default_rng(1))
            world.fly(PlanPolicy(plan), known)
        worlds.append([table["gain_db"].to_numpy() for table in world.tables])
    (exact, again), (first, second) = worlds
    np.testing.assert_array_equal(exact, again)
    errors_db = first - exact, second - exact
    for error_db in errors_db:
        known_db = error_db[np.isfinite(error_db)]
        assert known_db.std() == pytest.approx(3.0, rel=4 / np.sqrt(2 * len(known_db)))
    both = np.isfinite(errors_db).all(axis=0)
    assert abs(np.corrcoef(*(each[both] for each in errors_db))[0, 1]) < 0.2


def test_noise_that_was_asked_for_reaches_the_receivers(small_scene, monkeypatch):
    made = []
    monkeypatch.setattr(marl.algorithm1, "Reality", lambda *given: made.append(given) or Reality(*given))
    statistical = segmented_truth(small_scene)
    values = replace(statistical, dataset=statistical.dataset.drop_vars("sigma_db"))
    run = RunSettings(truth="segmented", twin="log-distance", algorithm="random", real_episodes=1, episodes=4, flights=2,
                      noise_db=3.0)
    for truth in (values, statistical):
        run_algorithm(run, LEARNER, small_scene, truth, None, False, lambda *_: None, lambda *_: None)
    assert [noise_db for *_, noise_db, _ in made] == [3.0, 0.0], "a statistical truth scatters by itself"


def test_errors_of_a_twin_last_as_long_as_its_residuals_say(small_scene):
    """Of a truth whose errors belong to places; or else they are drawn anew in every slot."""
    truth = segmented_truth(small_scene)
    x_m, y_m = np.meshgrid(truth.lattice.x_m, truth.lattice.y_m)
    waves_db = 5 * np.sin(2 * np.pi * x_m / 160) * np.sin(2 * np.pi * y_m / 160)
    waved = truth.dataset.drop_vars("sigma_db").assign(gain_db=truth.dataset["gain_db"] + waves_db)
    flown = fly_survey(small_scene, replace(truth, dataset=waved), flights=3, noise_db=0.5)
    twin = fit_twin(flown, small_scene, model="segmented_log_distance")
    for errors, is_lasting in (("fitted", True), ("slot", False)):
        campaign = Campaign(run_settings(twin_shadowing=errors), small_scene, truth)
        campaign.twin = twin
        assert (campaign.mission().shadowing_share > 0.3) == is_lasting
