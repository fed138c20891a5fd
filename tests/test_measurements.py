"""Reading and writing of measurements: what is accepted, and how the rest is refused."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.measurements import read_measurements

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


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet"])
def test_written_and_read_again_is_the_same(write, tmp_path, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    measurements = read_measurements(write(HEADER + ROWS))
    path = tmp_path / "again" / f"m{suffix}"
    measurements.write(path)
    again = read_measurements(path)
    np.testing.assert_array_equal(again.level_db, measurements.level_db)
    np.testing.assert_array_equal(again.receiver_m, measurements.receiver_m)
    assert again.table.equals(measurements.table) and again.devices.equals(measurements.devices)


def test_select_keeps_the_devices(write):
    part = read_measurements(write(HEADER + ROWS)).select([False, True, False])
    assert len(part.table) == 1 and len(part.devices) == 2


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
])
def test_bad_rows_name_file_row_and_column(write, text, message):
    path = write(text)
    with pytest.raises(BadInput, match=message) as error:
        read_measurements(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(("devices", "message"), [
    ("device,x_m,y_m,z_m\na,1,2,3\n", "column 'role' is missing"),
    ("device,x_m,y_m,z_m,role\na,1,2,3,anchr\n", r"row 2, column role: 'anchr'; allowed are"),
    ("device,x_m,y_m,z_m,role\na,,2,3,anchor\n", r"row 2: anchor 'a' has no x_m, y_m"),
    ("device,x_m,y_m,z_m,role\na,1,2,3,anchor\na,1,2,3,anchor\n", r"row 3, column device: 'a' stands there twice"),
])
def test_bad_devices(write, devices, message):
    with pytest.raises(BadInput, match=message):
        read_measurements(write(HEADER + ROWS, devices))


def test_both_levels_are_one_too_many(write):
    text = HEADER.replace("gain_db", "gain_db,rssi_dbm") + "0,f,u,0,0,5,a,-80,-60\n"
    with pytest.raises(BadInput, match="exactly one"):
        read_measurements(write(text))


def test_files_that_are_not_tables(tmp_path, write):
    write(HEADER + ROWS)
    with pytest.raises(BadInput, match="does not exist"):
        read_measurements(tmp_path / "no.csv")
    with pytest.raises(BadInput, match="unknown format"):
        read_measurements(tmp_path / "measurements.xlsx")
    (tmp_path / "m.csv.gz").write_bytes(b"not gzip")
    with pytest.raises(BadInput, match="cannot be read"):
        read_measurements(tmp_path / "m.csv.gz")
