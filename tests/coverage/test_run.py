"""Coverage of worlds whose shares are known from geometry."""

import math

import numpy as np
import pytest
import shapely

from radiotwin.coverage import CoverageSettings, Transmitter, predict_coverage
from radiotwin.coverage.areas import Area, CoverageGrid, _covered_shares, with_ground_as_terrain
from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene.antennas import Antenna, Pattern
from radiotwin.scene.lattice import Lattice
from tests.coverage.conftest import FREE_SPACE_AT_1_M_DB, write_scene


def share_at(coverage, threshold_dbm, area=0, key="share"):
    return next(each[key] for each in coverage.summary["areas"][area]["received_power_dbm"]
                if each["threshold"] == threshold_dbm)


def power_at(coverage, x_m, y_m, name="received_power_dbm"):
    return float(coverage.dataset[name].sel(x=x_m, y=y_m, method="nearest"))


def test_free_space_covers_a_disc(build, twin_of):
    devices = [("a", 40.0, -30.0, 31.5)]
    scene = build(devices=devices)
    threshold_dbm = 30.0 + FREE_SPACE_AT_1_M_DB - 20 * math.log10(300.0)
    coverage = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(step_m=4.0, threshold_dbm=threshold_dbm))
    radius2_m2 = 300.0**2 - 30.0**2  # the mast is 30 m above the receivers
    assert share_at(coverage, threshold_dbm) == pytest.approx(math.pi * radius2_m2 / 1000.0**2, rel=0.003)
    assert share_at(coverage, threshold_dbm, key="share_reliable") == pytest.approx(share_at(coverage, threshold_dbm))
    assert coverage.summary["areas"][0]["area_m2"] == pytest.approx(1000.0**2)
    middle = coverage.dataset["received_power_dbm"].values
    x, y = np.meshgrid(coverage.grid.x_m, coverage.grid.y_m)
    distance_m = np.sqrt((x - 40) ** 2 + (y + 30) ** 2 + 30.0**2)
    np.testing.assert_allclose(middle, 30.0 + FREE_SPACE_AT_1_M_DB - 20 * np.log10(distance_m), atol=1e-4)


def test_expected_share_of_a_disc_is_that_of_jakes(build, twin_of):
    """Log-normal shadowing over a disc (Jakes, Microwave Mobile Communications, 1974, Sec. 2.5.3)."""
    sd_db, exponent, radius_m = 8.0, 3.5, 400.0
    devices = [("a", 0.0, 0.0, 1.5)]
    scene = build(devices=devices)
    at_edge_dbm = 30.0 + FREE_SPACE_AT_1_M_DB - 10 * exponent * math.log10(radius_m)
    disc = Area("disc", shapely.Point(0, 0).buffer(radius_m, quad_segs=200))
    for margin_db in (0.0, 6.0):
        threshold_dbm = at_edge_dbm - margin_db
        coverage = predict_coverage(twin_of(devices, exponent, sd_db=sd_db), scene, areas=[disc],
                                    settings=CoverageSettings(step_m=5.0, threshold_dbm=threshold_dbm))
        a = -margin_db / (sd_db * math.sqrt(2))
        b = 10 * exponent * math.log10(math.e) / (sd_db * math.sqrt(2))
        expected = 0.5 * (1 - math.erf(a) + math.exp((1 - 2 * a * b) / b**2) * (1 - math.erf((1 - a * b) / b)))
        assert share_at(coverage, threshold_dbm, 1, "mean_probability") == pytest.approx(expected, abs=0.002)
        probability = power_at(coverage, radius_m, 0.0, "coverage_probability")
        assert probability == pytest.approx(0.5 * (1 + math.erf(margin_db / sd_db / math.sqrt(2))), abs=0.01)
    # A reliability of 90 % needs 1.2816 standard deviations more: the radius shrinks by as much.
    reliable_m = radius_m * 10 ** ((6.0 - 1.2816 * sd_db) / (10 * exponent))
    assert share_at(coverage, threshold_dbm, 1, "share_reliable") == pytest.approx((reliable_m / radius_m) ** 2, rel=0.01)


