"""Surveys: measurements are the truth plus the declared noise, without positions of unknown devices."""

import dataclasses

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.maps import survey as campaign
from radiotwin.maps.survey import PATTERNS, fly_survey, segmented_truth
from radiotwin.scene import Scene


@pytest.fixture(scope="module")
def truth(small_scene):
    return segmented_truth(small_scene)


def survey(scene, truth, **options):
    return fly_survey(scene, truth, **({"flights": 2, "pattern": "random-waypoint", "seed": 0} | options))


def test_the_statistical_truth_is_the_published_law(small_scene, truth):
    """Mean and scatter of Chen et al. 2023: LoS -30 - 25 log10 d, sigma √2; NLoS -35 - 30.4 log10 d, sigma √5."""
    measured = survey(small_scene, truth, flights=20, noise_db=0.0)
    true_m = small_scene.device_m[measured.device_index]
    distance_m = np.linalg.norm(measured.receiver_m - true_m, axis=1)
    los = small_scene.city.line_of_sight(true_m, measured.receiver_m)
    assert np.isfinite(measured.level_db).all(), "in a city this small everything is detected"
    for mask, intercept, slope, sigma in ((los, -30, 25, 2**0.5), (~los, -35, 30.4, 5**0.5)):
        residual_db = measured.level_db[mask] - (intercept - slope * np.log10(distance_m[mask]))
        n = mask.sum()
        assert n > 2000
        assert abs(residual_db.mean()) < 4 * sigma / np.sqrt(n)
        assert residual_db.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * n))


def test_a_receivers_error_is_added_to_a_map_of_values(small_scene, truth):
    """It is 1 dB unless another is given; a statistical truth scatters by itself."""
    values = dataclasses.replace(truth, dataset=truth.dataset.drop_vars("sigma_db"))
    exact, usual, noisy = (survey(small_scene, values, **given) for given in ({"noise_db": -0.0}, {}, {"noise_db": 3.0}))
    index = truth.lattice.index_of(exact.receiver_m)
    expected = truth.gain_db.reshape(len(truth.devices), -1)[exact.device_index, index]
    np.testing.assert_allclose(exact.level_db, expected, atol=6e-4)
    for found, sd_db in ((usual, 1.0), (noisy, 3.0)):
        assert (found.level_db - exact.level_db).std() == pytest.approx(sd_db, rel=0.1)
    assert survey(small_scene, truth).table.equals(survey(small_scene, truth, noise_db=0.0).table)


def test_below_sensitivity_is_blank(small_scene, truth):
    radio = small_scene.config.radio.model_copy(update={"sensitivity_dbm": -95.0})
    scene = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    measured = survey(scene, segmented_truth(scene))
    blank = np.isnan(measured.level_db)
    assert 0.1 < blank.mean() < 0.9
    assert measured.level_db[~blank].min() >= -95.0
    assert len(measured.table) == len(survey(small_scene, truth).table), "no link is dropped"


def test_positions_of_unknown_devices_are_withheld(small_scene, truth):
    measured = survey(small_scene, truth)
    assert np.isnan(measured.device_m[~measured.is_anchor, :2]).all()
    np.testing.assert_array_equal(measured.device_m[measured.is_anchor], small_scene.device_m[measured.is_anchor])
    np.testing.assert_array_equal(measured.device_m[:, 2], small_scene.device_m[:, 2])


def test_a_seed_gives_the_same_survey_and_more_flights_only_add(small_scene, truth):
    two, again, three = survey(small_scene, truth), survey(small_scene, truth), survey(small_scene, truth, flights=3)
    assert two.table.equals(again.table)
    first = three.select(three.table["flight"].isin(two.flights))
    assert first.table.equals(two.table)
    assert not survey(small_scene, truth, seed=1).table.equals(two.table)


def test_heading_is_clockwise_from_north_and_time_goes_on(small_scene, truth):
    table = survey(small_scene, truth).table
    track = table[(table["receiver"] == "uav0") & (table["flight"] == "f0") & (table["device"] == "d0")]
    step = track[["receiver_x_m", "receiver_y_m"]].diff().to_numpy()[1:]
    heading = np.radians(track["heading_deg"].to_numpy()[1:])
    np.testing.assert_allclose(np.column_stack([np.sin(heading), np.cos(heading)]) * 20, step, atol=1e-9)
    np.testing.assert_array_equal(np.diff(track["time_s"]), small_scene.config.mission.slot_s)
    second = table[table["flight"] == "f1"]["time_s"].min()
    assert second > table[table["flight"] == "f0"]["time_s"].max()


