"""The combination as a twin keeps it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import cross_validate, make_bases, make_folds, training_parts
from radiotwin.closeloop.predict.blending import held_out_coverage, make_blend
from radiotwin.closeloop.predict.predictor import CombinedPrediction
from radiotwin.errors import BadInput
from radiotwin.links import Links, prepare_links
from radiotwin.links.links import Columns, Ends
from radiotwin.twin.model.blend import FORESTS
from radiotwin.twin.twin import Twin
from tests.worlds import fly, measured


@pytest.fixture(scope="module")
def blended():
    """A world with a pattern that no effect explains: its links, prediction, and twin with the blend."""
    world = fly(12, noise_db=1.0)
    keep = world.slot % 6 == 0
    world.gain_db += 6 * np.sin(world.receiver_m[:, 0] / 40)
    for name in ("flight", "receiver", "device", "time_s", "slot", "receiver_m", "heading_deg", "gain_db"):
        setattr(world, name, getattr(world, name)[keep])
    links = prepare_links(measured(world), None)
    folds = make_folds(links, 0)
    model = cross_validate(links, make_bases(None, 0)["log-distance"], folds, training_parts(links, folds))
    weights = np.array([[0.1, 0.5, 0.2, 0.0, 0.2], [0.6, 0.0, 0.0, 0.01, 0.39]])
    prediction = CombinedPrediction(
        model.held_out_mean_db, ["named", *FORESTS, "segmented_log_distance", "regression_kriging"], weights,
        np.zeros((len(links), 5)), np.linspace(0, 1, len(links)))
    blend = make_blend(model, prediction, 0)
    fitted = replace(model.whole.learnt, blend=blend)
    return SimpleNamespace(links=links, model=model, prediction=prediction, twin=replace(model.twin, fitted=fitted))


def test_the_twin_predicts_by_the_weights_of_the_loop(blended):
    weights = blended.twin.fitted.blend.weights
    assert np.sum(list(weights.values()), axis=0) == pytest.approx(1.0)
    assert "segmented_log_distance" not in weights and weights["named_and_trees"][0] == pytest.approx(0.5)
    learnt_db = blended.twin.predict(blended.links).mean_db
    named_db = replace(blended.twin, fitted=replace(blended.twin.fitted, blend=None)).predict(blended.links).mean_db
    error = [np.sqrt(np.nanmean((blended.links.level_db - mean_db) ** 2)) for mean_db in (learnt_db, named_db)]
    assert error[0] < 0.8 * error[1]


def test_a_stored_twin_predicts_the_same(blended, tmp_path):
    blended.twin.save(tmp_path / "twin")
    again = Twin.load(tmp_path / "twin").predict(blended.links)
    expected = blended.twin.predict(blended.links)
    np.testing.assert_allclose(again.mean_db, expected.mean_db, atol=1e-3)
    np.testing.assert_allclose(again.sd_db, expected.sd_db, rtol=1e-3)


def test_far_from_all_measurements_it_takes_the_far_weights(blended):
    blend, links = blended.twin.fitted.blend, blended.links
    far = links.with_receivers(links.receiver_m + [1e5, 0, 0])
    assert blend.far_share(far).min() > 0.99 and blend.far_share(links).max() < 0.01
    nowhere = replace(blend, measured_device=np.full(len(blend.measured_device), 99))
    assert (nowhere.far_share(links) == 1.0).all()


def test_links_without_a_receiver_are_predicted_as_a_map_needs_them(blended):
    links = blended.links
    of_map = Links(columns=Columns.unmeasured(links.receiver_m[:50], links.device[:50]), world=links.world,
                   ends=Ends(device_names=links.device_names, device_m=links.device_m, anchors=links.anchors))
    assert np.isfinite(blended.twin.predict(of_map).mean_db).all()


@pytest.mark.parametrize("change", [
    lambda blend: blend["weights"].update(named=[2.0, 0.0]), lambda blend: blend.update(half_m=-1.0),
    lambda blend: blend.update(more=1), lambda blend: blend["models"].clear(),
    lambda blend: blend["weights"].update(oracle=[0.0, 0.0]), lambda blend: blend.update(sd_ratio=[0.0, 1.0])])
def test_a_damaged_combination_is_refused(blended, change):
    import json

    record, channel = blended.twin.encode()
    given = json.loads(record)
    change(given["fitted"]["blend"])
    with pytest.raises(BadInput, match="damaged"):
        Twin.decode(json.dumps(given), channel, "it")


def test_intervals_hold_what_they_say_on_links_that_had_no_part_in_their_width(blended):
    assert 0.84 < held_out_coverage(blended.model, blended.prediction) < 0.97
    one = blended.model.index == 0
    off_db = np.where(one, 40.0, 0.0)  # the flight that is off by 40 dB must not make its own intervals wide
    off = replace(blended.prediction, mean_db=blended.prediction.mean_db + off_db)
    assert held_out_coverage(blended.model, off) < 1 - 0.9 * one.mean()


def test_where_named_effects_are_all_their_own_intervals_count(blended):
    weights = np.zeros((2, 5))
    weights[:, 0] = 1.0
    alone = replace(blended.prediction, weights=weights, mean_db=blended.prediction.mean_db + 40.0)
    assert 0.8 < held_out_coverage(blended.model, alone) < 1.0  # the other members' levels are not asked


def test_what_extrapolation_costs_widens_intervals_far_from_measured_places(blended):
    """Held-out links lie near others; quadrants that were held out have three times their error."""
    z = np.random.default_rng(0).normal(0, 3.0, 400)
    away = np.column_stack([z, np.full(400, 0.9), np.zeros(400)])
    wider = make_blend(blended.model, replace(blended.prediction, away=away), 0).sd_ratio
    usual = blended.twin.fitted.blend.sd_ratio
    assert wider[1] > 1.3 * usual[1] and wider[0] >= usual[0]
    sure = np.column_stack([z / 30, np.full(400, 0.9), np.zeros(400)])  # quadrants that happen to fit make none narrower
    assert make_blend(blended.model, replace(blended.prediction, away=sure), 0).sd_ratio >= usual