@pytest.mark.parametrize("load", [1.0, 0.25])
def test_sinr_between_two_equal_transmitters_is_minus_the_load(build, twin_of, load):
    devices = [("west", -200.0, 0.0, 10.0), ("east", 200.0, 0.0, 10.0)]
    scene = build(devices=devices, tx_power_dbm=60.0)
    coverage = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(
        step_m=1.0, load=load, extent_m=(-10.5, 10.5, -5.5, 5.5)))
    assert power_at(coverage, 0.0, 0.0, "sinr_db") == pytest.approx(-10 * math.log10(load), abs=0.02)
    assert coverage.dataset.attrs["noise_dbm"] == pytest.approx(-95.0)
    assert power_at(coverage, 0, 0, "snr_db") == pytest.approx(power_at(coverage, 0, 0) + 95.0, abs=1e-4)
    expected = 10e6 * 0.6 * math.log2(1 + 1 / load)
    assert power_at(coverage, 0, 0, "rate_bps") == pytest.approx(expected, rel=0.01)
    assert set(np.unique(coverage.dataset["best_server"])) == {0, 1}
    assert power_at(coverage, -5, 0, "best_server") == 0 and power_at(coverage, 5, 0, "best_server") == 1


@pytest.mark.parametrize(("apart_hz", "share"), [(0.0, 1.0), (5e6, 0.75), (20e6, 10**-4.5), (60e6, 0.0)])
def test_of_overlapping_channels_the_common_part_interferes(build, apart_hz, share):
    """Free space by hand (ITU-R P.525) at a mast's line of sight, and the share of the two bands that overlaps."""
    scene = build()
    pair = [Transmitter("A", np.array([-100.0, 0, 30]), 40.0, frequency_hz=2e9),
            Transmitter("B", np.array([100.0, 0, 30]), 40.0, frequency_hz=2e9 + apart_hz)]
    coverage = predict_coverage("al_hourani_suburban", scene, pair, CoverageSettings(
        step_m=10.0, bandwidth_hz=20e6, noise_figure_db=7.0, extent_m=(-100, 100, -100, 100)))
    loss_db = [20 * math.log10(4 * math.pi * math.hypot(5 - x_m, 5, 28.5) * f_hz / 299_792_458) + 0.1
               for x_m, f_hz in ((-100, 2e9), (100, 2e9 + apart_hz))]
    noise_mw = 1.380649e-23 * 290 * 20e6 * 1e3 * 10**0.7
    sinr_db = 40 - loss_db[1] - 10 * math.log10(noise_mw + share * 10 ** ((40 - loss_db[0]) / 10))
    assert power_at(coverage, 5, 5, "best_server") == 1
    assert power_at(coverage, 5, 5, "sinr_db") == pytest.approx(sinr_db, abs=0.02)
    assert any("overlap in part" in note for note in coverage.summary["notes"]) == (apart_hz == 5e6)


def test_noise_follows_bandwidth_and_noise_figure(build, twin_of):
    devices = [("a", 0.0, 0.0, 10.0)]
    scene = build(devices=devices)
    wide = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(step_m=100.0, bandwidth_hz=40e6))
    assert wide.dataset.attrs["noise_dbm"] == pytest.approx(-95.0 + 10 * math.log10(4), abs=1e-6)
    own = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(step_m=100.0, noise_figure_db=5.0))
    assert own.dataset.attrs["noise_dbm"] == pytest.approx(-173.98 + 70 + 5, abs=0.01)


