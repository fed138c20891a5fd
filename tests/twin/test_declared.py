"""What devices.csv declares of a device's radio is taken off its levels and put back.

Truths are formulas of their own: free space at 1 m and an exponent, a power, a cable, a pattern that the tests write.
"""

import json

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.crossfit import cross_validate, make_bases, make_folds
from radiotwin.coverage import CoverageSettings, predict_coverage, read_transmitters
from radiotwin.coverage.sources import source_of_twin
from radiotwin.coverage.transmitters import Transmitter
from radiotwin.errors import BadInput
from radiotwin.links import link_geometry, prepare_links
from radiotwin.links.declared import Declared, Radio
from radiotwin.links.links import Columns, Ends, Links, World
from radiotwin.links.measurements import Measurements, read_measurements
from radiotwin.maps.file import form_problem
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.propagation.laws.followed_paths import path_gains
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna, read_pattern
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin.compare import predict
from radiotwin.twin.locate import locate_devices
from radiotwin.twin.point_gains import gains_at
from tests.coverage.conftest import write_scene

A_DB, EXPONENT, SD_DB = -40.0, 2.6, 1.5
PLACES_M = {"a": (60.0, 60.0), "b": (330.0, 90.0), "c": (80.0, 320.0), "u": (230.0, 240.0)}
ABC_DBM = {"a": 0.0, "b": 20.0, "c": 10.0}  # transmit powers
Z_M, UP_M = 1.5, 40.0


def sector_dbi(azimuth_deg, elevation_deg):
    """14 dBi ahead, 12 dB less for each 50 degrees of azimuth and for each 20 of elevation, squared; 25 dB at most."""
    off = (np.asarray(azimuth_deg) + 180) % 360 - 180
    return 14 - np.minimum(12 * (off / 50) ** 2 + 12 * (np.asarray(elevation_deg) / 20) ** 2, 25)


