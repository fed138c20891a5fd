"""A scene and a radio map become a mission."""

import json
import re

import numpy as np
import pytest

from marl.mission import Known, make_mission
from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import segmented_truth
from radiotwin.scene import Scene


def changed(scene, **parts):
    return Scene(scene.folder, scene.config.model_copy(update=parts))


def test_the_snr_is_power_plus_gain_minus_noise_at_the_uavs_altitude(small_scene, city_mission):
    truth = segmented_truth(small_scene)
    radio = small_scene.config.radio
    for u, uav in enumerate(small_scene.config.uavs):
        at_altitude = truth.dataset.sel(z=uav.altitude_m)
        for k, device in enumerate(small_scene.config.devices):
            expected = at_altitude["gain_db"].sel(device=device.device).values + radio.tx_power_dbm - radio.noise_dbm
            level = city_mission.level[u]
            np.testing.assert_allclose(city_mission.snr_db[level, k], expected, rtol=1e-5)
            np.testing.assert_allclose(city_mission.sigma_db[level, k],
                                       at_altitude["sigma_db"].sel(device=device.device).values)


def test_a_maps_own_powers_of_devices_come_before_the_scenes(small_scene, city_mission):
    truth = segmented_truth(small_scene)
    names = [device.device for device in small_scene.config.devices]
    powers_dbm = 10.0 + np.arange(len(names))
    loud = RadioMap(truth.dataset.assign_attrs(device_tx_power_dbm=json.dumps(dict(zip(names, powers_dbm)))))
    rise_db = make_mission(small_scene, loud, Known.truth(small_scene)).snr_db - city_mission.snr_db
    expected_db = (powers_dbm - small_scene.config.radio.tx_power_dbm)[None, :, None, None]
    np.testing.assert_allclose(rise_db[np.isfinite(rise_db)], np.broadcast_to(expected_db, rise_db.shape)[np.isfinite(rise_db)],
                               atol=1e-3)


def test_a_link_without_gain_has_no_snr(small_scene):
    truth = segmented_truth(small_scene)
    dataset = truth.dataset.copy(deep=True)
    dataset["gain_db"].values[2, :, 3, 4] = np.nan
    mission = make_mission(small_scene, RadioMap(dataset), Known.truth(small_scene))
    assert (mission.snr_db[:, 2, 3, 4] == -np.inf).all() and np.isfinite(mission.sigma_db).all()
    lacking = RadioMap(dataset.drop_sel(device="d1"))
    mission = make_mission(small_scene, lacking, Known.truth(small_scene))
    assert (mission.snr_db[:, 1] == -np.inf).all()


def test_the_way_home_goes_around_buildings(small_scene, slow):
    # Two UAVs below the roofs.
    lattice = small_scene.config.lattice.model_copy(update={"altitudes_m": [10.0]})
    uavs = [uav.model_copy(update={"altitude_m": 10.0}) for uav in small_scene.config.uavs]
    low = changed(small_scene, lattice=lattice, uavs=uavs)
    mission = make_mission(low, segmented_truth(low), Known.truth(low))
    assert low.blocked[0].any()
    for u, uav in enumerate(uavs):
        end = round(uav.terminal_y_m / 20), round(uav.terminal_x_m / 20)
        expected = slow.moves_home(low.blocked[0], end)
        reached = expected < slow.far
        np.testing.assert_array_equal(mission.steps_home[u][reached], expected[reached])
        assert (mission.steps_home[u][~reached] > 10**6).all()
        assert (expected[reached] > 0).any()


def test_batteries_are_counted_in_whole_hovers(small_scene):
    uavs = [uav.model_copy(update={"battery": 40.7}) for uav in small_scene.config.uavs]
    scene = changed(small_scene, uavs=uavs)
    mission = make_mission(scene, segmented_truth(scene), Known.truth(scene))
    assert mission.battery.tolist() == [81, 81] and mission.longest == 81
    radio = scene.config.radio
    assert mission.detection_db == pytest.approx(radio.sensitivity_dbm - radio.noise_dbm)


def test_known_positions_are_relative_to_the_lattice_and_nan_where_unknown(small_scene):
    mission = make_mission(small_scene, segmented_truth(small_scene), Known.anchors(small_scene))
    for device, known_m in zip(small_scene.config.devices, mission.known_m):
        if device.role == "anchor":
            np.testing.assert_allclose(known_m, (device.x_m, device.y_m))  # this lattice begins at the origin
        else:
            assert np.isnan(known_m).all()


def test_a_maps_attributes_say_how_long_its_errors_last(small_scene):
    truth, known = segmented_truth(small_scene), Known.truth(small_scene)
    assert make_mission(small_scene, truth, known).shadowing_share == 0
    lasting = truth.dataset.assign_attrs(shadowing_share=0.7, shadowing_length_m=80.0)
    mission = make_mission(small_scene, RadioMap(lasting), known)
    assert (mission.shadowing_share, mission.shadowing_m) == (0.7, 80.0)
    for bad in ({"shadowing_share": 1.5}, {"shadowing_length_m": 0.0}, {"shadowing_length_m": np.nan},
                {"shadowing_share": "much"}):
        with pytest.raises(BadInput, match="a share from 0 to 1 and a length above 0"):
            make_mission(small_scene, RadioMap(lasting.assign_attrs(bad)), known)


def uavs(**values):
    return lambda scene: {"uavs": [uav.model_copy(update=values) for uav in scene.config.uavs]}


def mission(**values):
    return lambda scene: {"mission": scene.config.mission.model_copy(update=values)}


@pytest.mark.parametrize("parts, message", [
    (uavs(battery=0.4), "allows 0.5 to 10000"), (uavs(battery=50_000.0), "allows 0.5 to 10000"),
    (uavs(terminal_x_m=300.0, battery=3.0), "battery = 3 does not reach"),
    (lambda scene: {"uavs": []}, "at least one UAV and one device, here are 0 and 7"),
    (mission(data_units=1e308), "mission.data_units = 1e+308"), (mission(rate_scale=1e-308), "mission.rate_scale = 1e-308"),
    (mission(slot_s=1e308), "mission.slot_s = 1e+308")])
def test_a_scene_of_impossible_values_is_refused(parts, message, small_scene):
    scene = changed(small_scene, **parts(small_scene))
    with pytest.raises(BadInput, match=re.escape(message)):
        make_mission(scene, segmented_truth(small_scene), Known.truth(scene))


def test_another_assignment_and_a_map_of_another_lattice_are_refused(small_scene):
    truth, known = segmented_truth(small_scene), Known.truth(small_scene)
    with pytest.raises(BadInput, match="allowed are matching, max-rate"):
        make_mission(small_scene, truth, known, "fair")
    with pytest.raises(BadInput, match="lattice"):
        make_mission(small_scene, RadioMap(truth.dataset.isel(x=slice(0, 5))), known)


@pytest.mark.parametrize("name, value", [("gain_db", 1e308), ("gain_db", np.inf), ("sigma_db", -1.0), ("sigma_db", 1e30)])
def test_a_map_of_impossible_values_is_refused(name, value, small_scene):
    dataset = segmented_truth(small_scene).dataset.copy(deep=True)
    dataset[name] = dataset[name].astype(float)
    dataset[name].values[2, :, 3, 4] = value
    with pytest.raises(BadInput, match=f"{name} of d2"):
        make_mission(small_scene, RadioMap(dataset), Known.truth(small_scene))


def test_a_mission_beyond_the_budget_takes_no_memory(small_scene, monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_MAP_VALUES", "1000")
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_MAP_VALUES"):
        make_mission(small_scene, segmented_truth(small_scene), Known.truth(small_scene))
