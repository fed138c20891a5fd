import numpy as np
import pytest

from radiotwin.coverage import CoverageSettings, predict_coverage
from radiotwin.coverage.transmitters import (
    read_transmitters,
    with_powers,
)
from radiotwin.errors import BadInput
from radiotwin.geo import to_geographic, to_local, write_frame
from radiotwin.io.forms import Origin

PATTERN = "azimuth_deg,elevation_deg,gain_dbi\n" + "".join(
    f"{azimuth},{elevation},{10 - azimuth / 20}\n" for azimuth in (0, 90, 180, 270) for elevation in (-90, 0, 90))


@pytest.fixture
def scene(build):
    return build(devices=[("a", 0.0, 0.0, 10.0)])


def written(tmp_path, text):
    path = tmp_path / "sites.csv"
    path.write_text(text)
    return path


def test_every_column_is_read(scene, tmp_path):
    (tmp_path / "antennas").mkdir()
    (tmp_path / "antennas" / "sector.csv").write_text(PATTERN)
    path = written(tmp_path, "device,x_m,y_m,z_m,tx_power_dbm,load,frequency_hz,antenna,azimuth_deg,tilt_deg\n"
                             "s1,10,-20,30,43,0.5,2.1e9,antennas/sector.csv,120,-6\ns2,1,2,3,,,,,,\n")
    first, second = read_transmitters(path, scene)
    assert (first.name, first.tx_power_dbm, first.load, first.frequency_hz) == ("s1", 43.0, 0.5, 2.1e9)
    assert first.position_m.tolist() == [10, -20, 30]
    assert first.antenna.azimuth_deg == 120 and first.antenna.tilt_deg == -6
    assert first.antenna.pattern.peak_dbi == pytest.approx(10.0)
    assert second.antenna is second.tx_power_dbm is second.load is second.frequency_hz is None
    settings = CoverageSettings(tx_power_dbm=20.0, load=0.7, step_m=100.0)
    whole = predict_coverage("al_hourani_urban", scene, [first, second], settings).transmitters
    assert [(each.tx_power_dbm, each.load, each.frequency_hz) for each in whole] == [(43, 0.5, 2.1e9), (20, 0.7, 2e9)]
    assert with_powers([second], scene, None)[0].tx_power_dbm == 30.0  # the scene's


def test_positions_on_the_globe(scene, tmp_path):
    longitude, latitude = to_geographic(scene.config.origin, [100.0], [-50.0])
    path = written(tmp_path, f"device,latitude_deg,longitude_deg,z_m\ns1,{latitude[0]:.9f},{longitude[0]:.9f},5\n")
    np.testing.assert_allclose(read_transmitters(path, scene)[0].position_m, [100, -50, 5], atol=1e-3)


def test_positions_of_another_frame(scene, tmp_path):
    other = Origin(latitude_deg=47.501, longitude_deg=8.7)
    write_frame(other, tmp_path / "frame.toml")
    x_m, y_m = to_local(scene.config.origin, [other.longitude_deg], [other.latitude_deg])
    path = written(tmp_path, "device,x_m,y_m,z_m\ns1,0,0,5\n")
    np.testing.assert_allclose(read_transmitters(path, scene)[0].position_m, [x_m[0], y_m[0], 5], atol=1e-6)


def test_a_table_of_devices_is_one(scene, tmp_path):
    path = written(tmp_path, "device,x_m,y_m,z_m,role,azimuth_deg\nd0,1,2,3,anchor,90\n")
    with pytest.warns(UserWarning, match="no column antenna names the file"):
        (found,) = read_transmitters(path, scene)
    assert found.position_m.tolist() == [1, 2, 3] and found.antenna is None


@pytest.mark.parametrize(("text", "message"), [
    ("device,x_m,y_m,z_m\n", "has no rows"),
    ("device,x_m,y_m\ns,1,2\n", "row 2: transmitter 's' has no height; give it in a column z_m"),
    ("device,x_m,z_m\ns,1,2\n", "x and y are given together or not at all"),
    ("device,x_m,y_m,z_m\ns,1,2,3\ns,1,2,3\n", "row 3, column device: 's' occurs twice"),
    ("device,x_m,y_m,z_m\ns,1,,3\n", "row 2: transmitter 's' has no x, y"),
    ("device,x_m,y_m,z_m\ns,1,inf,3\n", "row 2, column y_m: 'inf' is not finite"),
    ("device,x_m,y_m,z_m,load\ns,1,2,3,1.2\n", "row 2, column load: '1.2' is no load; allowed are 0 to 1"),
    ("device,x_m,y_m,z_m,tx_power_dbm\ns,1,2,3,loud\n", "row 2, column tx_power_dbm: 'loud' is not a number"),
    ("device,x_m,y_m,z_m,frequency_hz\ns,1,2,3,2.4\n", "row 2, column frequency_hz: '2.4' is no frequency"),
    ("device,x_m,y_m,z_m,antenna,tilt_deg\ns,1,2,3,,95\n", "row 2, column tilt_deg: '95' is no tilt"),
    ("device,x_m,y_m,z_m,antenna\ns,1,2,3,../secret.msi\n", "row 2: .* leads out of"),
    ("device,x_m,y_m,z_m,antenna\ns,1,2,3,none.msi\n", "antenna .none.msi. is no file of a pattern.*antenna_model"),
    ("device,latitude_deg,longitude_deg,z_m\ns,95,2,3\n", "column latitude_deg: '95' is no latitude")])
def test_a_bad_cell_is_named(scene, tmp_path, text, message):
    with pytest.raises(BadInput, match=message):
        read_transmitters(written(tmp_path, text), scene)


def test_any_spelling_and_height(scene, tmp_path):
    (tmp_path / "sector.csv").write_text(PATTERN)
    longitude, latitude = to_geographic(scene.config.origin, [100.0], [-50.0])
    path = written(tmp_path, "Site;Lat;Lng;Antenna Height (ft);Power (W);Antenna;Azimuth;Downtilt;Owner\n"
                             f"s1;{latitude[0]:.9f};{longitude[0]:.9f};100;20;sector.csv;90;8;me\n")
    with pytest.warns(UserWarning, match="sites.csv: column not used: Owner"):
        (found,) = read_transmitters(path, scene)
    np.testing.assert_allclose(found.position_m, [100, -50, 30.48], atol=1e-3)
    assert found.tx_power_dbm == pytest.approx(43.01, abs=0.01)
    assert (found.antenna.azimuth_deg, found.antenna.tilt_deg) == (90, -8)


def test_what_is_probably_not_meant_is_told(scene, tmp_path):
    (tmp_path / "sector.csv").write_text(PATTERN)
    path = written(tmp_path, "device,x_m,y_m,z_m,antenna,tilt\ns1,10,-20,530,sector.csv,8\n")
    with pytest.warns(UserWarning) as told:
        read_transmitters(path, scene)
    texts = [str(each.message) for each in told]
    assert any("1 of 1 declared tilts are above zero" in text for text in texts)
    assert any("lowest of 1 sites is 530 m above the ground" in text for text in texts)
    origin = scene.config.origin
    path = written(tmp_path, f"device,lat,lon,z_m\ns1,{origin.longitude_deg},{origin.latitude_deg},30\n")
    with pytest.raises(BadInput, match="row 2: transmitter 's1' at latitude .* km from the map.*swapped"):
        read_transmitters(path, scene)
