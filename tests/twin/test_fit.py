"""Fitting a twin: what it is learnt from, and what is refused or warned of."""

import warnings

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit, fit_twin


def test_positions_of_unknown_devices_are_not_read(small_scene, flown, twin):
    wrong = flown.devices.copy()
    wrong.loc[wrong["role"] == "unknown", ["x_m", "y_m"]] = 7.0
    again = fit_twin(Measurements(flown.table, wrong), small_scene, model="segmented_log_distance", seed=0)
    assert again.devices == twin.devices


def test_copies_of_links_are_left_out(small_scene, flown):
    twice = Measurements(pd.concat([flown.table, flown.table], ignore_index=True), flown.devices)
    with pytest.warns(UserWarning, match="links left out: they are in the file twice"):
        again = fit_twin(twice, small_scene, model="log_distance", seed=0)
    assert again.devices == fit_twin(flown, small_scene, model="log_distance", seed=0).devices


def test_anchors_keep_their_positions(flown, twin):
    anchors = [(each, tuple(at_m)) for each, at_m in zip(twin.devices, flown.device_m) if each.role == "anchor"]
    assert anchors and all((each.x_m, each.y_m, each.z_m) == at_m and each.credible_radius_m == 0 for each, at_m in anchors)


def test_a_device_never_measured_is_reported_not_guessed(small_scene, flown, tmp_path):
    heard = (flown.table["device"] != "d3").to_numpy()
    twin = fit_twin(flown.select(heard), small_scene, model="segmented_log_distance", seed=0)
    lost = next(device for device in twin.devices if device.device == "d3")
    assert not lost.located and np.isnan(lost.x_m)
    assert "d3" not in twin.radio_map(small_scene).devices
    twin.save(tmp_path / "twin")
    again = next(device for device in Twin.load(tmp_path / "twin").devices if device.device == "d3")
    assert np.isnan(again.x_m) and again.credible_radius_m == np.inf


def test_a_spare_device_without_a_height_is_no_reason_to_fit_nothing(small_scene, flown):
    spare = pd.DataFrame([{"device": "spare", "x_m": np.nan, "y_m": np.nan, "z_m": np.nan, "role": "unknown"}])
    devices = pd.concat([flown.devices, spare], ignore_index=True)
    twin = fit_twin(Measurements(flown.table, devices), small_scene, model="log_distance")
    last = twin.devices[-1]
    assert last.device == "spare" and not last.located and np.isnan([last.x_m, last.y_m]).all()


def test_an_anchor_just_below_a_roof_of_the_map_stands_on_it(small_scene, flown):
    """Its links are those of a device just above the roof, and a note says how far it was moved."""
    devices = flown.devices.copy()
    devices.loc[0, ["x_m", "y_m"]] = 130.0, 170.0
    roof_m = float(small_scene.city.height_at(130.0, 170.0))
    fits = {}
    for above_m in (-0.4, 0.5):
        devices.loc[0, "z_m"] = roof_m + above_m
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            fits[above_m] = fit_twin(Measurements(flown.table, devices), small_scene, model="segmented_log_distance")
        moved = [str(each.message) for each in said if "device d0 would be inside" in str(each.message)]
        assert [text.split("moved ")[1][:40] for text in moved] == (
            ["0.9 m up, to 0.5 m above the roof, which"] if above_m < 0 else [])
    np.testing.assert_allclose(fits[-0.4].device_m, fits[0.5].device_m, atol=1e-3)
    below_db, above_db = (each.radio_map(small_scene).gain_db for each in fits.values())
    np.testing.assert_allclose(below_db, above_db, atol=0.02)


def test_few_receivers_off_the_map_are_mentioned_and_a_map_of_another_place_is_refused(small_scene, flown):
    few = np.arange(len(flown.table)) % 5 == 0
    for moved_m, off, said in ((9e6, True, r"\(\d+, \d+\) m: they are 9,000 km from it, so it is a map of another place"),
                               (5e3, True, "give measurements and scene in one frame"), (5e3, few, None)):
        table = flown.table.assign(receiver_x_m=flown.table["receiver_x_m"] + moved_m * off)
        with pytest.raises(BadInput, match=said) if said else pytest.warns(UserWarning, match="outside the 3D map"):
            fit_twin(Measurements(table, flown.devices), small_scene, model="log_distance", seed=0)


def test_a_twin_of_another_scene_is_warned_of(small_scene, flown, twin):
    radio = small_scene.config.radio.model_copy(update={"frequency_hz": 3.5e9})
    other = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    with pytest.warns(UserWarning, match="another scene"):
        twin.radio_map(other)
    with pytest.warns(UserWarning, match="another scene"):
        fit_twin(flown, other, model="log_distance", seed=0, start=twin)


def test_blanks_far_above_the_limit_of_detection_are_warned_of(small_scene, flown):
    level_db = flown.table["gain_db"]
    table = flown.table.assign(gain_db=level_db.mask(level_db < np.nanquantile(level_db, 0.2)))
    radio = small_scene.config.radio.model_copy(update={"sensitivity_dbm": -150.0})
    deaf = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    with pytest.warns(UserWarning, match="-150 dB .*, is not used: but for odd ones, the weakest of"):
        fit_twin(Measurements(table, flown.devices), deaf, model="log_distance", seed=0)


def test_of_too_many_links_some_of_each_device_are_drawn(monkeypatch):
    device = np.repeat(["a", "b", "c"], [10, 600, 390])
    table = pd.DataFrame({"device": device, "row": np.arange(1000), "x_m": 0.0, "y_m": 0.0, "gain_db": -80.0})
    data = Measurements(table, pd.DataFrame({"device": ["a", "b", "c", "never"], "x_m": 0.0, "y_m": 0.0}))
    assert fit._thinned(data, 0) is data
    assert fit.MAX_LINKS > 106_455  # no data set that results were recorded of is thinned
    monkeypatch.setattr(fit, "MAX_LINKS", 210)
    with pytest.warns(UserWarning, match="1,000 links were measured, 210 of them are fitted: at most 100 of each"):
        thin = fit._thinned(data, 0)
    assert thin.table["device"].value_counts().to_dict() == {"a": 10, "b": 100, "c": 100}
    assert thin.table["row"].is_monotonic_increasing and thin.table["row"].between(200, 400).sum() > 10
    with pytest.warns(UserWarning):
        assert fit._thinned(data, 0).table.equals(thin.table)


@pytest.mark.parametrize(("change", "message"), [
    (lambda links, devices: links.update(links.assign(gain_db=-80.0)), "all levels are -80, so there is nothing to explain"),
    (lambda links, devices: links.__setitem__("receiver_z_m", links["receiver_z_m"].mask(links.index == 4)),
     "measurements, row 6, column receiver_z_m"),
    (lambda links, devices: devices.loc.__setitem__((0, ["x_m", "y_m"]), (130.0, 170.0)),
     "devices, row 2: anchor 'd0' .*inside a building")])
def test_what_cannot_be_learnt_from_is_refused(small_scene, flown, change, message):
    links, devices = flown.table.copy(), flown.devices.copy()
    change(links, devices)
    with pytest.raises(BadInput, match=message):
        fit_twin(Measurements(links, devices), small_scene, model="log_distance")