def test_share_of_a_polygon(build, twin_of):
    """A strip of 100 m that the edge of a disc of 300 m cuts far from its middle."""
    devices = [("a", 0.0, 0.0, 1.5)]
    threshold_dbm = 30.0 + FREE_SPACE_AT_1_M_DB - 20 * math.log10(300.0)
    strip = Area("strip", shapely.box(0.0, -50.0, 500.0, 50.0))
    coverage = predict_coverage(twin_of(devices), build(devices=devices), areas=[strip],
                                settings=CoverageSettings(step_m=2.0, threshold_dbm=threshold_dbm))
    inside_m2 = strip.outline.intersection(shapely.Point(0, 0).buffer(300.0, quad_segs=100)).area
    assert share_at(coverage, threshold_dbm, 1) == pytest.approx(inside_m2 / 50_000.0, rel=0.003)


def test_cells_in_buildings_are_left_out_or_lose_the_entry_loss(build, twin_of, house):
    devices = [("a", 0.0, 0.0, 10.0)]
    scene = build(house(100, 100, 300, 200, 20), devices=devices)
    left_out = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(step_m=10.0))
    assert left_out.summary["cells_left_out_indoors"] == 20 * 10
    assert left_out.summary["areas"][0]["area_m2"] == pytest.approx(1000.0**2 - 200 * 100)
    assert math.isnan(power_at(left_out, 195, 145)) and power_at(left_out, 195, 145, "best_server") == -1
    kept = predict_coverage(twin_of(devices), scene, settings=CoverageSettings(step_m=10.0, indoor_loss_db=17.0))
    distance_m = math.sqrt(195**2 + 145**2 + 8.5**2)
    expected_dbm = 30.0 + FREE_SPACE_AT_1_M_DB - 20 * math.log10(distance_m)
    assert power_at(kept, 195, 145) == pytest.approx(expected_dbm - 17.0, abs=1e-3)
    assert kept.summary["areas"][0]["area_m2"] == pytest.approx(1000.0**2)
    np.testing.assert_array_equal(left_out.dataset["received_power_dbm"].values[~left_out.dataset["indoor"].values],
                                  kept.dataset["received_power_dbm"].values[~left_out.dataset["indoor"].values])


def test_a_published_law_sees_the_building(build, house):
    """ITU-R P.1411-12 Eqs. 1 and 20 by hand: over rooftops in the open, and beyond a building."""
    scene = build(house(100, -100, 120, 100, 20), devices=[("a", 0.0, 0.0, 30.0)])
    coverage = predict_coverage("p1411", scene, settings=CoverageSettings(step_m=10.0))
    for x_m, alpha, beta_db, gamma in ((55.0, 2.29, 28.6, 1.96), (135.0, 4.39, -6.27, 2.30)):
        distance_m = math.sqrt(x_m**2 + 5.0**2 + 28.5**2)
        loss_db = 10 * alpha * math.log10(distance_m) + beta_db + 10 * gamma * math.log10(2.0)
        free_db = 20 * math.log10(distance_m) - FREE_SPACE_AT_1_M_DB
        if x_m > 120:  # behind the building: Sec. 4.2.1 adds free space
            loss_db = free_db + 10 * math.log10(10 ** ((loss_db - free_db) / 10) + 1)
        assert power_at(coverage, x_m, 5.0) == pytest.approx(30.0 - loss_db, abs=0.01)
    assert power_at(coverage, 135.0, 5.0, "received_power_sd_db") == pytest.approx(6.89)


def test_notes_are_on_the_class_that_each_link_has(build, house):
    """P.1411-12, Table 8: 55 to 1,200 m with sight, 260 to 1,200 m without; cells hide behind a row of houses."""
    scene = build(house(100, -300, 120, 300, 20), devices=[("a", 0.0, 0.0, 30.0)])
    behind = CoverageSettings(step_m=10.0, extent_m=(130, 160, -50, 50))
    note, = (each for each in predict_coverage("p1411", scene, settings=behind).summary["notes"] if "distance" in each)
    assert "published is 260 to 1200 m" in note and "55" not in note
    before = CoverageSettings(step_m=10.0, extent_m=(60, 90, -50, 50))
    assert not any("distance" in each for each in predict_coverage("p1411", scene, settings=before).summary["notes"])


