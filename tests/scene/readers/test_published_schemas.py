"""Tags and columns of published schemas: what stands above the ground, and what its heights are."""

import json

import pandas as pd
import pytest

from radiotwin.scene.readers import build_scene
from radiotwin.scene.readers.features import INDOORS, NOT_THERE, UNDERGROUND, why_excluded
from tests.scene.readers import city_models
from tests.scene.readers.conftest import box, write_geojson


def built(tmp_path, source):
    """Return the table of buildings by name, and the warnings."""
    out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
    report = build_scene(source, out)
    table = pd.read_csv(out / "buildings.csv").set_index("building")
    return table, "\n".join(problem.message for problem in report.problems)


def geojson(tmp_path, rows):
    return write_geojson(tmp_path / "a.geojson", [(box(x_m), row) for x_m, row in rows])


BELOW = [
    {"location": "underground", "height": "8"}, {"location": "indoor; Underground"},
    {"building": "parking", "parking": "underground"}, {"layer": "-1", "building:levels": "1"}, {"level": "-2;-1"},
    {"level": "-3--1"}, {"tunnel": "yes"}, {"building:levels": "0", "building:levels:underground": "3"},
    {"min_height": "-6", "height": "0"}, {"min_height": "-9", "height": "-3"}, {"is_underground": "True"},
    {"max_level": "-1", "min_level": "-3"}, {"relativetoterrain": "entirelyBelowTerrain"}, {"ofl": "1200"}, {"relatievehoogteligging": "-1"}]
ABOVE = [
    {}, {"location": "roof"}, {"location": "overground;underground"},
    {"building": "apartments", "parking": "underground"},
    {"building": "parking", "parking": "underground", "building:levels": "1"}, {"layer": "1"}, {"layer": "roofs"}, {"layer": "-1", "height": "8"}, {"level": "-1", "amenity": "restaurant", "building:levels": "4"}, {"level": "-1;0"}, {"level": "-1-2"}, {"level": "0-3"},
    {"tunnel": "building_passage"}, {"tunnel": "no"}, {"building:levels": "0"},
    {"building:levels": "0", "building:levels:underground": "2", "roof:levels": "1"},
    {"building:levels": "0", "building:levels:underground": "2", "height": "4"},
    {"building:levels": "4", "building:levels:underground": "2"}, {"min_height": "-2", "height": "9"},
    {"is_underground": "False"}, {"relativetoterrain": "substantiallyBelowTerrain"}, {"height": "-3"},
    {"building": "construction"}, {"indoor": "yes"}]


@pytest.mark.parametrize(("tags", "reason"), [
    *((tags, UNDERGROUND) for tags in BELOW), *((tags, None) for tags in ABOVE),
    ({"building": "proposed", "height": "9"}, NOT_THERE), ({"building": "", "building:part": "Demolished"}, NOT_THERE),
    ({"building": "", "building:part": "yes", "indoor": "room", "level": "2"}, INDOORS)])
def test_what_stands_above_the_ground(tags, reason):
    found = why_excluded("way/1", {"building": "yes"} | tags, None)
    assert (found and found.reason) == reason and (found is None or found.name.startswith("way/1: "))


def test_what_lies_below_is_left_out_and_told_and_does_not_replace_what_stands_above(tmp_path, empty_map):
    drawn = (empty_map.box(0, 0, 20, 20, height="20")
             .box(0, 0, 20, 20, building="no", building__part="yes", building__levels="0", building__levels__underground="3")
             .box(40, 0, 60, 20, layer="-1").box(80, 0, 99, 20, layer="-1", height="8"))
    table, told = built(tmp_path, drawn.write(tmp_path / "a.osm"))
    assert table["top_m"].to_dict() == {"way/1": 20.0, "way/4": 8.0}
    assert "1 building(s) have a layer or level below zero, and a height" in told and "2 building(s) lie below the ground: left out" in told and "'way/3: layer=-1'" in told


def test_a_part_with_storeys_of_its_own_has_not_the_roof_of_the_whole(tmp_path, empty_map):
    drawn = (empty_map.box(0, 0, 40, 20, building__levels="5", roof__levels="2")
             .box(0, 0, 20, 20, building="no", building__part="yes", building__levels="2")
             .box(20, 0, 40, 20, building="no", building__part="yes"))
    table, _ = built(tmp_path, drawn.write(tmp_path / "a.osm"))
    assert table["top_m"].to_dict() == {"way/2": 6.0, "way/3": 21.0}


def test_overture_floors_roofs_and_what_is_underground(tmp_path):
    of_all = {"has_parts": False, "is_underground": False, "roof_shape": "hip"}
    table, told = built(tmp_path, geojson(tmp_path, [
        (0, of_all | {"num_floors": 4, "roof_height": 2.5}), (100, of_all | {"is_underground": True, "height": 6.0}),
        (200, of_all | {"height": 30.0, "min_floor": 2})]))
    assert table["top_m"].to_dict() == {"feature 1": 14.5, "feature 3": 30.0}
    assert table["bottom_m"].to_dict() == {"feature 1": 0.0, "feature 3": 6.0}
    assert "1 building(s) lie below the ground: left out ('feature 2: is_underground=True')" in told


def test_parts_of_overture_replace_their_building(tmp_path):
    whole = {"has_parts": True, "is_underground": False, "height": 40.0, "building_id": None}
    part = {"has_parts": None, "is_underground": False, "height": 12.0, "building_id": "08b"}
    table, _ = built(tmp_path, geojson(tmp_path, [(0, whole), (0, part)]))
    assert table["top_m"].to_dict() == {"feature 2": 12.0}
    table, told = built(tmp_path, geojson(tmp_path, [(0, whole)]))
    assert table["top_m"].to_dict() == {"feature 1": 40.0} and "parts (has_parts) that the file does not hold" in told


def test_the_highest_storey_of_indoor_tagging(tmp_path, empty_map):
    table, _ = built(tmp_path, empty_map.box(0, 0, 20, 20, min_level="-2", max_level="4").write(tmp_path / "a.osm"))
    assert table["top_m"].to_dict() == {"way/1": 15.0}  # 0 to 4


def test_what_a_city_model_has_below_the_ground(tmp_path):
    model = city_models.cityjson([(0, 0, 1.2), (50, 0, 1.2)])
    model["CityObjects"][max(model["CityObjects"])]["attributes"] = {"relativeToTerrain": "entirelyBelowTerrain"}
    (tmp_path / "a.city.json").write_text(json.dumps(model))
    table, told = built(tmp_path, tmp_path / "a.city.json")
    assert len(table) == 1 and "1 building(s) lie below the ground" in told
