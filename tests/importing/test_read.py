"""Every kind of file, and what is no such file."""

import gzip

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.read_source import read_source
from radiotwin.importing.settings import read_settings

TEXT = "device,x,y,level\na,0,0,-80\nb,3,4,-90\n"


def test_all_formats_give_the_same(bring_in, local, tmp_path):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"device": ["a", "b"], "x": [0, 3], "y": [0.0, 4.0], "level": [-80, -90.0]})
    frame.to_parquet(tmp_path / "made.parquet")
    given = {"columns": local, "length_unit": "m"}
    plain = bring_in(TEXT, **given)
    packed = bring_in(gzip.compress(TEXT.encode()), "data.csv.gz", **given)
    parquet = bring_in((tmp_path / "made.parquet").read_bytes(), "data.parquet", **given)
    pd.testing.assert_frame_equal(plain.table, packed.table)
    pd.testing.assert_frame_equal(plain.table, parquet.table)
    assert list(plain.table["receiver_x_m"]) == [0, 3] and list(plain.table["rssi_dbm"]) == [-80, -90]


WHOLE = pd.array([0, 3], dtype="Int64")


@pytest.mark.parametrize(("columns", "expected"), [
    ({"device": [1e20, 7.0]}, {"device": ["1e+20", "7.0"], "receiver_x_m": [0, 3]}),
    ({"device": [7.0, np.nan]}, {"device": ["7"]}),  # a cell id in a column with a gap is read as 7.0 by many
    ({"level": [-np.inf, -80], "z": pd.array([None, 4], dtype="Int64")}, {"rssi_dbm": [np.nan, -80], "receiver_z_m": [np.nan, 4]})])
def test_typed_columns_of_parquet(bring_in, local, tmp_path, columns, expected):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"device": "a", "x": WHOLE, "y": [0, 4], "level": [-80, -90], "z": 1} | columns, index=[5, 3])
    frame.to_parquet(tmp_path / "made.parquet")
    made = bring_in((tmp_path / "made.parquet").read_bytes(), "data.parquet", columns=local | {"z": "z"}, length_unit="m",
                    not_detected=["-inf"])
    for name, values in expected.items():
        assert made.table[name].tolist() == pytest.approx(values, nan_ok=True)
    assert all(each["reason"] == "no device" for each in made.report["left_out"])


@pytest.mark.parametrize(("name", "content", "message"), [
    ("data.geojson", b"{", "is not readable JSON"), ("data.csv", b"", "is empty"), ("data.csv", b"a,b\n", "has no rows"),
    ("data.csv", b"a,b\n1\n", "line 2 has 1 fields"), ("data.csv.gz", b"no", "cannot be read"),
    ("data.parquet", b"no", "cannot be read"), ("data.kml", b"no", "unknown format; allowed.*geojson"),
    ("data.csv", "a,b\nü,1\n".encode("utf-16-le"), "is not text .it has null characters")])
def test_files_that_are_not_tables(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=message):
        read_source(tmp_path / name)


def test_settings_name_tables_in_their_folder_or_the_current_one_only(tmp_path, monkeypatch):
    outside, work = tmp_path / "sites.csv", tmp_path / "work"
    (work / "own").mkdir(parents=True)
    outside.write_text("device,x,y,z\n")
    (work / "sites.csv").write_text("device,x,y,z\n")
    (work / "link.csv").symlink_to(outside)
    monkeypatch.chdir(work)
    settings = work / "own" / "import.toml"
    columns = '[columns]\nlevel = "l"\ndevice = "d"\nx = "x"\ny = "y"\n'
    for name in ("/etc/passwd", "../../sites.csv", "../link.csv"):
        settings.write_text(f'devices = "{name}"\n{columns}')
        with pytest.raises(BadInput, match="neither in its folder nor in the current one, nor beside"):
            read_settings(settings, {})
    settings.write_text(f'devices = "../sites.csv"\n{columns}')
    assert read_settings(settings, {}).devices == str(settings.parent / "../sites.csv")
    settings.write_text(f'devices = "../../sites.csv"\n{columns}')
    assert read_settings(settings, {}, tmp_path).devices and read_settings(settings, {"devices": "a"}).devices == "a"