@pytest.mark.parametrize("terrain", [True, False])
def test_heights_of_notes_are_above_the_ground(tmp_path, house, terrain):
    """A mast of 30 m on a plateau of 60 m, declared or not: COST 231's 4 to 50 m and 1 to 3 m hold, roofs are 20 m."""
    scene = write_scene(tmp_path / "hill", [house(-300, -300, -280, 300, 80)], [("a", 0.0, 0.0, 90.0)],
                        ground_z_m=lambda x, y: 60.0 + 0 * x, terrain=terrain)
    notes = predict_coverage("cost231_wi", scene, settings=CoverageSettings(step_m=50.0)).summary["notes"]
    assert not any("height" in each for each in notes)


def test_an_antenna_points_where_it_is_turned_to(build):
    pattern = Pattern(np.array([0.0, 90.0, 180.0, 270.0]), np.array([-90.0, 90.0]),
                      np.array([[15.0, 0.0, -10.0, 0.0]] * 2))
    scene = build(devices=[("a", 0.0, 0.0, 30.0)])
    settings = CoverageSettings(step_m=10.0)
    turned = [Transmitter("a", np.array([0, 0, 30.0]), 30.0, Antenna(pattern, azimuth_deg=90.0))]
    plain = [Transmitter("a", np.array([0, 0, 30.0]), 30.0)]
    gain_db = (predict_coverage("al_hourani_urban", scene, turned, settings).dataset["received_power_dbm"]
               - predict_coverage("al_hourani_urban", scene, plain, settings).dataset["received_power_dbm"])
    for (x_m, y_m), expected_db in (((495, 5), 15.0), ((-495, 5), -10.0), ((5, 495), 0.0)):
        assert float(gain_db.sel(x=x_m, y=y_m)) == pytest.approx(expected_db, abs=0.2)


def test_receivers_stand_on_uneven_ground(build, twin_of):
    scene = build(devices=[("a", 0.0, 0.0, 200.0)], ground_z_m=lambda x, y: 0.1 * (x + 600.0))
    grid = CoverageGrid.over((-100, 100, -100, 100), 50.0, 1.5)
    receiver_m = grid.receivers_m(slice(0, 4), with_ground_as_terrain(scene.city))
    np.testing.assert_allclose(receiver_m[:, 2], 0.1 * (receiver_m[:, 0] + 600.0) + 1.5, atol=1e-3)


def test_flat_ground_is_not_looked_for(build, house):
    city = build(house(0, 0, 10, 10, 5)).city
    assert with_ground_as_terrain(city) is city


def test_blocks_do_not_change_the_result(build, twin_of, house, monkeypatch):
    devices = [("a", -50.0, 0.0, 10.0), ("b", 250.0, 30.0, 25.0)]
    scene = build(house(100, 100, 300, 200, 20), devices=devices)
    settings = CoverageSettings(step_m=20.0)
    whole = predict_coverage("p1411", scene, settings=settings)
    monkeypatch.setattr("radiotwin.coverage.areas.BLOCK_CELLS", 120)
    parts = predict_coverage("p1411", scene, settings=settings)
    assert whole.dataset.identical(parts.dataset) and whole.summary == parts.summary