def write_sector(path):
    rows = [f"{azimuth},{elevation},{sector_dbi(azimuth, elevation):.6f}"
            for elevation in range(-90, 91, 2) for azimuth in range(0, 360, 2)]
    path.write_text("azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(rows) + "\n")


def truth_db(device_m, receiver_m, boresight_deg=None):
    east, north, up = (np.asarray(receiver_m) - device_m).T
    gain_db = A_DB - 10 * EXPONENT * np.log10(np.sqrt(east**2 + north**2 + up**2))
    if boresight_deg is None:
        return gain_db
    return gain_db + sector_dbi(np.degrees(np.arctan2(east, north)) - boresight_deg,
                                np.degrees(np.arctan2(up, np.hypot(east, north))))


def campaign(folder, devices, column="rssi_dbm", boresights_deg=None, seed=0, links=250):
    """Write measurements of devices (name -> declared columns) over the small scene, and read them."""
    rng = np.random.default_rng(seed)
    table = []
    for name, declared in devices.items():
        receiver_m = np.column_stack([rng.uniform(20, 380, (links, 2)), np.full(links, UP_M)])
        level_db = truth_db((*PLACES_M[name], Z_M), receiver_m, (boresights_deg or {}).get(name)) \
            + rng.normal(0, SD_DB, links) + declared.pop("adds_db")
        table.append(pd.DataFrame({"time_s": np.arange(links), "flight": "f", "receiver": "r", "device": name, column: level_db,
                                   **{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")}}))
    rows = [{"device": name, "x_m": PLACES_M[name][0] if name != "u" else None, "y_m": PLACES_M[name][1] if name != "u" else None,
             "z_m": Z_M, "role": "unknown" if name == "u" else "anchor", **declared} for name, declared in devices.items()]
    folder.mkdir(exist_ok=True)
    pd.concat(table).to_csv(folder / "measurements.csv", index=False)
    pd.DataFrame(rows).to_csv(folder / "devices.csv", index=False)
    return read_measurements(folder / "measurements.csv")


def powered(folder, powers_dbm, **settings):
    return campaign(folder, {name: {"tx_power_dbm": power, "adds_db": power} for name, power in powers_dbm.items()}, **settings)


def at_points(grid, height_m=40.0):
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    return np.column_stack([x_m, y_m, np.full(len(x_m), height_m)])


def predicted_db(twin, scene, names, at_m):
    row = [[each.device for each in twin.devices].index(name) for name in names]
    return twin.predict(twin.links(np.tile(at_m, (len(row), 1)), np.array(row), scene)).mean_db


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("open") / "scene", tx_power_dbm=0.0, noise_dbm=-102.0)


def test_powers_of_anchors_and_of_an_unknown_device(ground, tmp_path):
    powers = {"a": 0.0, "b": 20.0, "c": 10.0, "u": 27.0}
    data = powered(tmp_path / "m", powers)
    twin = fit_twin(data, ground, model="log_distance")
    located = twin.devices[3]
    assert np.hypot(located.x_m - 230, located.y_m - 240) < 5 and located.credible_radius_m < 10
    at_m = np.array([[200.0, 180.0, 40.0]])
    gains_db = np.array([truth_db((*PLACES_M[name], Z_M), at_m)[0] for name in "abcu"])
    expected_dbm = gains_db + list(powers.values())
    np.testing.assert_allclose(predicted_db(twin, ground, "abcu", at_m), expected_dbm, atol=0.7)
    twin.save(tmp_path / "twin")
    again = Twin.load(tmp_path / "twin")
    np.testing.assert_array_equal(predicted_db(again, ground, "abcu", at_m), predicted_db(twin, ground, "abcu", at_m))
    np.testing.assert_allclose(gains_at(again, ground, at_m, list("abcu"))[:, 0], gains_db, atol=0.7)
    lattice = again.radio_map(ground)
    there_m = np.array([[lattice.lattice.x_m[3], lattice.lattice.y_m[4], 1.5]])
    np.testing.assert_allclose(lattice.gain_db[:, 0, 4, 3], [truth_db((*PLACES_M[name], Z_M), there_m)[0] for name in "abcu"],
                               atol=1.0)


def test_a_power_that_is_missing_is_that_of_the_scene_or_the_median(ground, tmp_path):
    declared = {"a": {"tx_power_dbm": 0.0, "adds_db": 0.0}, "b": {"tx_power_dbm": 20.0, "adds_db": 20.0}, "c": {"adds_db": 10.0}}
    data = campaign(tmp_path / "m", declared)
    assert any("tx_power_dbm of c is not declared and taken for 10 dBm, the median" in note
               for note in prepare_links(data, ground).notes)
    with pytest.warns(UserWarning, match="tx_power_dbm of c is not declared and taken for 10 dBm"):
        twin = fit_twin(data, ground, model="log_distance")
    at_m = np.array([[200.0, 180.0, 40.0]])
    expected_dbm = [truth_db((*PLACES_M[name], Z_M), at_m)[0] + power for name, power in zip("abc", (0, 20, 10))]
    np.testing.assert_allclose(predicted_db(twin, ground, "abc", at_m), expected_dbm, atol=0.7)
    loud = write_scene(tmp_path / "loud", tx_power_dbm=17.0)
    assert any("tx_power_dbm of c is not declared and taken for 17 dBm, the scene's" in note
               for note in prepare_links(data, loud).notes)


def test_nothing_declared_changes_nothing(ground, tmp_path):
    links = prepare_links(campaign(tmp_path / "m", {name: {"adds_db": 5.0} for name in "abc"}), ground)
    assert links.declared.adds_nothing and not links.has_gains
    assert links.gains()[1] is not links.level_db and (links.gains()[1] == links.level_db).all()
    twin = fit_twin(read_measurements(tmp_path / "m" / "measurements.csv"), ground, model="log_distance")
    assert "declared" not in json.loads(twin.encode()[0])


def test_gains_do_not_hold_the_power_which_coverage_uses(ground, tmp_path):
    data = campaign(tmp_path / "m", {name: {"tx_power_dbm": 23.0, "adds_db": 0.0} for name in "abc"}, "gain_db")
    with pytest.warns(UserWarning, match="levels are gains, without the power"):
        twin = fit_twin(data, ground, model="log_distance")
    coverage = predict_coverage(twin, ground, settings=CoverageSettings(step_m=20.0))
    assert {each["tx_power_dbm"] for each in coverage.summary["transmitters"]} == {23.0}


@pytest.mark.parametrize(("declared", "power_dbm"), [
    ({"eirp_dbm": 30.0, "cable_loss_db": 2.0}, 32.0), ({"eirp_dbm": 30.0, "tx_power_dbm": 30.4}, 30.4),
    ({"eirp_dbm": 44.0, "cable_loss_db": 3.0, "antenna": "sector.csv", "tx_power_dbm": 33.0}, 33.0),
    ({"eirp_dbm": 44.0, "antenna": "sector.csv"}, 30.0)])
def test_eirp_is_power_less_cable_and_the_antennas_greatest_gain(ground, tmp_path, declared, power_dbm):
    write_sector(tmp_path / "sector.csv")
    data = campaign(tmp_path, {"a": declared | {"adds_db": 0.0}, "b": {"tx_power_dbm": 10.0, "adds_db": 0.0}})
    radio = prepare_links(data, ground).declared.radios[0]
    assert radio.tx_power_dbm == pytest.approx(power_dbm)
    (tmp_path / "sites.csv").write_text(pd.DataFrame([{"device": "s", "x_m": 0, "y_m": 0, "z_m": 9} | declared]).to_csv(index=False))
    site, = read_transmitters(tmp_path / "sites.csv", ground)
    assert site.tx_power_dbm == pytest.approx(power_dbm)
    assert site.fed_dbm == pytest.approx(power_dbm - declared.get("cable_loss_db", 0.0))


@pytest.mark.parametrize(("declared", "message"), [
    ({"eirp_dbm": 30.0, "tx_power_dbm": 20.0}, "'a': eirp_dbm = 30 contradicts tx_power_dbm = 20 .* which make 20.0 dBm"),
    ({"cable_loss_db": -2.0}, "column cable_loss_db: .*is no loss; allowed are 0 to 100 dB"),
    ({"antenna": "../other.csv"}, "only files in that folder may be named"),
    ({"antenna": "none.csv"}, "none.csv")])
def test_what_contradicts_itself_is_refused(ground, tmp_path, declared, message):
    folder = tmp_path / "m"
    folder.mkdir()
    with pytest.raises(BadInput, match=message):
        prepare_links(campaign(folder, {"a": declared | {"adds_db": 0.0}}, links=60), ground)


def through_sectors(folder, names, column="rssi_dbm", **declared):
    folder.mkdir()
    write_sector(folder / "sector.csv")
    boresights_deg = dict(zip("abcu", (45.0, 300.0, 150.0, 230.0)))
    return campaign(folder, {name: {"adds_db": 0.0, **{key: value[name] if isinstance(value, dict) else value
                                                        for key, value in declared.items()}, "azimuth_deg": boresights_deg[name]}
                             for name in names}, column, boresights_deg)


def test_antennas_of_devices_are_taken_off_and_put_back(ground, tmp_path):
    data = through_sectors(tmp_path / "m", "abcu", antenna="sector.csv", tx_power_dbm=0.0)
    twin = fit_twin(data, ground, model="log_distance")
    assert twin.channel.predict(link_geometry(np.zeros((1, 3)), np.array([[100.0, 0, 0]]), np.array([0]), None))[0] \
        == pytest.approx(A_DB - 20 * EXPONENT, abs=0.3)
    assert np.hypot(twin.devices[3].x_m - 230, twin.devices[3].y_m - 240) < 5
    twin.save(tmp_path / "twin")
    at_m, again = np.array([[150.0, 210.0, 40.0]]), Twin.load(tmp_path / "twin")
    expected_db = [truth_db((*PLACES_M[name], Z_M), at_m, boresight)[0] for name, boresight in zip("abc", (45, 300, 150))]
    np.testing.assert_allclose(predicted_db(again, ground, "abc", at_m), expected_db, atol=0.6)
    data.save(tmp_path / "elsewhere" / "measurements.csv")  # with the file of the pattern
    assert len(read_measurements(tmp_path / "elsewhere" / "measurements.csv").patterns) == 1


def test_a_new_transmitters_antenna_counts_once_where_the_devices_declare_theirs(ground, tmp_path):
    """Gains measured through sectors; a planned one looks north."""
    (tmp_path / "tx.csv").write_text("device,x_m,y_m,z_m,tx_power_dbm,antenna,azimuth_deg\nnew,200,100,1.5,10,m/sector.csv,0\n")
    data = through_sectors(tmp_path / "m", "abc", "gain_db", antenna="sector.csv")
    planned = read_transmitters(tmp_path / "tx.csv", ground)
    settings = CoverageSettings(step_m=40.0, height_m=40.0, extent_m=(0, 400, 0, 400))
    coverage = predict_coverage(fit_twin(data, ground, model="log_distance"), ground, planned, settings)
    expected_dbm = 10 + truth_db((200, 100, 1.5), at_points(coverage.grid), 0.0)
    error_db = coverage.dataset["received_power_dbm"].values.ravel() - expected_dbm
    assert abs(np.median(error_db)) < 0.3 and np.abs(error_db).max() < 1.0
    assert not any("twice" in note for note in coverage.summary["notes"])
    undeclared = Measurements(data.table, data.devices.drop(columns=["antenna", "azimuth_deg"]))
    told = predict_coverage(fit_twin(undeclared, ground, model="log_distance"), ground, planned, settings)
    assert any("antenna of new is added to it: unless they are isotropic it counts twice" in note
               for note in told.summary["notes"])


def test_coverage_of_a_twin_of_known_powers_has_other_transmitters(ground, tmp_path):
    twin = fit_twin(powered(tmp_path / "m", ABC_DBM), ground, model="log_distance")
    (tmp_path / "tx.csv").write_text("device,x_m,y_m,z_m,tx_power_dbm\nnew,200,100,1.5,17\nlater,100,200,1.5,\na,60,60,1.5,\n")
    planned = read_transmitters(tmp_path / "tx.csv", ground)
    settings = CoverageSettings(step_m=40.0, height_m=40.0, extent_m=(0, 400, 0, 400), tx_power_dbm=3.0)
    for name, place_m, power_dbm in (("new", (200, 100), 17.0), ("later", (100, 200), 3.0), ("a", (60, 60), 0.0)):
        coverage = predict_coverage(twin, ground, planned, settings, devices=[name])
        expected_dbm = power_dbm + truth_db((*place_m, 1.5), at_points(coverage.grid))
        np.testing.assert_allclose(coverage.dataset["received_power_dbm"].values.ravel(), expected_dbm, atol=0.8)


def test_two_carriers_are_moved_by_20_lg_f(ground, tmp_path):
    carriers_hz = {"a": 1.8e9, "b": 2.2e9, "c": 2e9}
    data = campaign(tmp_path / "m", {name: {"frequency_hz": hz, "adds_db": -20 * np.log10(hz / 2e9)}
                                     for name, hz in carriers_hz.items()}, "gain_db")
    twin = fit_twin(data, ground, model="log_distance")
    at_m = np.array([[200.0, 180.0, 40.0]])
    expected_db = [truth_db((*PLACES_M[name], Z_M), at_m)[0] - 20 * np.log10(hz / 2e9) for name, hz in carriers_hz.items()]
    np.testing.assert_allclose(predicted_db(twin, ground, "abc", at_m), expected_db, atol=0.5)


def test_a_later_file_is_located_and_predicted_by_its_own_powers(ground, tmp_path):
    twin = fit_twin(powered(tmp_path / "m", ABC_DBM), ground, model="log_distance")
    later = powered(tmp_path / "later", {"u": 27.0}, seed=1)
    found, _ = locate_devices(later, twin, ground)
    assert np.hypot(found["x_m"][0] - 230, found["y_m"][0] - 240) < 8
    silent = campaign(tmp_path / "silent", {"u": {"adds_db": 10.0}}, seed=1)
    found, notes = locate_devices(silent, twin, ground)
    assert any("tx_power_dbm of u is not declared and taken for 10 dBm, the median of the twin's devices" in note for note in notes)
    assert np.hypot(found["x_m"][0] - 230, found["y_m"][0] - 240) < 8
    changed = powered(tmp_path / "changed", {"b": 5.0}, seed=3)
    error_db = predict(twin, ground, changed) - changed.level_db
    assert abs(error_db.mean()) < 0.5 and error_db.std() < 2


def test_antennas_act_along_each_path_where_paths_are_followed(ground, tmp_path):
    """A mast that looks down: the bounce leaves within the beam, the straight line above it (Fresnel, P.2040 concrete)."""
    write_sector(tmp_path / "sector.csv")
    antenna, hz = Antenna(read_pattern(tmp_path / "sector.csv"), 90.0, -12.0), 2e9
    device_m = np.array([[0.0, 0.0, 20.0]])
    receiver_m = np.column_stack([np.array([250.0, 330.0, 410.0]), np.zeros(3), np.full(3, 30.0)])
    across, wave = receiver_m[:, 0], 299_792_458 / hz
    eta = 5.24 - 1j * 0.0462 * (hz / 1e9) ** 0.7822 / (2 * np.pi * hz * 8.8541878128e-12)
    power = []
    for up, is_bounce in ((10.0, False), (-50.0, True)):
        length = np.hypot(across, up)
        sine = np.abs(up) / length
        root = np.sqrt(eta - 1 + sine**2)
        reflected = (eta * sine - root) / (eta * sine + root) if is_bounce else 1.0
        power.append((wave / (4 * np.pi * length)) ** 2 * np.abs(reflected) ** 2)
        power.append(10 ** (sector_dbi(0.0, np.degrees(np.arctan2(up, across)) + 12) / 10))
    direct, into_direct, bounce, into_bounce = power
    ends = Ends(device_names=["m"], device_m=device_m, anchors=frozenset([0]),
                declared=Declared((Radio(tx_power_dbm=13.0, cable_loss_db=2.0, antenna=antenna),), hz, True))
    links = Links(columns=Columns.unmeasured(receiver_m, np.zeros(3, int)), ends=ends,
                  world=World(frequency_hz=hz, city=ground.city, is_gain=False))
    channel = ImagePaths()
    level_db = channel.level_db(path_gains(links.geometry), links.geometry) + channel.declared_db(links)
    np.testing.assert_allclose(level_db, 11 + 10 * np.log10(direct * into_direct + bounce * into_bounce), atol=0.1)


def test_a_survey_through_antennas_of_the_scene_is_learnt_without_them(tmp_path):
    """The truth is the segmented law, in line of sight everywhere, through the sector of one device."""
    scene = write_scene(tmp_path / "scene", devices=[(name, *PLACES_M[name], Z_M) for name in "abc"], half_m=400.0, tx_power_dbm=0.0,
                        noise_dbm=-102.0)
    write_sector(scene.folder / "sector.csv")
    text = (scene.folder / "scene.toml").read_text().replace('role = "unknown"', 'role = "anchor"')
    text = text.replace('device = "a"\n', 'device = "a"\nantenna = "sector.csv"\nazimuth_deg = 45\n')
    text += '[[uavs]]\nuav = "u"\naltitude_m = 1.5\nstart_x_m = 0\nstart_y_m = 0\nterminal_x_m = 0\nterminal_y_m = 0\nbattery = 900\n'
    (scene.folder / "scene.toml").write_text(text)
    scene = Scene.load(scene.folder)
    truth = segmented_truth(scene)
    x_m, y_m = np.meshgrid(truth.lattice.x_m, truth.lattice.y_m)
    away_m = np.column_stack([x_m.ravel() - 60, y_m.ravel() - 60])
    expected_db = -30 - 25 * np.log10(np.hypot(*away_m.T)) + sector_dbi(np.degrees(np.arctan2(*away_m.T)) - 45, 0.0)
    np.testing.assert_allclose(truth.gain_db[0, 0].ravel(), expected_db, atol=0.02)
    data = fly_survey(scene, truth, flights=2, pattern="random-waypoint", seed=0)
    with pytest.warns(UserWarning, match="the antenna of b, c is not declared, as others' are, and taken for isotropic"):
        twin = fit_twin(data, scene, model="log_distance")
    error_db = twin.radio_map(scene).gain_db - truth.gain_db
    assert np.abs(error_db).max() < 1.0


def test_a_twins_map_tells_coverage_the_powers(ground, tmp_path):
    data = powered(tmp_path / "m", ABC_DBM)
    radio_map = fit_twin(data, ground, model="log_distance").radio_map(ground)
    radio_map.save(tmp_path / "map.nc")
    again = RadioMap.load(tmp_path / "map.nc")
    assert again.tx_power_dbm == ABC_DBM
    coverage = predict_coverage(again, ground)
    assert [each["tx_power_dbm"] for each in coverage.summary["transmitters"]] == [0.0, 20.0, 10.0]
    strongest_dbm = (again.gain_db[:, 0] + np.array([0.0, 20.0, 10.0])[:, None, None]).max(axis=0)
    np.testing.assert_allclose(coverage.dataset["received_power_dbm"], strongest_dbm, atol=1e-3)
    for wrong in ('{"a": 1e9}', '["a"]', "{", "7"):
        again.dataset.attrs["device_tx_power_dbm"] = wrong
        assert "not powers of devices" in form_problem(again.dataset)


def lobe_dbi(elevation_deg):
    """A receiver's antenna: 6 dBi at the horizon, 1 dB less for each 5 degrees up or down."""
    return 6 - np.abs(elevation_deg) / 5


def test_the_antenna_of_the_uavs_is_taken_off_and_put_back_where_uavs_receive(ground, tmp_path):
    """It would bend the law: devices are seen from 6 to 80 degrees. Receivers of coverage are isotropic; others are no UAVs."""
    scene = write_scene(tmp_path / "scene", tx_power_dbm=0.0, noise_dbm=-102.0)
    (scene.folder / "antennas").mkdir()
    rows = [f"{azimuth},{elevation},{lobe_dbi(elevation):.6f}" for elevation in range(-90, 91, 5) for azimuth in (0, 120, 240)]
    (scene.folder / "antennas" / "lobe.csv").write_text("azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(rows) + "\n")
    with (scene.folder / "scene.toml").open("a") as file:
        file.write('\n[[uavs]]\nuav = "r"\naltitude_m = 1.5\nstart_x_m = 0.0\nstart_y_m = 0.0\nterminal_x_m = 0.0\n'
                   'terminal_y_m = 0.0\nbattery = 60.0\nantenna = "antennas/lobe.csv"\n')
    scene = Scene.load(scene.folder)
    data = campaign(tmp_path / "m", {name: {"adds_db": 0.0} for name in "abc"}, "gain_db")
    device_m = data.device_m[data.device_index]
    up = data.receiver_m[:, 2] - device_m[:, 2]
    down_deg = -np.degrees(np.arctan2(up, np.hypot(*(data.receiver_m - device_m)[:, :2].T)))
    data.table["gain_db"] += lobe_dbi(down_deg)
    twin = fit_twin(data, scene, model="log_distance")
    twin.save(tmp_path / "twin")
    at_m = np.array([[75.0, 60.0, 40.0]])  # nearly above the first device
    steep_db = truth_db((*PLACES_M["a"], Z_M), at_m)[0]
    heard_db = steep_db + lobe_dbi(np.degrees(np.arctan2(38.5, 15.0)))
    assert predicted_db(Twin.load(tmp_path / "twin"), scene, "a", at_m)[0] == pytest.approx(heard_db, abs=0.7)
    source = source_of_twin(twin, scene, [Transmitter("a", np.array([*PLACES_M["a"], Z_M]))])
    assert source.predict(0, at_m, np.zeros(1, dtype=int))[0][0] == pytest.approx(steep_db, abs=0.7)
    assert np.abs(predict(twin, scene, data) - data.level_db).mean() < 1.5
    data.table["receiver"] = "phone"
    assert (predict(twin, scene, data) - data.level_db + lobe_dbi(down_deg)).std() < 2  # as if isotropic
    links = prepare_links(data, scene)
    assert links.declared.adds_nothing and any("receivers phone are none of its UAVs" in note for note in links.notes)


def test_held_out_errors_of_a_close_loop_are_those_of_the_gains(ground, tmp_path):
    data = powered(tmp_path / "m", ABC_DBM)
    gains = data.table.assign(gain_db=data.table["rssi_dbm"] - data.table["device"].map(ABC_DBM)).drop(columns="rssi_dbm")
    errors_db = []
    for each in (data, Measurements(gains, data.devices.drop(columns="tx_power_dbm"))):
        links = prepare_links(each, ground)
        folds = make_folds(links, 0, "block")
        model = cross_validate(links, make_bases(ground, 0)["log-distance"], folds)
        errors_db.append(links.level_db - model.held_out_mean_db)
    np.testing.assert_allclose(*errors_db, atol=1e-4)
    assert np.nanstd(errors_db[0]) == pytest.approx(SD_DB, abs=0.15)
