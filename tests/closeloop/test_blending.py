"""The combination as a twin keeps it: what is scored on held-out links is what a twin predicts."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.predict import baselines, predictor
from radiotwin.closeloop.predict.baselines import Part, fitted_law, grow_trees, held_out_baselines
from radiotwin.closeloop.predict.predictor import combined_fit, combined_prediction
from radiotwin.closeloop.predict.weights import Combination
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.errors import BadInput
from radiotwin.links import Links, prepare_links
from radiotwin.links.links import Columns, Ends
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.twin.model.blend import FORESTS, far_share
from radiotwin.twin.model.model import FittedModel
from radiotwin.twin.twin import Twin
from tests.closeloop.looking import based
from tests.worlds import fly, measured

SHARES = Combination({"named": (0.1, 0.6), FORESTS[0]: (0.4, 0.0), FORESTS[1]: (0.2, 0.0), "named_and_rest": (0.1, 0.1),
                      "kriging": (0.2, 0.3)}, 40.0, (0.5, 1.2))


def links_of(devices_move=False):
    """Return links of a world with a pattern that no effect explains, and blanks below -95 dB."""
    world = fly(12, noise_db=1.0)
    keep = world.slot % 10 == 0
    world.gain_db += 6 * np.sin(world.receiver_m[:, 0] / 40)
    world.gain_db[world.receiver == 1] += 4.0
    for name in ("flight", "receiver", "device", "time_s", "slot", "receiver_m", "heading_deg", "gain_db"):
        setattr(world, name, getattr(world, name)[keep])
    world.gain_db = np.where(world.gain_db < -95.0, np.nan, world.gain_db)
    if not devices_move:
        return prepare_links(measured(world), None)
    measurements = measured(world)
    table, devices = measurements.table.copy(), measurements.devices
    place = table[["receiver_x_m", "receiver_y_m", "receiver_z_m"]]
    row = [list(devices["device"]).index(each) for each in table["device"]]
    fixed = devices[["x_m", "y_m", "z_m"]].to_numpy()[row]
    table["receiver"], table["device"] = table["device"].to_numpy(), [f"p{i}" for i in range(len(table))]
    table[["receiver_x_m", "receiver_y_m", "receiver_z_m"]] = fixed
    moved = place.set_axis(["x_m", "y_m", "z_m"], axis=1).assign(device=table["device"], role="anchor", frequency_hz=2.4e9)
    return prepare_links(type(measurements)(table, moved), None)


def folded(links):
    model, _ = based(links)
    offset = ReceiverGainOffset().with_params(ReceiverGainOffset.Params(members=[0, 1], offsets_sd_db=2.0))
    return model.map(lambda fit: fit.with_effects([offset]))


def of_map(links):
    """Return the same places as a map has them: without receiver, flight and time."""
    return Links(columns=Columns.unmeasured(links.receiver_m, links.device), world=links.world,
                 ends=Ends(device_names=links.device_names, device_m=links.device_m, anchors=links.anchors))


@pytest.fixture(scope="module")
def blended():
    links = links_of()
    model = folded(links)
    return SimpleNamespace(links=links, model=model, twin=replace(model.twin, fitted=combined_fit(model, SHARES, 0)))


@pytest.mark.parametrize("devices_move", [False, True])
def test_a_twin_of_a_fold_predicts_what_was_scored(devices_move, monkeypatch, tmp_path):
    """Learnt from the same links and stored, it has at held-out positions the number that the page's error is of."""
    def grown(kind, features, target, seed, *_):
        return grow_trees(kind, features, target, seed, 2)
    for module in (baselines, predictor):
        monkeypatch.setattr(module, "grow_trees", grown)
    links, used = links_of(devices_move), []
    model = folded(links)
    def weigh(held_out, quadrants, names, half_m, dof):
        used.append(replace(SHARES, half_m=half_m))
        return used[-1]
    monkeypatch.setattr(predictor, "combination", weigh)
    found = combined_prediction(model, True, 0)
    for number in (0, 3):
        fold = model.folds[number]
        fitted = combined_fit(model.with_fits(fold, model.folds), used[number], 0)
        replace(model.twin, fitted=fitted).save(tmp_path / str(number))
        twin, own = Twin.load(tmp_path / str(number)), model.index == number
        held_out = fold.links.select(own)
        assert np.isnan(held_out.level_db).any() and twin.fitted.blend.receivers_move is not devices_move
        np.testing.assert_allclose(twin.predict(held_out).reading_db, found.reading_db[own], atol=5e-3)
        np.testing.assert_allclose(twin.predict(of_map(held_out)).mean_db, found.map_db[own], atol=5e-3)
    assert np.nanmax(np.abs(found.map_db - found.reading_db)) > 1.0  # the two are not the same number


def test_a_baseline_is_what_a_twin_of_that_channel_predicts(blended):
    model = blended.model
    rows, _ = held_out_baselines(model, [Part(each.links) for each in model.folds], 0)
    fold, own = model.folds[0], model.index == 0
    law = fitted_law(RegressionKriging, fold.links, fold.train)
    twin = replace(model.twin, fitted=FittedModel.of_channel(law))
    np.testing.assert_allclose(twin.predict(fold.links.select(own)).reading_db, rows["kriging"][own])


def test_the_twin_predicts_by_the_weights_of_the_loop(blended):
    blend = blended.twin.fitted.blend
    assert blend.weights == SHARES.weights and set(blend.forests) == set(FORESTS)
    learnt_db = blended.twin.predict(blended.links).mean_db
    named_db = replace(blended.twin, fitted=blended.model.whole.learnt).predict(blended.links).mean_db
    error = [np.sqrt(np.nanmean((blended.links.level_db - mean_db) ** 2)) for mean_db in (learnt_db, named_db)]
    assert error[0] < 0.8 * error[1]


def test_far_from_all_measurements_it_takes_the_far_weights(blended):
    blend, links = blended.twin.fitted.blend, blended.links
    far = links.with_receivers(links.receiver_m + [1e5, 0, 0])
    assert far_share(blend.away_m(far), 50.0).min() > 0.99 and blend.away_m(links).max() < 0.2
    nowhere = replace(blend, measured_other=np.full(len(blend.measured_other), 99))
    assert np.isinf(nowhere.away_m(links)).all()


@pytest.mark.parametrize("change", [
    lambda blend: blend["weights"].update(named=[2.0, 0.0]), lambda blend: blend.update(half_m=-1.0),
    lambda blend: blend.update(more=1), lambda blend: blend["models"].clear(),
    lambda blend: blend.update(receivers_move=1),
    lambda blend: blend["weights"].update(oracle=[0.0, 0.0]), lambda blend: blend.update(sd_ratio=[0.0, 1.0])])
def test_a_damaged_combination_is_refused(blended, change):
    record, channel = blended.twin.encode()
    given = json.loads(record)
    change(given["fitted"]["blend"])
    with pytest.raises(BadInput, match="damaged"):
        Twin.decode(json.dumps(given), channel, "it")
