import json

import numpy as np
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.readers.features import left_out_problems
from radiotwin.scene.readers.gis_files import read_geojson, read_geopackage
from tests.scene.readers.conftest import write_table

SQUARE = [[8.7, 47.5], [8.7002, 47.5], [8.7002, 47.5001], [8.7, 47.5001], [8.7, 47.5]]


def collection(*features, **more):
    return json.dumps({"type": "FeatureCollection", "features": features} | more)


def feature(rings=(SQUARE,), kind="Polygon", **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": list(rings)}}


def read(tmp_path, text):
    (tmp_path / "a.geojson").write_text(text)
    return read_geojson(tmp_path / "a.geojson")


def test_columns_are_tags(tmp_path):
    (one,) = read(tmp_path, collection(feature(HEIGHT=12.0, building_levels=4, name=None))).features
    assert one.tags == {"height": "12", "building:levels": "4", "building": "yes"}
    assert one.area.bounds == pytest.approx((8.7, 47.5, 8.7002, 47.5001))


HOLE = [[8.7001, 47.50002], [8.7001, 47.50008], [8.70015, 47.50008], [8.7001, 47.50002]]
WINGS = feature([[SQUARE, HOLE], [[[lon + 0.01, lat] for lon, lat in SQUARE]]], "MultiPolygon")
COLLECTION = {"type": "Feature", "properties": {}, "geometry": {"type": "GeometryCollection", "geometries": [
    {"type": "Point", "coordinates": SQUARE[0]}, {"type": "Polygon", "coordinates": [SQUARE]}]}}


@pytest.mark.parametrize(("row", "holes"), [(WINGS, [1, 0]), (COLLECTION, [0])])
def test_courtyards_wings_and_collections_of_geometries(tmp_path, row, holes):
    (one,) = read(tmp_path, collection(row)).features
    assert [len(part.interiors) for part in one.area.geoms] == holes
    assert one.area.geoms[0].bounds == pytest.approx((8.7, 47.5, 8.7002, 47.5001))


def test_where_buildings_are_marked_other_rows_are_ignored(tmp_path):
    found = read(tmp_path, collection(feature(building="yes"), feature(leisure="park"), feature(building="no"),
                                      {**feature(building="yes"), "geometry": None}))
    assert [one.name for one in found.features] == ["feature 1"]
    (said,) = left_out_problems(found.left_out, None)
    assert "no geometry" in said.message and "feature 4" in said.message


@pytest.mark.parametrize(("text", "message"), [
    ("{", "not readable JSON"), ("[]", "not a GeoJSON FeatureCollection"), ("[" * 100_000, "levels of nesting"),
    (collection(1), "feature 1 is not a GeoJSON feature"),
    (collection(feature([[[1, 2], [3]]])), "feature 1 has coordinates"),
    (collection(feature([[["a", 2]] * 4])), "feature 1 has coordinates"),
    (collection(feature([[[float("nan"), 2]] * 4])), "feature 1 has coordinates"),
    (collection({**feature(), "geometry": {"type": "Polygon", "coordinates": 7}}), "feature 1 has coordinates"),
    (collection(feature(), crs={"type": "link"}), "names no system"),
    (collection(feature(), crs={"properties": {"name": "EPSG:999999"}}), "EPSG:999999' is unknown"),
])
def test_broken_geojson(tmp_path, text, message):
    with pytest.raises(BadInput, match=message):
        read(tmp_path, text)


@pytest.fixture
def package(tmp_path):
    """A GeoPackage in UTM, of a square of 20 m and a point."""
    utm = np.array([[0, 0], [20, 0], [20, 20], [0, 20]]) + [477_400, 5_261_000]
    others = ['"building"=>"yes","height"=>"9"', '"building"=>"yes","building:levels"=>"3"']
    return write_table(tmp_path / "a.gpkg", [shapely.Polygon(utm), shapely.Polygon(utm + 50)], "EPSG:32632",
                       height=[12.5, np.nan], other_tags=others)


def test_a_geopackage_in_another_system(package):
    first, second = read_geopackage(package).features
    assert first.tags["height"] in ("9", "12.5") and second.tags["building:levels"] == "3"
    from pyproj import Geod

    area_m2, _ = Geod(ellps="WGS84").geometry_area_perimeter(first.area)
    assert abs(area_m2) == pytest.approx(400, rel=2e-3)  # UTM's scale is 0.9996


VRT = b"<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>a.gpkg</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>"


@pytest.mark.parametrize("data", [b"", b"SQLite format 3\x00", b"not a package", VRT])
def test_broken_geopackage(tmp_path, data):
    (tmp_path / "a.gpkg").write_bytes(data)
    with pytest.raises(BadInput, match="not a readable GeoPackage"):
        read_geopackage(tmp_path / "a.gpkg")