def test_a_radio_map_is_taken_at_one_altitude(build):
    scene = build(devices=[("a", 0.0, 0.0, 10.0), ("b", 100.0, 0.0, 10.0)])
    lattice = Lattice.over(-100, 100, -50, 50, 50, [1.5, 20])
    gain_db = np.full((2, 2, 3, 5), -100.0)
    gain_db[0, 1], gain_db[1, 1] = -90.0, np.nan
    gain_db[:, 1, 2, 4] = np.nan
    radio_map = RadioMap.build(["a", "b"], lattice, gain_db, gain_db > -95, attributes={"source": "test"})
    coverage = predict_coverage(radio_map, scene, settings=CoverageSettings(height_m=20.0, threshold_dbm=-60.0))
    assert coverage.grid.step_m == 50 and coverage.grid.shape == (3, 5) and not coverage.grid.above_ground
    power_dbm = coverage.dataset["received_power_dbm"].values
    assert np.isnan(power_dbm[2, 4]) and power_dbm[0, 0] == -60.0
    assert share_at(coverage, -60.0) == pytest.approx(14 / 15)
    assert coverage.summary["areas"][0]["not_detected"] == pytest.approx(1 / 15)
    assert coverage.summary["areas"][0]["best_server"] == {"a": pytest.approx(14 / 15), "b": 0.0}
    assert "coverage_probability" not in coverage.dataset
    with pytest.raises(BadInput, match="no altitude of 7 m; it has 1.5, 20 m"):
        predict_coverage(radio_map, scene, settings=CoverageSettings(height_m=7.0))
    with pytest.raises(BadInput, match="has a grid of its own, and its step cannot be chosen"):
        predict_coverage(radio_map, scene, settings=CoverageSettings(step_m=7.0))
    with pytest.raises(BadInput, match="'c' is not in the radio map"):
        predict_coverage(radio_map, scene, [Transmitter("c", np.zeros(3) + 5.0)])


def test_a_radio_map_of_devices_that_the_scene_does_not_declare(build):
    scene = build()
    radio_map = RadioMap.build(["x"], Lattice.over(-50, 50, -50, 50, 50, [3]), np.full((1, 9), -80.0), np.ones((1, 9)))
    coverage = predict_coverage(radio_map, scene)
    assert power_at(coverage, 0, 0) == -50.0 and coverage.summary["transmitters"][0]["x_m"] is None


def test_sites_that_were_not_measured_get_the_twins_law(build, twin_of):
    scene = build(devices=[("a", 0.0, 0.0, 10.0)])
    twin = twin_of([("a", 0.0, 0.0, 10.0)], exponent=3.0)
    planned = [Transmitter("new", np.array([105.0, 5.0, 25.0]), 40.0)]
    coverage = predict_coverage(twin, scene, planned, CoverageSettings(step_m=10.0))
    expected_dbm = 40.0 + FREE_SPACE_AT_1_M_DB - 30 * math.log10(math.hypot(200.0, 23.5))
    assert power_at(coverage, 305.0, 5.0) == pytest.approx(expected_dbm, abs=1e-3)
    assert coverage.summary["notes"] == ["1 of 1 transmitters were not measured: the twin's law for any device is used"]


def test_a_twin_of_received_powers_has_the_power_in_them(build, twin_of):
    devices = [("a", 0.0, 0.0, 1.5)]
    scene = build(devices=devices)
    twin = twin_of(devices, intercept_db=-20.0, level="rssi_dbm")
    coverage = predict_coverage(twin, scene, settings=CoverageSettings(step_m=10.0))
    assert power_at(coverage, 95.0, 5.0) == pytest.approx(-20.0 - 20 * math.log10(math.hypot(95, 5)), abs=1e-3)
    assert coverage.summary["transmitters"][0]["tx_power_dbm"] is None
    with pytest.raises(BadInput, match="leave --tx-power-dbm out"):
        predict_coverage(twin, scene, settings=CoverageSettings(tx_power_dbm=20.0))
    with pytest.raises(BadInput, match="new is not a device of the twin"):
        predict_coverage(twin, scene, [Transmitter("new", np.array([9.0, 9, 9]))])


