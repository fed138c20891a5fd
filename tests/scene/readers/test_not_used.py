"""What a map holds and a scene does not need is told: whatever it is called, in every format of maps.

Rationale: a column that is dropped in silence may be the height, in a unit or under a name that is not known.
Expected: a column (tag, attribute, layer) with a random name, of any type, is in the line "not used" of the report.
"""

import json
import random
import string

import pytest
import shapely

from radiotwin.scene.readers import build_scene
from tests.scene.readers import city_models
from tests.scene.readers.conftest import Map, box, write_table

VALUES = (7, -3.5, "text", True)
SQUARE = shapely.Polygon(box(0))


def write_geojson(path, columns):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature(columns)]}))


def feature(columns):
    return {"type": "Feature", "properties": {"height": 9} | columns, "geometry": shapely.geometry.mapping(SQUARE)}


def write_lines(path, columns):
    path.write_text(json.dumps(feature(columns)))


def write_geo_table(path, columns):
    write_table(path, [SQUARE], kind="Polygon Z" if SQUARE.has_z else "Polygon", height=[9.0],
                **{name: [value] for name, value in columns.items()})


def write_parquet(path, columns):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    table = pyarrow.table({"height": [9.0], "geometry": shapely.to_wkb([SQUARE])} | {
        name: [value] for name, value in columns.items()})
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB",
                                                                                      "geometry_types": []}}}
    parquet.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), path)


def write_osm(path, columns):
    Map().box(0, 0, 20, 20, height="9", **{name: str(value) for name, value in columns.items()}).write(path)


def write_overpass(path, columns):
    places = [{"lon": lon, "lat": lat} for lon, lat in box(0)]
    path.write_text(json.dumps({"elements": [{"type": "way", "id": 1, "geometry": places, "tags": {
        "building": "yes", "height": "9"} | {name: str(value) for name, value in columns.items()}}]}))


def write_cityjson(path, columns):
    model = city_models.cityjson([(0, 0, 1.2)])
    next(iter(model["CityObjects"].values()))["attributes"] = columns
    path.write_text(json.dumps(model))


@pytest.mark.parametrize(("name", "write"), [
    ("a.geojson", write_geojson), ("a.json", write_geojson), ("a.geojsonl", write_lines), ("a.gpkg", write_geo_table),
    ("a.shp", write_geo_table), ("a.parquet", write_parquet), ("a.osm", write_osm), ("b.json", write_overpass),
    ("a.city.json", write_cityjson)])
def test_a_column_of_any_name_is_told(tmp_path, name, write):
    rng = random.Random(name)
    columns = {"x" + "".join(rng.choices(string.ascii_lowercase + string.digits, k=rng.randint(1, 8))): value
               for value in VALUES}
    write(tmp_path / name, columns)
    told = not_used(tmp_path / name)
    assert all(f"'{column}'" in told for column in columns), (columns, told)


def not_used(path):
    return dict(build_scene(path, path.with_name("out"), check_only=True).facts).get("not used", "")


@pytest.mark.parametrize(("name", "write"), [("a.geojson", write_geojson), ("a.parquet", write_parquet)])
def test_nested_and_empty_columns_are_told(tmp_path, name, write):
    write(tmp_path / name, {"names": {"primary": "x"}, "sources": [{"dataset": "OSM"}], "nothing": None})
    assert not_used(tmp_path / name) == "tags or columns 'names', 'nothing', 'sources'"


@pytest.mark.parametrize("z_m", [0.0, 512.5])
@pytest.mark.parametrize(("name", "write"), [
    ("a.geojson", write_geojson), ("a.gpkg", write_geo_table), ("a.shp", write_geo_table), ("a.parquet", write_parquet)])
def test_elevations_in_the_coordinates_are_told(tmp_path, monkeypatch, name, write, z_m):
    monkeypatch.setitem(globals(), "SQUARE", shapely.force_3d(SQUARE, z_m))
    write(tmp_path / name, {})
    assert ("z of the coordinates" in not_used(tmp_path / name)) == (z_m > 0)