@pytest.mark.parametrize(("options", "message"), [
    ({"pattern": "spiral"}, "pattern 'spiral' is unknown; allowed are"),
    ({"flights": 0}, "allowed is 1 to"),
    ({"noise_db": -1.0}, "allowed is 0 to 50 dB"),
    ({"noise_db": float("nan")}, "allowed is 0 to 50 dB"),
    ({"noise_db": 1e308}, "allowed is 0 to 50 dB"),
])
def test_options_that_cannot_be(small_scene, truth, options, message):
    with pytest.raises(BadInput, match=message):
        survey(small_scene, truth, **options)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_rows_are_counted_before_the_first_flight(small_scene, truth, monkeypatch, pattern):
    slots = sum(uav.battery // (0.5 if pattern == "random-walk" else 1) + 1 for uav in small_scene.config.uavs)
    most = 3 * int(slots) * len(small_scene.config.devices)
    monkeypatch.setenv("RADIOTWIN_MAX_ROWS", str(most))
    assert most / 4 < len(survey(small_scene, truth, flights=3, pattern=pattern).table) <= most
    monkeypatch.setattr(campaign, "fly", None)
    monkeypatch.setenv("RADIOTWIN_MAX_ROWS", str(most - 1))
    with pytest.raises(BadInput, match=f"scene.toml: 3 flights, as far as the batteries of its UAVs go: {most:,} rows; at most {most - 1:,}"):
        survey(small_scene, truth, flights=3, pattern=pattern)


def test_a_map_of_another_scene_is_refused(small_scene, truth):
    stale = dataclasses.replace(truth, dataset=truth.dataset.assign_attrs(scene_hash="0" * 64))
    with pytest.raises(BadInput, match="radiotwin trace"):
        survey(small_scene, stale)


@pytest.mark.parametrize(("combining", "above_db", "passes"), [
    ("power", 11.9, True), ("power", 12.5, False), ("coherent", 23.9, True), ("coherent", 24.5, False)])
def test_a_traced_map_with_an_impossible_link_is_refused(small_scene, truth, combining, above_db, passes):
    """One LoS link so far above Friis' law (Jakes 1974, eq. 1.1); a statistical truth may be anything."""
    dataset = truth.dataset.drop_vars("sigma_db").copy(deep=True)
    device, at = 2, np.unravel_index(np.flatnonzero(truth.los[2])[7], truth.los[2].shape)
    position_m = small_scene.lattice.positions_m.reshape(*truth.los[2].shape, 3)[at]
    waves = np.linalg.norm(position_m - small_scene.device_m[device]) * 2.4e9 / 299_792_458
    dataset["gain_db"].values[(device, *at)] = -20 * np.log10(4 * np.pi * waves) + above_db
    statistical = dataclasses.replace(truth, dataset=dataset)
    survey(small_scene, statistical)
    dataset.attrs |= {"source": "raytrace", "solver": "paths", "combining": combining}
    traced = dataclasses.replace(truth, dataset=dataset)
    if passes:
        survey(small_scene, traced)
    else:
        with pytest.raises(BadInput, match=rf"1 links .* of d2 lie .* \+{above_db} dB.*trace` again"):
            survey(small_scene, traced)


def test_a_battery_that_does_not_reach_home_is_refused(small_scene, truth):
    uav = small_scene.config.uavs[0].model_copy(update={"battery": 3.0, "terminal_x_m": 280.0, "terminal_y_m": 280.0})
    scene = Scene(small_scene.folder, small_scene.config.model_copy(update={"uavs": [uav]}))
    with pytest.raises(BadInput, match="does not reach"):
        survey(scene, truth)


def test_devices_are_matched_by_name(small_scene, truth):
    turned = dataclasses.replace(truth, dataset=truth.dataset.isel(device=slice(None, None, -1)))
    assert survey(small_scene, turned).table.equals(survey(small_scene, truth).table)
    fewer = dataclasses.replace(truth, dataset=truth.dataset.isel(device=slice(3)))
    with pytest.raises(BadInput, match="lacks device 'd3'"):
        survey(small_scene, fewer)


def test_where_a_receiver_stands_on_a_device_its_gain_is_that_at_one_metre(small_scene):
    config = small_scene.config
    device = config.devices[0]
    lattice = config.lattice.model_copy(update={"altitudes_m": [device.z_m]})
    here = config.devices[0].model_copy(update={"x_m": float(small_scene.lattice.x_m[3]), "y_m": float(small_scene.lattice.y_m[3])})
    scene = dataclasses.replace(small_scene, config=config.model_copy(update={
        "devices": [here, *config.devices[1:]], "lattice": lattice}))
    found = segmented_truth(scene)
    assert np.isfinite(found.gain_db).all()
    assert found.gain_db[0].max() == pytest.approx(-30.0)  # LoS at 1 m (Chen et al. 2023)
