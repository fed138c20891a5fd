"""GeoParquet as pyarrow writes it after its description: systems, columns, nesting; and files that are none."""

import json

import numpy as np
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.readers.gis_files import read_geoparquet

pa = pytest.importorskip("pyarrow")
UTM = np.array([[0, 0], [20, 0], [20, 20], [0, 20]]) + [477_400, 5_261_000]
DEGREES = np.array([[8.7, 47.5], [8.7002, 47.5], [8.7002, 47.5001], [8.7, 47.5001]])
ABSENT = object()


def write(path, *rings, crs=ABSENT, encoding="WKB", geo=True, wkb=None, **columns):
    from pyarrow.parquet import write_table

    column = {"encoding": encoding, "geometry_types": ["Polygon"]} | ({} if crs is ABSENT else {"crs": crs})
    known = {"version": "1.1.0", "primary_column": "shape", "columns": {"shape": column}}
    table = pa.table({"shape": wkb or [shapely.to_wkb(shapely.Polygon(ring)) for ring in rings], **columns})
    write_table(table.replace_schema_metadata({"geo": json.dumps(known)} if geo else {}), path)
    return path


def test_columns_are_tags_and_nested_ones_are_left_out(tmp_path):
    path = write(tmp_path / "a.parquet", DEGREES, DEGREES + 0.01, height=[12.5, None], num_floors=[None, 3],
                 names=[{"primary": "a"}, {"primary": "b"}], bbox=[[1.0], [2.0]])
    first, second = read_geoparquet(path).features
    assert first.tags == {"height": "12.5", "building": "yes"} and second.tags == {"num_floors": "3", "building": "yes"}
    assert first.area.bounds == pytest.approx((8.7, 47.5, 8.7002, 47.5001))


@pytest.mark.parametrize("crs", [{"id": {"authority": "EPSG", "code": 32632}}, "json"])
def test_any_system(tmp_path, crs):
    from pyproj import CRS

    full = CRS("EPSG:32632").to_json_dict()
    full.pop("id")
    (one,) = read_geoparquet(write(tmp_path / "a.parquet", UTM, crs=full if crs == "json" else crs)).features
    assert one.area.bounds[:2] == pytest.approx((8.7, 47.5), abs=0.02)


@pytest.mark.parametrize(("how", "message"), [
    ({"geo": False}, "is Parquet without geometries"), ({"encoding": "polygon"}, "are encoded as 'polygon'; only WKB"),
    ({"crs": {"type": "GeographicCRS"}}, "its coordinate reference system is unknown"),
    ({"crs": [1]}, "is not as GeoParquet has it"), ({"wkb": [b"\1\3\0"]}, "a geometry is damaged"),
    ({"cut": 200}, "cannot be read as Parquet"), ({"most": "1"}, "2 buildings; at most 1 are read")])
def test_files_that_are_refused(tmp_path, monkeypatch, how, message):
    path = write(tmp_path / "a.parquet", DEGREES, DEGREES, **{key: how[key] for key in how if key not in ("cut", "most")})
    path.write_bytes(path.read_bytes()[:how.get("cut")])
    monkeypatch.setenv("RADIOTWIN_MAX_FEATURES", how.get("most", "9"))
    with pytest.raises(BadInput, match=message):
        read_geoparquet(path)


def test_a_file_without_a_system_needs_one(tmp_path):
    path = write(tmp_path / "a.parquet", UTM, crs=None)
    with pytest.raises(BadInput, match="a.parquet has no coordinate reference system; declare it with --crs"):
        read_geoparquet(path)
    (one,) = read_geoparquet(path, "EPSG:32632").features
    assert one.area.bounds[:2] == pytest.approx((8.7, 47.5), abs=0.02)
    named = write(tmp_path / "b.parquet", UTM, crs={"id": {"authority": "EPSG", "code": 32632}})
    assert read_geoparquet(named, "EPSG:32632").features
    with pytest.raises(BadInput, match="is in 'WGS 84 / UTM zone 32N', and --crs says 'WGS 84 / UTM zone 33N'"):
        read_geoparquet(named, "EPSG:32633")
