"""Every kind of file, and what is no such file."""

import gzip
import json

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.read_source import read_source
from radiotwin.importing.settings import read_settings

TEXT = "device,x,y,level\na,0,0,-80\nb,3,4,-90\n"


@pytest.fixture
def points():
    def point(x, y, **properties):
        return {"type": "Feature", "geometry": {"type": "Point", "coordinates": [x, y, 30.0]},
                "properties": properties}
    return {"type": "FeatureCollection", "features": [point(11.5, 48.1, cell=7, rsrp=-80.5),
                                                      point(11.6, 48.2, cell=8, rsrp=-99)]}


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


def test_numbers_beyond_whole_ones_are_read_as_they_are(bring_in, local, tmp_path):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"device": [1e20, 7.0], "x": [0, 3], "y": [0.0, 4.0], "level": [-80, -90.0]}, index=[5, 3])
    frame.to_parquet(tmp_path / "made.parquet")
    made = bring_in((tmp_path / "made.parquet").read_bytes(), "data.parquet", columns=local, length_unit="m")
    assert list(made.table["device"]) == ["1e+20", "7.0"] and list(made.table["receiver_x_m"]) == [0, 3]


def test_points_of_geojson(bring_in, points):
    result = bring_in(json.dumps(points), "data.geojson", length_unit="m", columns={
        "latitude": "latitude", "longitude": "longitude", "altitude": "altitude", "device": "cell", "level": "rsrp"})
    points["features"][0]["properties"] = ["odd"]
    with pytest.raises(BadInput, match="feature 1, column rsrp: '' is empty"):
        bring_in(json.dumps(points), "odd.geojson", columns={"latitude": "latitude", "longitude": "longitude",
                                                             "device": "cell", "level": "rsrp"})
    assert list(result.table["device"]) == ["7", "8"] and list(result.table["rssi_dbm"]) == [-80.5, -99]
    assert result.report["origin"] == {"latitude_deg": 48.15, "longitude_deg": 11.55, "altitude_m": 0.0}
    assert (np.sign(result.table[["receiver_x_m", "receiver_y_m"]]).to_numpy() == [[-1, -1], [1, 1]]).all()
    assert list(result.table["receiver_z_m"]) == [30, 30]


@pytest.mark.parametrize(("change", "message"), [
    (lambda d: d["features"][1]["geometry"].update(type="Polygon", coordinates=[[[0, 0], [1, 0], [1, 1], [0, 0]]]),
     "feature 2 is Polygon; allowed are points"),
    (lambda d: d["features"][1].update(geometry=None), "feature 2 is without a geometry"),
    (lambda d: d["features"][0]["geometry"].update(coordinates=[11.5]), "feature 1"),
    (lambda d: d.update(crs={"properties": {"name": "EPSG:1"}}), "its crs 'EPSG:1' cannot be read.*--crs"),
    (lambda d: d.update(features=[]), "has no rows"),
    (lambda d: d.pop("features"), "FeatureCollection"),
])
def test_geojson_that_is_not_points(points, tmp_path, change, message):
    change(points)
    path = tmp_path / "data.geojson"
    path.write_text(json.dumps(points))
    with pytest.raises(BadInput, match=message):
        read_source(path)


@pytest.mark.parametrize(("name", "content", "message"), [
    ("data.geojson", b"{", "is not readable JSON"), ("data.csv", b"", "is empty"), ("data.csv", b"a,b\n", "has no rows"),
    ("data.csv", b"a,b\n1\n", "line 2 has 1 fields"), ("data.csv.gz", b"no", "cannot be read"),
    ("data.parquet", b"no", "cannot be read"), ("data.kml", b"no", "unknown format; allowed.*geojson"),
    ("data.csv", "a,b\nü,1\n".encode("utf-16-le"), "is not text .it has null characters")])
def test_files_that_are_not_tables(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=message):
        read_source(tmp_path / name)


def test_gaps_and_infinities_of_parquet(bring_in, local, tmp_path):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"device": "a", "x": pd.array([0, 3], dtype="Int64"), "y": [0, 4], "level": [-np.inf, -80],
                          "z": pd.array([None, 4], dtype="Int64")})
    frame.to_parquet(tmp_path / "made.parquet")
    result = bring_in((tmp_path / "made.parquet").read_bytes(), "data.parquet", columns=local | {"z": "z"},
                      length_unit="m", not_detected=["-inf"])
    np.testing.assert_array_equal(result.table["rssi_dbm"], [np.nan, -80])
    np.testing.assert_array_equal(result.table["receiver_z_m"], [np.nan, 4])


def test_names_that_are_numbers_stay_whole(bring_in, local, tmp_path):
    """A cell id in a column with a gap is read as 7.0 by many; here it is 7."""
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"device": [7.0, np.nan], "x": [0, 3], "y": [0, 4], "level": [-80, -90]})
    frame.to_parquet(tmp_path / "made.parquet")
    result = bring_in((tmp_path / "made.parquet").read_bytes(), "data.parquet", columns=local, length_unit="m")
    assert list(result.table["device"]) == ["7"]
    assert result.report["left_out"][0] == {"reason": "no device", "column": "device", "readings": 1, "first": "row 2"}


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
