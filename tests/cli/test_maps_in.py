"""Maps through the real command line: good ones become scenes, broken ones one message and nothing else."""

from pathlib import Path

import pytest

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
BOX = "<way id='1'><nd ref='1'/><nd ref='2'/><nd ref='3'/><nd ref='1'/><tag k='building' v='yes'/></way>"
NODES = "<node id='1' lat='1' lon='1'/><node id='2' lat='1' lon='1.001'/><node id='3' lat='1.001' lon='1'/>"
GEO = '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": {"type": \
"Polygon", "coordinates": [[[%s, 47], [8.001, 47], [8, 47.001], [%s, 47]]]}}]}'


def test_a_map_becomes_a_scene(run, tmp_path):
    box = "--bbox 47.4998,8.699,47.5002,8.7001 --height-default 7 --material straw=wood --devices 1"
    result = run(f"build-scene {TOWN} -o scene {box}", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "heights from" in result.stdout and "default: 1 (7 m)" in result.stdout
    assert "wrote scene: buildings.csv, city.xml, meshes/, preview.png, scene.toml" in result.stdout
    assert (tmp_path / "scene" / "preview.png").read_bytes()[:4] == b"\x89PNG"


BAD = {
    "not XML": ("a.osm", "not XML", "", ["a.osm, line 1, column 1", "malformed XML"]),
    "cut off": ("a.osm", f"<osm>{NODES}<way", "", ["a.osm, line 1", "malformed XML"]),
    "another XML": ("a.osm", "<gpx/>", "", ["begins with <gpx>, not <osm>"]),
    "no buildings": ("a.osm", f"<osm>{NODES}</osm>", "", ["holds no buildings"]),
    "entities": ("a.osm", '<!DOCTYPE osm [<!ENTITY a "b">]><osm>&a;</osm>', "", ["line 1: declares the entity"]),
    "not JSON": ("a.geojson", "{", "", ["a.geojson is not readable JSON"]),
    "not degrees": ("a.geojson", GEO % (500_000, 500_000), "", ["no longitude and latitude in degrees"]),
    "not PBF": ("a.osm.pbf", "x", "", ["a.osm.pbf is not a readable .osm.pbf file"]),
    "not a package": ("a.gpkg", "x", "", ["a.gpkg is not a readable GeoPackage"]),
    "no file": ("b.osm", "", "", ["a.osm does not exist; give the path of a map"]),
    "box": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--bbox 1,2,3", ["--bbox '1,2,3' is not 4 numbers"]),
    "box upside down": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--bbox 2,0,1,3", ["the south below the north"]),
    "height": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--height-default -3", ["default height of -3 m"]),
    "material": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--material brick=cheese", ["no ITU material 'cheese'"]),
    "table": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--material-table none.toml", ["none.toml does not exist"]),
    "scale": ("a.osm", f"<osm>{NODES}{BOX}</osm>", "--scale 2 --up y", ["--scale, --up cannot be used with it"]),
    "not a map": ("a.xml", "<scene/>", "--height-default 3", ["a.xml is not a map", "--height-default cannot be used"]),
    "download without a box": ("b.osm", "", "--overpass", ["--overpass downloads an area; give it with --bbox"]),
    "download of the world": ("b.osm", "", "--overpass --bbox 0,0,9,9", ["are too much for a public server"]),
}


@pytest.mark.parametrize("what", BAD)
def test_a_broken_map_is_refused(run, tmp_path, what):
    name, text, options, parts = BAD[what]
    (tmp_path / name).write_text(text)
    given = name.replace("b.osm", "a.osm")
    result = run(f"build-scene {given} -o scene {options}", cwd=tmp_path)
    said = result.stderr
    assert result.returncode == 2 and "Traceback" not in said and said.count("radiotwin:") == 1, said
    for part in parts:
        assert part in said, said
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_crs_is_for_maps_that_name_none(run, tmp_path):
    """A house in UTM: GeoJSON without its system, and Shapefiles with and without multipatches."""
    geojson = '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"height": 9}, "geometry": {"type": \
"Polygon", "coordinates": [[[477400, 5261000], [477420, 5261000], [477420, 5261020], [477400, 5261000]]]}}]}'
    (tmp_path / "a.geojson").write_text(geojson)
    result = run("build-scene a.geojson -o scene", cwd=tmp_path)
    assert result.returncode == 2 and "declare it with --crs" in result.stderr
    result = run("build-scene a.geojson -o scene --crs EPSG:32632", cwd=tmp_path)
    assert result.returncode == 0 and "latitude 47.5" in result.stdout
    for given, part in ((f"{TOWN} --crs EPSG:32632", "as all of OpenStreetMap; leave --crs out"),
                        ("a.geojson --crs EPSG:1", "--crs 'EPSG:1' is no coordinate reference system that is known"),
                        ("a.geojson --crs +init=/etc/passwd", "is no coordinate reference system that is known")):
        result = run(f"build-scene {given} -o other", cwd=tmp_path)
        assert result.returncode == 2 and part in result.stderr and not (tmp_path / "other").exists()


def test_geoparquet_and_multipatches_become_scenes(run, tmp_path):
    import pandas as pd

    from tests.scene.readers import test_geoparquet, test_multipatches

    test_geoparquet.write(tmp_path / "a.parquet", test_geoparquet.UTM, crs={"id": {"authority": "EPSG", "code": 32632}}, height=[12.5])
    test_multipatches.write(tmp_path, *test_multipatches.house())
    for name, top_m, source in (("a.parquet", 12.5, "height"), ("a.shp", 15, "model")):
        result = run(f"build-scene {name} -o scene", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        (row,) = pd.read_csv(tmp_path / "scene" / "buildings.csv").to_dict("records")
        assert (row["top_m"], row["height_from"]) == (top_m, source)
