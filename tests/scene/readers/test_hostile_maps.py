"""Maps that are made to read other files, or to take all time and memory: one message each."""

import math
import sqlite3

import pytest
import shapely

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.budgets import CROSSINGS, OUTLINE_CORNERS, OVERLAPS, PART_PAIRS, TOUCHING_CORNERS
from radiotwin.scene.materials import Names
from radiotwin.scene.readers import build_scene_from_map, overpass
from radiotwin.scene.readers.gis_files import _other_tags, read_geopackage
from radiotwin.scene.readers.osm import stitch
from tests.scene.readers.conftest import box, ring, write_geojson, write_table


def check(tmp_path, *rings, **more):
    path = write_geojson(tmp_path / "a.geojson", [(outline, {"building": "yes"}) for outline in rings], **more)
    return build_scene_from_map(path, tmp_path / "out", check_only=True)


def circle(corners, step=1):
    return ring([(100 * math.cos(2 * math.pi * i * step / corners),
                  100 * math.sin(2 * math.pi * i * step / corners)) for i in range(corners)])


@pytest.mark.parametrize(("budget", "limit", "rings", "message"), [
    (CROSSINGS, "1000", [circle(101, 50)], "feature 1: .* crossings .*RADIOTWIN_MAX_CROSSINGS"),
    (OUTLINE_CORNERS, "100", [box(300, 0), circle(101)], "feature 2: 102 corners; at most 100"),
    (OVERLAPS, "100", [box(0, 0)] * 20, "pairs of buildings that overlap; at most 100"),
    (PART_PAIRS, "100", [box(0, 0)] * 20, "400 pairs of a building, part or roof and one around it; .* RADIOTWIN_MAX_PART_PAIRS")])
def test_budgets(tmp_path, monkeypatch, budget, limit, rings, message):
    monkeypatch.setenv(budget.variable, limit)
    with pytest.raises(BadInput, match=message):
        check(tmp_path, *rings)
    assert check(tmp_path, circle(11, 5)).problems[0].severity in ("fixed", "warning")


def test_pairs_are_counted_before_they_are_cut(tmp_path, monkeypatch):
    monkeypatch.setenv(TOUCHING_CORNERS.variable, "1000")
    monkeypatch.setattr("shapely.intersection", None)
    with pytest.raises(BadInput, match="corners in pairs of buildings that touch; at most 1,000"):
        check(tmp_path, *[box(0, 0)] * 20)


@pytest.mark.parametrize("rings", [
    [[[179.999, 10], [-179.999, 10], [-179.999, 10.001], [179.999, 10]]],
    [[[x * 179.999, 10], [x * 179.9999, 10], [x * 179.9999, 10.0001], [x * 179.999, 10]] for x in (1, -1)],
    [[[-170, -80], [170, -80], [170, 80], [-170, 80], [-170, -80]]],
    [box(0, 0), [[-10, 47.4], [8.6, 47.4], [8.6, 47.40001], [-10, 47.4]]],
    [box(0, 0), [[-171.5, -47.4], [-171.4, -47.4], [-171.4, -47.3], [-171.5, -47.4]]]])
def test_as_large_as_the_earth(tmp_path, rings):
    with pytest.raises(BadInput, match="km wide"):
        check(tmp_path, *rings)


@pytest.mark.parametrize("name", ["+proj=latlong +nadgrids=/etc/passwd", "+init=/etc/passwd:1", "/etc/passwd:4326",
                                  'GEOGCS["a",EXTENSION["PROJ4","+nadgrids=/etc/passwd"]]'])
def test_a_system_that_names_a_file(tmp_path, name):
    with pytest.raises(BadInput, match="coordinate reference system"):
        check(tmp_path, box(0, 0), crs={"properties": {"name": name}})


def test_rare_tags_are_read_in_one_pass():
    assert _other_tags('"a"=>"1", "b c"=>"x\\"y"') == {"a": "1", "b c": 'x\\"y'}
    assert _other_tags('"' + '\\"' * 500_000) == {}


def test_many_ways_that_meet_in_one_node():
    chains = [[0, number] for number in range(1, 30_000)]
    assert stitch(chains) is None
    petals = [each for number in range(1, 60_000, 2) for each in ([0, number, number + 1], [number + 1, 0])]
    assert [len(nodes) for nodes in stitch(petals)] == [90_001]


def test_equal_names_are_numbered_in_one_pass():
    taken = Names(["a_3"])
    names = [taken.unique("A") for _ in range(50_000)]
    assert names[:4] == ["A", "A_2", "A_4", "A_5"] and len(set(names)) == 50_000


@pytest.fixture
def package(tmp_path):
    return write_table(tmp_path / "a.gpkg", [shapely.box(8.5, 47.4, 8.5002, 47.4001)], layer="houses", height=[9])


def alter(path, *commands):
    database = sqlite3.connect(path)
    for command in commands:
        database.execute(command)
    database.commit()
    database.close()


def test_a_layer_that_is_a_view(package):
    assert [one.tags["height"] for one in read_geopackage(package).features] == ["9"]
    triggers = [f'DROP TRIGGER "{name}"' for (name,) in sqlite3.connect(package).execute(
        "SELECT name FROM sqlite_master WHERE type = 'trigger'")]
    alter(package, *triggers, "ALTER TABLE houses RENAME TO hidden",
          "CREATE VIEW houses AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
          "SELECT fid, geom, height FROM hidden, n")
    with pytest.raises(BadInput, match="'houses' is a view"):
        read_geopackage(package)


def test_computed_columns_are_not_computed(package):
    alter(package, "ALTER TABLE houses ADD COLUMN bomb AS (zeroblob(900000000))")
    (one,) = read_geopackage(package).features
    assert one.tags == {"height": "9", "building": "yes"}


def test_a_package_with_changes_beside_it(package):
    package.with_name("a.gpkg-wal").write_bytes(b"x")
    with pytest.raises(BadInput, match="another program has it open"):
        read_geopackage(package)


class Answer:
    def __init__(self, parts, length=None):
        self.parts, self.length = iter(parts), length

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read1(self, _):
        return next(self.parts, b"")


@pytest.mark.parametrize(("answer", "setting", "message"), [
    (lambda: Answer(iter(lambda: b"x", None)), ("MAX_DOWNLOAD_S", 0.02), "has not ended after"),
    (lambda: Answer([b"x"], length=3), ("MAX_DOWNLOAD_S", 9), "cut off")])
def test_a_server_that_does_not_end_well(tmp_path, monkeypatch, answer, setting, message):
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: answer())
    monkeypatch.setattr(overpass, *setting)
    with pytest.raises(RunFailed, match=message):
        overpass.download_osm(tmp_path / "a.osm", (47.4, 8.5, 47.41, 8.51))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("srs", ["NULL", "'EPSG:25832'"])
def test_a_reference_system_that_is_no_number(package, srs):
    """Of SQLite's columns the type is a wish."""
    rows = f"SELECT table_name, column_name, geometry_type_name, {srs} AS srs_id, z, m FROM gpkg_geometry_columns"
    alter(package, f"CREATE TABLE copied AS {rows}", "DROP TABLE gpkg_geometry_columns",
          "ALTER TABLE copied RENAME TO gpkg_geometry_columns")
    with pytest.raises(BadInput, match="is not a readable GeoPackage .srs_id of 'houses'"):
        read_geopackage(package)
