"""Comparisons: the arithmetic of the tables, and that no model is scored on links that it has seen."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links.measurements import Measurements
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.report import write_comparison_folder
from radiotwin.report.comparison import _judge_also
from radiotwin.scene import Scene
from radiotwin.twin import fit_twin
from radiotwin.twin.compare import compare_models, predict, score_map, split_flights


@pytest.fixture(scope="module")
def truth(small_scene):
    return segmented_truth(small_scene)


@pytest.fixture(scope="module")
def flown(small_scene, truth):
    return fly_survey(small_scene, truth, flights=3, pattern="random-waypoint", seed=0, noise_db=0.0)


@pytest.fixture(scope="module")
def compare(small_scene, truth, flown):
    return partial(compare_models, *split_flights(flown, 1), small_scene, truth, seed=0,
                   models=("log_distance", "segmented_log_distance", "kriging"))


@pytest.fixture(scope="module")
def comparison(compare):
    return compare()


def texts(comparison):
    return [table.to_csv() for table in (comparison.scores, comparison.locations, comparison.predictions)]


def test_the_last_flights_are_held_out_whole(flown):
    train, test = split_flights(flown, 2)
    assert train.flights == ["f0"] and test.flights == ["f1", "f2"]
    assert len(train.table) + len(test.table) == len(flown.table)


@pytest.mark.parametrize(("held_out", "message"), [(0, "at least 1"), (3, "at least 4 are needed")])
def test_too_few_flights(flown, held_out, message):
    with pytest.raises(BadInput, match=message):
        split_flights(flown, held_out)


def test_scores_are_what_the_predictions_say(comparison):
    links = comparison.predictions
    for model in ("log_distance", "segmented_log_distance"):
        for name, mask in (("all", slice(None)), ("LoS", links["los"] == 1),  # noqa: B007 - in the query below
                           ("NLoS", links["los"] == 0)):
            error_db = (links[model] - links["measured_db"])[mask].dropna()
            row = comparison.scores.query("model == @model and links == @name and positions == 'estimated' "
                                          "and against == 'held-out flights'").iloc[0]
            assert row["n"] == len(error_db)
            assert row["rmse_db"] == pytest.approx(np.sqrt((error_db**2).mean()))
            assert row["mae_db"] == pytest.approx(error_db.abs().mean())
            assert row["bias_db"] == pytest.approx(error_db.mean())


def test_location_errors_are_distances(comparison, small_scene):
    true_m = {d.device: (d.x_m, d.y_m) for d in small_scene.config.devices}
    for row in comparison.locations.itertuples():
        assert row.error_m == pytest.approx(np.hypot(*np.subtract((row.x_m, row.y_m), true_m[row.device])))
    summary = comparison.location_summary().set_index("model")
    errors = comparison.locations.query("model == 'log_distance'")["error_m"]
    assert summary.loc["log_distance", "worst_m"] == errors.max()
    assert summary.loc["log_distance", "median_m"] == errors.median()
    lost = dataclasses.replace(comparison, locations=comparison.locations.assign(error_m=[
        np.nan, *comparison.locations["error_m"][1:]]))
    model = comparison.locations["model"].iloc[0]
    fewer, all_of_them = (each.location_summary().set_index("model").loc[model, "devices"] for each in (lost, comparison))
    assert fewer == all_of_them - 1


def test_a_map_against_itself_has_no_error_and_a_shifted_one_has_its_shift(truth):
    shifted = dataclasses.replace(truth, dataset=truth.dataset.assign(gain_db=truth.dataset["gain_db"] + 3))
    assert [row["rmse_db"] for row in score_map("same", truth, truth)] == [0, 0, 0]
    for row in score_map("shifted", shifted, truth):
        assert row["bias_db"] == pytest.approx(3, abs=1e-4) and row["n"] > 0


def test_a_map_of_other_devices_is_refused(truth):
    other = dataclasses.replace(truth, dataset=truth.dataset.isel(x=slice(3)))
    with pytest.raises(BadInput, match="make both for the same scene"):
        score_map("other", other, truth)


def test_a_twin_that_has_seen_the_held_out_flight_is_named(comparison, tmp_path, flown):
    comparison.twins["log_distance"].save(tmp_path / "twin")
    with pytest.warns(UserWarning, match="too good"):
        _judge_also([tmp_path / "twin"], None, ["f1"])
    with pytest.raises(BadInput, match="--truth"):
        _judge_also([tmp_path / "map.nc"], None, ["f2"])


def test_twins_are_matched_by_the_names_of_their_devices(comparison, small_scene, truth, flown):
    twin = comparison.twins["segmented_log_distance"]
    turned = dataclasses.replace(twin, devices=twin.devices[::-1])
    fewer = dataclasses.replace(twin, devices=twin.devices[:-1])
    _, test = split_flights(flown, 1)
    np.testing.assert_allclose(predict(turned, small_scene, test), predict(twin, small_scene, test))
    missing = (test.table["device"] == "d6").to_numpy()
    alone_db = predict(fewer, small_scene, test)
    assert np.isnan(alone_db[missing]).all()
    np.testing.assert_allclose(alone_db[~missing], predict(twin, small_scene, test)[~missing])
    again = compare_models(test, test, small_scene, truth, seed=0, models=(), twins={"twin": twin, "turned": turned})
    by_model = again.scores.set_index(["model", "against", "positions", "links"])["rmse_db"]
    np.testing.assert_allclose(by_model["twin"], by_model["turned"])


def test_received_power_is_compared_with_a_map_of_gain(small_scene, truth, flown):
    """20 dBm transmitted: levels 20 dB above the gain, errors the same."""
    radio = small_scene.config.radio
    radio = radio.model_copy(update={"tx_power_dbm": 20.0, "sensitivity_dbm": radio.sensitivity_dbm + 20.0 - radio.tx_power_dbm})
    loud = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    truth = dataclasses.replace(truth, dataset=truth.dataset.assign_attrs(scene_hash=loud.content_hash()))
    table = flown.table.assign(rssi_dbm=flown.table["gain_db"] + 20.0).drop(columns="gain_db")
    gains, powers = (compare_models(*split_flights(measured, 1), loud, truth, seed=0, models=("segmented_log_distance",))
                     .scores["bias_db"].to_numpy() for measured in (flown, Measurements(table, flown.devices)))
    np.testing.assert_allclose(gains, powers, atol=0.05)
    assert np.abs(gains).max() < 2


def test_a_truth_of_another_scene_is_refused(small_scene, truth, flown):
    stale = dataclasses.replace(truth, dataset=truth.dataset.assign_attrs(scene_hash="0" * 64))
    with pytest.raises(BadInput, match="radiotwin trace"):
        compare_models(*split_flights(flown, 1), small_scene, stale, seed=0)


def test_nothing_detected_on_the_held_out_flight(small_scene, truth, flown):
    train, test = split_flights(flown, 1)
    silent = Measurements(test.table.assign(gain_db=np.nan), test.devices)
    with pytest.raises(BadInput, match="nothing was detected on the held-out"):
        compare_models(train, silent, small_scene, truth, seed=0)


def test_devices_of_unknown_position_are_in_neither_class(small_scene, flown):
    """Own data in a scene that declares no devices: anchors have LoS or not, the others count in `all` alone."""
    bare = Scene(small_scene.folder, small_scene.config.model_copy(update={"devices": []}))
    scores = compare_models(*split_flights(flown, 1), bare, None, seed=0, models=("log_distance",)).scores
    n = scores.set_index("links")["n"]
    assert 0 < n["LoS"] and 0 < n["NLoS"] and n["LoS"] + n["NLoS"] < n["all"]


def test_a_killed_comparison_goes_on_with_the_models_that_were_fitted(compare, comparison, monkeypatch):
    from radiotwin.runtime import pieces
    from radiotwin.twin.localize import on_map

    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    with monkeypatch.context() as killed, pieces.keep_pieces() as store, pytest.raises(KeyboardInterrupt):
        def kill(*_, **__):
            raise KeyboardInterrupt
        killed.setattr("radiotwin.propagation.laws.kriging.RegressionKriging.fit", kill)
        compare()
    assert store.saved >= 4
    with pieces.keep_pieces() as store:
        assert texts(compare()) == texts(comparison)
    assert store.earlier >= 4  # two channels, and the devices located with each
    monkeypatch.setattr(on_map, "localize", lambda *_, **__: pytest.fail("located again"))
    with pieces.keep_pieces() as store:
        assert texts(compare()) == texts(comparison)
    assert store.made == 0


def test_models_that_are_fitted_in_other_processes_are_the_same_to_the_bit(compare, comparison, tmp_path):
    from radiotwin.runtime import pieces
    from tests.runtime.execution.jobs import two_workers

    with two_workers("local", one_is_killed=False) as (executor, _), pieces.keep_pieces(tmp_path):
        assert texts(compare(executor=executor)) == texts(comparison)
    assert list(tmp_path.glob("positions-*"))  # kept there, for a command that is killed


@pytest.mark.parametrize("name", ["log_distance", "measured_db"])
def test_a_twin_with_the_name_of_a_model_or_a_column_is_refused(small_scene, flown, name):
    train, test = split_flights(flown, 1)
    twin = fit_twin(train, small_scene, model="log_distance")
    with pytest.raises(BadInput, match="rename it"):
        compare_models(train, test, small_scene, models=("log_distance",), twins={name: twin})


def test_models_without_the_networks_are_drawn_too(comparison, small_scene, truth, tmp_path):
    write_comparison_folder(comparison, small_scene, tmp_path, truth)
    assert {"compare.json", "scatter.png", "maps.png", "estimates.png"} <= {path.name for path in tmp_path.iterdir()}
