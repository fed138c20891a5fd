"""A map becomes a scene that the rest of the package works with."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.geo import local_crs, to_local
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from tests.scene.readers.conftest import write_geojson

TOWN = Path(__file__).with_name("town.osm")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return build_scene_from_map(TOWN, tmp_path_factory.mktemp("town") / "scene", options=BuildOptions(devices=3))


@pytest.fixture(scope="module")
def table(report):
    return pd.read_csv(report.folder / "buildings.csv", keep_default_na=False).set_index("building")


def test_every_height_has_its_source(table, report):
    tops = {name: (row["top_m"], row["height_from"]) for name, row in table.iterrows()}
    assert tops["way/101"] == (12, "height") and tops["way/102"] == (12, "building:levels")
    assert tops["way/103"] == (10, "default") and tops["way/104"] == (10.058, "height")
    assert tops["way/105"] == (6, "building:levels") and table.loc["way/105", "unusable"] == "height=-5"
    assert table.loc["way/110", ["bottom_m", "top_m"]].tolist() == [5, 9]
    facts = dict(report.facts)
    assert facts["heights from"] == "height tag: 10, building:levels × 3 m: 4, default: 1 (10 m)"
    assert facts["buildings"] == "15 in 14 blocks"


def test_the_map_knows_how_well_it_knows_its_heights(table, report):
    told = {name: row["height_sd_m"] for name, row in table.iterrows()}
    assert (told["way/101"], told["way/102"], told["way/105"]) == (1.5, 3.0, 3.0)
    tops_m = table["top_m"][table["height_from"] != "default"]
    assert told["way/103"] == pytest.approx(max(np.sqrt(np.mean((tops_m - 10.0) ** 2)), 3.0), abs=0.06)
    city = Scene.load(report.folder).city
    for name in ("way/101", "way/103"):
        x_m, y_m = table.loc[name, ["x_m", "y_m"]]
        face = city.first_hits(np.array([[x_m, y_m, 99.0]]), np.array([[x_m, y_m, 0.0]]))[1]
        assert city.height_sd_m[face] == pytest.approx(told[name])
    below = city.first_hits(np.array([[-75.2, -8.5, 99.0]]), np.array([[-75.2, -8.5, -1.0]]))[1]
    assert np.isnan(city.height_sd_m[below]).all()  # the ground has no height


def test_defects_are_reported(report):
    said = "\n".join(problem.message for problem in report.problems)
    for part in ("'way/116'", "'way/115'", "no area: left out ('way/107')", "0.3 m wide: left out ('way/118')",
                 "way/105: height=-5", "way/119: straw", "way/113 and way/114: 30 m²", "taken apart ('way/106')"):
        assert part in said
    assert not report.tracing_would_fail


def test_the_scene_lies_where_the_map_says(report, table):
    scene = Scene.load(report.folder)
    assert scene.config.crs == local_crs(scene.config.origin)
    # way/101 as drawn: 20 x 12 m about latitude 47.49983, longitude 8.69934; the map's own degrees, projected
    x_m, y_m = to_local(scene.config.origin, np.array([8.6993361]), np.array([47.4998345]))
    assert scene.city.height_at(x_m, y_m) == pytest.approx([12.0], abs=1e-4)
    x, y = table.loc["relation/201", ["x_m", "y_m"]]
    assert scene.city.height_at(x, y) == pytest.approx(18.0, abs=1e-4)
    assert table.loc["relation/201", "area_m2"] == pytest.approx(50 * 40 - 26 * 20, rel=3e-3)
    assert scene.city.inside(np.array([[x, y, 9.0]]))[0]
    assert scene.city.height_at(-75.2, -8.5) == 0.0  # the courtyard
    bounds = scene.config.extent.bounds
    assert (table["x_m"].between(*bounds[:2]) & table["y_m"].between(*bounds[2:])).all()


def test_meshes_are_watertight_and_face_outwards(report, table):
    volume_m3 = 0.0
    for path in (report.folder / "meshes").glob("*.ply"):
        if path.stem != "ground":
            mesh = trimesh.load(path, process=False)
            assert mesh.is_volume, path
            volume_m3 += mesh.volume
    prisms_m3 = (table["area_m2"] * (table["top_m"] - table["bottom_m"])).sum()
    assert volume_m3 == pytest.approx(prisms_m3 - 30 * 7, rel=2e-3)  # 30 m² of way/114 are in way/113
    assert set(table["shape"]) == {path.stem for path in (report.folder / "meshes").glob("*.ply")} - {"ground"}


def test_a_box_of_degrees(tmp_path):
    box = 47.4998, 8.699, 47.5002, 8.7001
    report = build_scene_from_map(TOWN, tmp_path / "part", BuildOptions(bbox=box, default_height_m=4.5))
    scene = Scene.load(tmp_path / "part")
    table = pd.read_csv(tmp_path / "part" / "buildings.csv")
    assert set(table["building"]) == {"way/101", "way/102", "way/103", "relation/201"}
    assert table.set_index("building")["top_m"]["way/103"] == 4.5
    x_m, y_m = to_local(scene.config.origin, np.array([8.699, 8.7001]), np.array([47.4998, 47.5002]))
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    assert x_min <= x_m[0] and x_max >= x_m[1] and y_min <= y_m[0] and y_max >= y_m[1]
    assert x_max - x_min < x_m[1] - x_m[0] + 40 and report.extent_m == scene.config.extent.bounds


def test_the_table_of_materials_is_used(tmp_path):
    options = BuildOptions(materials={"straw": "itu_wood", "ground": "wet_ground"})
    report = build_scene_from_map(TOWN, tmp_path / "unused", options, check_only=True)
    assert {use.name: use.shapes for use in report.materials}["wood"] == 2
    assert "wet_ground" in {use.name for use in report.materials} and not (tmp_path / "unused").exists()
    assert "straw" not in "\n".join(problem.message for problem in report.problems)


@pytest.mark.parametrize(("options", "message"), [
    ({"bbox": (1, 2, 0, 3)}, "bbox .* is not possible"), ({"bbox": (float("nan"), 0, 1, 1)}, "not possible"),
    ({"bbox": (0, 0, 1, 1)}, r"no building reaches into --bbox .*the file's lie in 47\.\d+,8\.\d+"),
    ({"default_height_m": 0.0}, "default height of 0 m"), ({"default_height_m": float("inf")}, "default height")])
def test_impossible_options(tmp_path, options, message):
    with pytest.raises(BadInput, match=message):
        build_scene_from_map(TOWN, tmp_path / "out", BuildOptions(**options))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("boxes", "message"), [
    ([(0, 0, 20, 20), (90_000, 0, 90_020, 20)], "the area is 90 km wide, 50 km are allowed; choose a part with --bbox"),
    ([(0, 0, 0, 20)], "none of its 1 buildings can be used; correct what is wrong with them:\n.*have no area")])
def test_maps_that_cannot_be_used(tmp_path, empty_map, boxes, message):
    for box in boxes:
        empty_map.box(*box)
    with pytest.raises(BadInput, match=message):
        build_scene_from_map(empty_map.write(tmp_path / "a.osm"), tmp_path / "out")


def test_a_ring_of_three_points_is_no_building(tmp_path):
    square = [[8.7, 47.5], [8.7003, 47.5], [8.7003, 47.5002], [8.7, 47.5002], [8.7, 47.5]]
    rings = (square, [[8.7, 47.5]] * 3, square[:2] + square[:1])
    report = build_scene_from_map(write_geojson(tmp_path / "a.geojson", [(ring, {}) for ring in rings]), tmp_path / "out")
    assert dict(report.facts)["buildings"] == "1 in 1 blocks"
    assert "2 building(s) have no area" in report.problems[0].message