def test_what_cannot_be_predicted_is_refused(build, twin_of, house):
    scene = build(house(-20, -20, 20, 20, 20), devices=[("a", 100.0, 0.0, 10.0)], tx_power_dbm=0.0)
    twin = twin_of([("a", 100.0, 0.0, 10.0)])
    with pytest.raises(BadInput, match="the transmit power of a is not known: .*give --tx-power-dbm"):
        predict_coverage(twin, scene)
    with pytest.raises(BadInput, match="'b' at .0, 0, 5. m is inside a building 20.0 m high"):
        predict_coverage("p1411", scene, [Transmitter("b", np.array([0.0, 0, 5]), 20.0)])
    with pytest.raises(BadInput, match="'b' at .90, 0, -9. m is below the ground; z_m counts from the datum: raise it"):
        predict_coverage("p1411", scene, [Transmitter("b", np.array([90.0, 0, -9]), 20.0)])
    with pytest.warns(UserWarning, match="transmitter b would be inside .* 0.9 m up, to 0.5 m above the roof"):
        coverage = predict_coverage("p1411", scene, [Transmitter("b", np.array([0.0, 0, 19.6]), 20.0)])
    assert coverage.transmitters[0].position_m[2] == pytest.approx(20.5, abs=1e-3)
    with pytest.raises(BadInput, match="'segmented_nn' is learnt from measurements"):
        predict_coverage("segmented_nn", scene, settings=CoverageSettings(tx_power_dbm=1.0))
    with pytest.raises(BadInput, match="every cell is inside a building"):
        predict_coverage(twin, scene, settings=CoverageSettings(tx_power_dbm=1.0, extent_m=(-15, 15, -15, 15)))
    with pytest.raises(BadInput, match="no cell of 50 m fits into an area of 30 x 30 m"):
        predict_coverage(twin, scene, settings=CoverageSettings(tx_power_dbm=1.0, step_m=50.0, extent_m=(0, 30, 0, 30)))
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_COVERAGE_CELLS"):
        predict_coverage(twin, scene, settings=CoverageSettings(tx_power_dbm=1.0, step_m=0.1))
    with pytest.raises(BadInput, match="device 'x' is not among the transmitters; there are a"):
        predict_coverage(twin, scene, devices=["x"])
    with pytest.raises(BadInput, match="the radio's frequency is 28 GHz"):
        predict_coverage("cost231_wi", scene, [Transmitter("a", np.array([50, 0, 9.0]), 1.0, frequency_hz=28e9)])
    with pytest.raises(BadInput, match="'far': no cell's middle lies in it"):
        predict_coverage(twin, scene, areas=[Area("far", shapely.box(900, 0, 950, 9))],
                         settings=CoverageSettings(tx_power_dbm=1.0, step_m=50.0))


@pytest.mark.parametrize(("setting", "message"), [
    ({"load": 1.5}, "a load of 1.5 is not possible; allowed are 0 to 1"),
    ({"step_m": 0.0}, "a step of 0 m"), ({"reliability": 0.2}, "a reliability of 0.2"),
    ({"bandwidth_hz": float("nan")}, "a bandwidth of nan Hz"), ({"classes_dbm": (-90.0, -80.0)}, "descending order"),
    ({"extent_m": (1.0, 0.0, 0.0, 1.0)}, "the minimum must be below the maximum")])
def test_impossible_settings(setting, message):
    with pytest.raises(BadInput, match=message):
        CoverageSettings(**setting).check()


def test_a_noise_power_below_the_thermal_one(build, twin_of):
    scene = build(devices=[("a", 0.0, 0.0, 10.0)], noise_dbm=-110.0)
    with pytest.raises(BadInput, match="lies 6.0 dB below the thermal noise"):
        predict_coverage(twin_of([("a", 0.0, 0.0, 10.0)]), scene)


def test_without_a_gain_indoors_there_is_nothing_to_take_a_loss_off(build, house):
    scene = build(house(100, 100, 300, 200, 20), devices=[("a", -200.0, 0.0, 30.0)])
    settings = CoverageSettings(step_m=50.0, indoor_loss_db=15.0)
    with pytest.raises(BadInput, match="goes into a building"):
        predict_coverage("paths", scene, settings=settings)


def test_of_a_power_without_a_deviation_nothing_is_certain():
    power_dbm, sd_db = np.array([-70.0, -70.0, np.nan]), np.array([1.0, np.nan, np.nan])
    found = _covered_shares(power_dbm, sd_db, -85.0, 0.95)
    assert found["share"] == pytest.approx(2 / 3) and found["share_reliable"] == found["mean_probability"] == 0.5
    assert set(_covered_shares(power_dbm[1:2], sd_db[1:2], -85.0, 0.95)) == {"threshold", "share"}
