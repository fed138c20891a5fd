"""Reading and writing of measurements: what is accepted, and how the rest is refused."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.geo import write_frame
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import Measurements, read_measurements

DEVICES = "device,x_m,y_m,z_m,role\na,10,20,1.5,anchor\nb,,,1.5,unknown\n"
HEADER = "time_s,flight,receiver,receiver_x_m,receiver_y_m,receiver_z_m,device,gain_db\n"
ROWS = "0,f0,uav0,0,0,55,a,-80.5\n2,f0,uav0,20,0,55,b,\n,f1,uav0,40,0,,a,-90\n"


@pytest.fixture
def write(tmp_path):
    def write(text: str, devices: str = DEVICES):
        (tmp_path / "devices.csv").write_text(devices)
        path = tmp_path / "measurements.csv"
        path.write_text(text)
        return path
    return write


def test_reads_blank_gains_times_and_heights_as_nan(write):
    measurements = read_measurements(write(HEADER + ROWS))
    np.testing.assert_array_equal(measurements.level_db, [-80.5, np.nan, -90])
    np.testing.assert_array_equal(measurements.receiver_m[:, 2], [55, 55, np.nan])
    assert np.isnan(measurements.table["time_s"][2])
    assert measurements.flights == ["f0", "f1"]
    np.testing.assert_array_equal(measurements.device_index, [0, 1, 0])
    np.testing.assert_array_equal(measurements.is_anchor, [True, False])
    np.testing.assert_array_equal(measurements.device_m, [[10, 20, 1.5], [np.nan, np.nan, 1.5]])


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".CSV.GZ", ".PARQUET"])
def test_written_and_read_again_is_the_same(write, tmp_path, suffix):
    if suffix.lower() == ".parquet":
        pytest.importorskip("pyarrow")
    measurements = read_measurements(write(HEADER + ROWS))
    path = tmp_path / "again" / f"m{suffix}"
    measurements.save(path)
    again = read_measurements(path)
    np.testing.assert_array_equal(again.level_db, measurements.level_db)
    np.testing.assert_array_equal(again.receiver_m, measurements.receiver_m)
    assert again.table.equals(measurements.table) and again.devices.equals(measurements.devices)


def test_a_parquet_table_that_was_sorted_and_filtered_before_is_read_in_its_own_order(write, tmp_path):
    pytest.importorskip("pyarrow")
    plain = read_measurements(write(HEADER + ROWS))
    plain.table.iloc[[2, 1]].to_parquet(tmp_path / "m.parquet")
    plain.devices.iloc[::-1].to_parquet(tmp_path / "devices.parquet")
    again = read_measurements(tmp_path / "m.parquet", tmp_path / "devices.parquet")
    np.testing.assert_array_equal(again.level_db, [-90, np.nan])
    assert [again.devices["device"][row] for row in again.device_index] == ["a", "b"]
    np.testing.assert_array_equal(again.is_anchor, [False, True])
    plain.devices.set_index("device").to_parquet(tmp_path / "named.parquet")  # the index is a column like any other
    np.testing.assert_array_equal(read_measurements(tmp_path / "m.parquet", tmp_path / "named.parquet").is_anchor,
                                  [True, False])


@pytest.mark.parametrize(("names", "message"), [
    (["a", None, "a"], "row 3, column device: '' is empty"), ([1, None, 1], "row 3, column device: '' is empty"),
    ([b"a", b"\xff", b"a"], r"row 3, column device: .* is not text in UTF-8"), ([None] * 3, "row 2, column device: '' is empty"),
    ([["a"], ["a"], ["a"]], "column device holds lists or records"), ([{"a": 1}] * 3, "column device holds lists or records")])
@pytest.mark.parametrize("of", ["m", "devices"])
def test_names_of_a_parquet_table(write, tmp_path, names, message, of):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow.parquet import read_table, write_table

    plain = read_measurements(write(HEADER + ROWS))
    plain.table.to_parquet(tmp_path / "m.parquet")
    plain.devices.iloc[[0, 1, 1]].to_parquet(tmp_path / "devices.parquet")
    path = tmp_path / f"{of}.parquet"
    table = read_table(path)
    at = table.column_names.index("device")
    write_table(table.set_column(at, "device", pyarrow.array(names)), path)
    with pytest.raises(BadInput, match=f"{of}.parquet: {message}"):
        read_measurements(tmp_path / "m.parquet", tmp_path / "devices.parquet")


def test_whole_numbers_are_names(write, tmp_path):
    """Beside an empty role a column of numbers is one of floating ones: 17 is no device 17.0."""
    pytest.importorskip("pyarrow")
    plain = read_measurements(write(HEADER + ROWS))
    plain.table.assign(device=[17, 18, 17], flight=[1.0, 1.0, 2.0]).to_parquet(tmp_path / "m.parquet")
    plain.devices.assign(device=[17.0, 18.0]).to_parquet(tmp_path / "devices.parquet")
    again = read_measurements(tmp_path / "m.parquet", tmp_path / "devices.parquet")
    assert list(again.devices["device"]) == ["17", "18"] and again.flights == ["1", "2"]


@pytest.mark.parametrize(("text", "message"), [
    (HEADER.replace(",gain_db", "") + "0,f,u,0,0,5,a\n", r"gain_db"),
    (HEADER.replace("receiver_y_m,", "") + "0,f,u,0,5,a,-80\n", r"column 'receiver_y_m' is missing"),
    (HEADER + "0,f,u,zero,0,5,a,-80\n", r"row 2, column receiver_x_m: 'zero' is not a number"),
    (HEADER + "0,f,u,0,0,5,a,-80\n0,f,u,0,0,5,a,weak\n", r"row 3, column gain_db: 'weak' is not a number"),
    (HEADER + "0,f,u,0,0,5,a,-inf\n", r"row 2, column gain_db: '-inf' is not finite; leave the cell empty"),
    (HEADER + "0,f,u,0,0,5,a,nan\n", r"row 2, column gain_db: 'nan' is not a number; leave the cell empty"),
    (HEADER + "0,f,u,,0,5,a,-80\n", r"row 2, column receiver_x_m: '' is empty"),
    (HEADER + "0,f,u,0,0,5,c,-80\n", r"row 2, column device: 'c' is not in .*devices.csv"),
    (HEADER + "0,f,u,0,0,5,,-80\n", r"row 2, column device: '' is empty"),
    (HEADER, r"no rows"),
    (HEADER + "0,f,u,0,0,5,a,3.5\n", r"row 2, column gain_db: '3.5' is above 0 dB.*rssi_dbm"),
    (HEADER + "0,f,u,0,0,5,a,-301\n", r"row 2, column gain_db: '-301' is no level; allowed are -300 to 300"),
    (HEADER.replace("gain_db", "rssi_dbm") + "0,f,u,0,0,5,a,1e3\n", r"row 2, column rssi_dbm: '1e3' is no level"),
    (HEADER + "0,f,u,0,0,5,a,-80\n0,f,u,0,-2e7,5,a,-80\n",
     r"row 3, column receiver_y_m: '-2e7' is too far away; allowed are -1e\+07 to 1e\+07 m"),
    (HEADER + "0,f,u,0,0,5,a,-80\n0,f,u,0,0,5,a\n", r"row 3 has 7 fields, the header has 8"),
    (HEADER.replace(",", ";") + "0;f;u;0;0;5;a;-80,5\n", r"comma-separated, UTF-8"),
    (HEADER.replace("gain_db", "gain_db,rssi_dbm") + "0,f,u,0,0,5,a,-80,-60\n", "exactly one"),
    (HEADER + "1e308,f,u,0,0,5,a,-80\n", r"'1e308' is no time; allowed are -1e.11 to 1e.11 s; the unit is s, not ms"),
    (HEADER + "0,f,u,0,0,5,a,-80\n9e9,f,u,0,0,5,a,-80\n", "more than a century"),
    (HEADER.replace("time_s", "heading_deg") + "1e300,f,u,0,0,5,a,-80\n", "is out of range"),
    (HEADER.replace("time_s", "quality") + "-1e300,f,u,0,0,5,a,-80\n", "is out of range"),
    (HEADER + "0,f,u,0,0,5,a,-" + "9" * 5000 + "\n", "row 2, column gain_db: '-9999.*… is n"),
])
def test_bad_rows_name_file_row_and_column(write, text, message):
    path = write(text)
    with pytest.raises(BadInput, match=message) as error:
        read_measurements(path)
    assert str(path) in str(error.value) and len(str(error.value)) < 1000


@pytest.mark.parametrize(("devices", "message"), [
    ("device,x_m,y_m,z_m,role\na,1,2,3,anchr\n", r"row 2, column role: 'anchr' is no role; allowed are"),
    ("device,x_m,y_m,z_m,role\na,,2,3,anchor\n", r"row 2: anchor 'a' has no x_m, y_m"),
    ("device,x_m,y_m,z_m,role\na,1,2,3e7,anchor\n", r"row 2, column z_m: '3e7' is too far away"),
    ("device,x_m,y_m,z_m,role,tilt_deg\na,1,2,3,anchor,-91\n", r"row 2, column tilt_deg: '-91' is no tilt; allowed are -90"),
    ("device,x_m,y_m,z_m,role\na,1,2,3,anchor\na,1,2,3,anchor\n", r"row 3, column device: 'a' occurs twice"),
])
def test_bad_devices(write, devices, message):
    with pytest.raises(BadInput, match=message):
        read_measurements(write(HEADER + ROWS, devices))


def test_a_parquet_file_with_one_name_twice(write, tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    write(HEADER + ROWS)
    parquet.write_table(pyarrow.table([[1.0], [2.0]], names=["gain_db", "gain_db"]), tmp_path / "m.parquet")
    with pytest.raises(BadInput, match="column 'gain_db' occurs twice"):
        read_measurements(tmp_path / "m.parquet")


def test_files_that_are_not_tables_and_tables_that_need_others(tmp_path, write, monkeypatch):
    path = write(HEADER + ROWS)
    with pytest.raises(BadInput, match="does not exist"):
        read_measurements(tmp_path / "no.csv")
    with pytest.raises(BadInput, match="unknown format"):
        read_measurements(tmp_path / "measurements.xlsx")
    (tmp_path / "m.csv.gz").write_bytes(b"not gzip")
    with pytest.raises(BadInput, match="cannot be read"):
        read_measurements(tmp_path / "m.csv.gz")
    with monkeypatch.context() as few, pytest.raises(BadInput, match="RADIOTWIN_MAX_DEVICES"):
        few.setenv("RADIOTWIN_MAX_DEVICES", "1")
        read_measurements(path)
    (tmp_path / "devices.csv").write_text("device,lat,lon,altitude_m\na,48.1,11.5,530\nb,48.1,11.5,520\n")
    with pytest.raises(BadInput, match="devices.csv: latitude and longitude need the origin"):
        read_measurements(path)
    write_frame(Origin(latitude_deg=48.1, longitude_deg=11.5, altitude_m=520.0), tmp_path / "frame.toml")
    np.testing.assert_allclose(read_measurements(path).device_m, [[0, 0, 10], [0, 0, 0]], atol=1e-6)
    (tmp_path / "devices.csv").unlink()
    with pytest.raises(BadInput, match=r"devices\.csv does not exist; .*device, x_m, y_m, z_m, role .*--devices"):
        read_measurements(path)


def test_links_do_not_take_the_name_of_the_devices(write, tmp_path):
    measurements = read_measurements(write(HEADER + ROWS))
    with pytest.raises(BadInput, match="give the links another name"):
        measurements.save(tmp_path / "new" / "devices.csv")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("other", ["device,x_m,y_m,z_m,role\na,1,2,3,anchor\n", "my gadgets\nphone\n"])
def test_a_table_of_other_devices_is_not_overwritten(write, tmp_path, other):
    measurements = read_measurements(write(HEADER + ROWS))
    (tmp_path / "out").mkdir()
    devices = tmp_path / "out" / "devices.csv"
    devices.write_text(other)
    with pytest.raises(BadInput, match="is not overwritten"):
        measurements.save(tmp_path / "out" / "m.csv")
    assert devices.read_text() == other and list((tmp_path / "out").iterdir()) == [devices]
    devices.write_text("device,x_m,y_m,z_m,role\nb,,,9,unknown\na,1,2,3,anchor\n")
    measurements.save(tmp_path / "out" / "m.csv")
    assert read_measurements(tmp_path / "out" / "m.csv").devices.equals(measurements.devices)


@pytest.mark.parametrize("name", ["a\x1b[2J", "a\u202eb", "a\nb", "\u2066a", "x" * 10_000, "a\tb", "\x7f"])
def test_names_that_show_as_something_else(write, name):
    quoted = f'"{name}"'
    for devices in (DEVICES, DEVICES.replace("\na,", f"\n{quoted},")):
        with pytest.raises(BadInput, match="column (device|flight): .* is no name; it has") as error:
            read_measurements(write(HEADER + f"0,{quoted},u,0,0,5,a,-80\n", devices))
        assert len(str(error.value)) < 500 and "\x1b" not in str(error.value)


def test_names_of_any_other_kind_survive(write, tmp_path):
    names = ["=cmd()", "'=x", "../../etc", "Zürich-東京", "-5", "a\u200cb", "@x", "'"]
    devices = "device,x_m,y_m,z_m,role\n" + "".join(f"{name},1,2,3,anchor\n" for name in names[1:])
    rows = "".join(f"0,f,u,0,0,5,{name},-80\n" for name in names[2:])
    measurements = read_measurements(write(HEADER + rows, devices.replace("'=x", "''=x")))
    assert list(measurements.devices["device"]) == names[1:]
    for suffix in (".csv", ".csv.gz"):
        measurements.save(tmp_path / "again" / f"m{suffix}")
        again = read_measurements(tmp_path / "again" / f"m{suffix}")
        assert again.table.equals(measurements.table) and again.devices.equals(measurements.devices)


def test_an_anchor_at_the_end_of_the_world(write):
    devices = DEVICES + "c,9e6,0,1.5,anchor\n"
    with pytest.raises(BadInput, match=r"devices.csv: row 4: anchor 'c' at \(9e\+06, 0\) m is more than 1000 km"):
        read_measurements(write(HEADER + ROWS, devices))
    assert len(read_measurements(write(HEADER + ROWS, DEVICES + "c,9e5,0,1.5,anchor\n")).devices) == 3


def test_a_table_of_devices_that_nobody_named_is_in_its_folder(write, tmp_path):
    path = write(HEADER + ROWS)
    (tmp_path / "work").mkdir()
    path = path.rename(tmp_path / "work" / "measurements.csv")
    (tmp_path / "work" / "devices.csv").symlink_to(tmp_path / "devices.csv")
    with pytest.raises(BadInput, match="link out of its folder; name the table .* --devices"):
        read_measurements(path)
    assert len(read_measurements(path, tmp_path / "work" / "devices.csv").devices) == 2


def test_heights_above_the_ground():
    table = pd.DataFrame({"flight": "f", "receiver": "r", "receiver_x_m": [10.0, 20.0], "receiver_y_m": 0.0,
                          "receiver_z_m": [np.nan, 70.0], "receiver_above_ground_m": [5.0, np.nan], "device": "d",
                          "gain_db": -80.0})
    devices = pd.DataFrame({"device": ["d", "e"], "x_m": [30.0, np.nan], "y_m": [0.0, np.nan], "z_m": [np.nan, 9.0],
                            "role": ["anchor", "unknown"], "above_ground_m": [2.0, np.nan]})
    data = Measurements(table, devices)
    on_slope = data.on_ground(lambda x_m, y_m: 0.5 * x_m)
    assert on_slope.receiver_m[:, 2].tolist() == [10, 70] and on_slope.device_m[:, 2].tolist() == [17, 9]
    assert "above_ground_m" not in on_slope.devices
    assert data.on_ground(None).receiver_m[:, 2].tolist() == [5, 70]
    with pytest.raises(BadInput, match=r"row 2: receiver_z_m \(above the datum\) and receiver_above_ground_m are both"):
        Measurements(table.assign(receiver_z_m=1.0), devices).on_ground(None)
    with pytest.raises(BadInput, match="devices, row 3: above_ground_m needs a known position"):
        Measurements(table, devices.assign(above_ground_m=2.0, z_m=np.nan)).on_ground(lambda x_m, y_m: x_m)


def test_columns_that_are_not_used_are_noted(tmp_path):
    path = tmp_path / "measurements.csv"
    path.write_text(HEADER.strip() + ",remark\n0,f,u,0,0,5,a,-80,fine\n")
    (tmp_path / "devices.csv").write_text("cell,Easting,x_ft,y_ft,antenna_height,owner\na,1,10,20,30,me\n")
    with pytest.raises(BadInput, match="'antenna_height': the unit of its numbers from 30 to 30 is not known"):
        read_measurements(path)
    (tmp_path / "devices.csv").write_text("cell,x_ft,y_ft,antenna_height_m,downtilt,owner\na,10,20,30,6,me\n")
    found = read_measurements(path)
    assert found.devices.to_dict("records")[0] == {
        "device": "a", "x_m": 3.048, "y_m": 6.096, "z_m": pytest.approx(np.nan, nan_ok=True), "role": "anchor",
        "above_ground_m": 30.0, "tilt_deg": -6.0}
    assert found.notes == (f"{path.name}: column not used: remark", "devices.csv: column not used: owner")
    path.write_text(HEADER.replace("gain_db", "gain_db,heading_degs").strip() + "\n0,f,u,0,0,5,a,-80,9\n")
    with pytest.raises(BadInput, match="column 'heading_degs' is nearly 'heading_deg'"):
        read_measurements(path)
