"""Twins of published laws: nothing is learnt, so that no anchor is needed."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links import link_geometry
from radiotwin.links.measurements import Measurements
from radiotwin.propagation.laws.aerial import UrbanMacro
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin.compare import compare_models, published_models, split_flights


def with_levels(scene, flown, rng):
    """The measurements as they would be if the world were the macro cell of TR 36.777, with its shadowing."""
    true_m = np.array([[d.x_m, d.y_m, d.z_m] for d in scene.config.devices])
    names = [d.device for d in scene.config.devices]
    device = np.array([names.index(name) for name in flown.table["device"]])
    links = link_geometry(true_m, flown.receiver_m, device, scene.city)
    mean_db, sd_db = UrbanMacro(scene.config.radio.frequency_hz, True).predict(links)
    return flown.table.assign(gain_db=mean_db + sd_db * rng.standard_normal(len(mean_db)))


def test_devices_are_located_without_an_anchor(small_scene, flown, tmp_path):
    devices = flown.devices.assign(role="unknown", x_m=np.nan, y_m=np.nan)
    measured = Measurements(with_levels(small_scene, flown, np.random.default_rng(0)), devices)
    with pytest.raises(BadInput, match="no anchor: .* or take a published law, such as tr36777_uma"):
        fit_twin(measured, small_scene, model="segmented_log_distance", seed=0)
    twin = fit_twin(measured, small_scene, model="tr36777_uma", seed=0)
    error_m = [np.hypot(found.x_m - true.x_m, found.y_m - true.y_m)
               for found, true in zip(twin.devices, small_scene.config.devices, strict=True)]
    assert np.median(error_m) < 20
    twin.save(tmp_path / "twin")
    np.testing.assert_array_equal(Twin.load(tmp_path / "twin").radio_map(small_scene).gain_db,
                                  twin.radio_map(small_scene).gain_db)


def test_levels_do_not_move_a_published_law(small_scene, flown):
    louder = Measurements(flown.table.assign(gain_db=flown.table["gain_db"] + 10), flown.devices)
    twins = [fit_twin(each, small_scene, model="tr36777_uma", seed=0) for each in (flown, louder)]
    assert twins[0].channel.state() == twins[1].channel.state()


@pytest.mark.parametrize("role, power_dbm, how", [("anchor", 43.0, "fitted"), ("unknown", 30.0, "tx_power_dbm")])
def test_received_powers_need_the_transmit_power(small_scene, flown, role, power_dbm, how):
    """It is fitted to anchors; without one the scene's is taken. Both are said."""
    radio = small_scene.config.radio.model_copy(update={"tx_power_dbm": 30.0, "sensitivity_dbm": -90.0})
    loud = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    table = with_levels(small_scene, flown, np.random.default_rng(1))
    table = table.assign(rssi_dbm=table["gain_db"] + 43).drop(columns="gain_db")
    devices = flown.devices if role == "anchor" else flown.devices.assign(role=role)
    with pytest.warns(UserWarning, match=f"transmit power is taken for .* dBm .*{how}"):
        twin = fit_twin(Measurements(table, devices), loud, model="tr36777_uma", seed=0)
    assert twin.channel.power_dbm == pytest.approx(power_dbm, abs=0.6)  # the median of a few hundred links


def test_they_are_compared_as_published(small_scene, flown):
    train, test = split_flights(flown, 1)
    comparison = compare_models(train, test, small_scene, None, seed=0, models=("log_distance", "tr36777_uma"))
    names = [row[0] for row in comparison.tables()[0][2]]
    assert names == ["log_distance", "tr36777_uma (no fit)"]


def test_those_that_hold_at_the_frequency_are_compared():
    assert published_models(2.4e9) == ("tr36777_uma", "tr36777_umi", "al_hourani_urban", "p1411", "cost231_wi")
    assert published_models(28e9) == ("tr36777_uma", "tr36777_umi", "p1411")
    assert published_models(1e8) == ()
