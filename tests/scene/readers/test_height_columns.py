"""Heights from columns: what is known by name, what is declared, and that nothing is guessed silently."""

import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.scene.readers.heights import HeightColumn, declared_column, full_names, height_of
from tests.scene.readers.conftest import box, write_geojson


def build(tmp_path, rows, **options):
    path = write_geojson(tmp_path / "a.geojson", [(box(100 * number), row) for number, row in enumerate(rows)])
    report = build_scene_from_map(path, tmp_path / "out", BuildOptions(**options))
    table = pd.read_csv(tmp_path / "out" / "buildings.csv", keep_default_na=False)
    return report, list(zip(table["top_m"], table["height_from"]))


@pytest.mark.parametrize(("tags", "top_m", "source"), [
    ({"measuredheight": "12.5"}, 12.5, "measuredheight"), ({"hoehe": "9"}, 9, "hoehe"),
    ({"b3_h_max": "15.2", "b3_h_maaiveld": "-1.3"}, 16.5, "b3_h_max - b3_h_maaiveld"),
    ({"b3_h_dak_70p": "15", "b3_h_dak_max": "17", "b3_h_maaiveld": "2"}, 15, "b3_h_dak_max - b3_h_maaiveld"),
    ({"num_floors": "4"}, 12, "num_floors"), ({"height": "7", "num_floors": "4"}, 7, "height"),
    ({"heightroof": "100"}, 30.48, "heightroof"), ({"hauteur": "0", "nb_etages": "2"}, 6, "nb_etages"),
    ({"b3_h_max": "15.2"}, 10, "default"), ({"roof:height": "5", "area": "100"}, 10, "default")])
def test_known_columns(tags, top_m, source):
    found = height_of(tags, 10.0)
    assert (found.top_m, found.source) == (pytest.approx(top_m), source)


def test_impossible_values_are_named():
    found = height_of({"b3_h_max": "2", "b3_h_maaiveld": "3", "hoehe": "-9999"}, 10.0)
    assert found.source == "default" and found.unusable == ["hoehe=-9999", "b3_h_max=2, b3_h_maaiveld=3"]


@pytest.mark.parametrize(("text", "ground", "column"), [
    ("HGT", None, HeightColumn("hgt")), ("HGT:ft", None, HeightColumn("hgt", "ft")),
    ("a:b:CM", None, HeightColumn("a:b", "cm")), ("building:levels", None, HeightColumn("building:levels")),
    ("Floors:storeys", None, HeightColumn("floors", "storeys")), ("roof", "DTM", HeightColumn("roof", "m", "dtm"))])
def test_declared_columns(text, ground, column):
    assert declared_column(text, ground) == column


@pytest.mark.parametrize(("column", "tags", "top_m"), [
    (HeightColumn("hgt", "ft"), {"hgt": "100"}, 30.48), (HeightColumn("hgt", "cm"), {"hgt": "850"}, 8.5),
    (HeightColumn("n", "storeys"), {"n": "3"}, 9), (HeightColumn("z", ground="dtm"), {"z": "412", "dtm": "400"}, 12),
    (HeightColumn("z", "ft", "dtm"), {"z": "1100", "dtm": "1000"}, 30.48), (HeightColumn("hgt"), {"hgt": "x", "height": "4"}, 4)])
def test_a_declared_column_goes_first(column, tags, top_m):
    assert height_of(tags, 10.0, column).top_m == pytest.approx(top_m)
    assert height_of({"height": "77"} | tags, 10.0, column).top_m == pytest.approx(top_m if tags.get("hgt") != "x" else 4)


def test_names_that_shapefiles_cut():
    assert full_names(["measuredhe", "b3_h_maaiv", "b3_h_dak_m", "height", "whatever_x"]) == {
        "measuredhe": "measuredheight", "b3_h_maaiv": "b3_h_maaiveld"}


def test_a_column_by_name_in_any_case(tmp_path):
    report, tops = build(tmp_path, [{"HOEHE": 12.5}, {"Hoehe": 8}])
    assert tops == [(12.5, "hoehe"), (8, "hoehe")] and not report.problems
    assert dict(report.facts)["heights from"] == "hoehe: 2, default: 0 (10 m)"


def test_no_known_column_is_an_error_that_lists_the_columns(tmp_path):
    rows = [{"OBJECTID": 7, "roof_z": 412.5, "use": "flats"}, {"OBJECTID": 8, "roof_z": 415.0, "use": "8"}]
    with pytest.raises(BadInput, match=r"none of its columns is known .*--height-column NAME .*--height-default M"
                                       r".*columns of numbers are: 'objectid', 'roof_z', 'use'"):
        build(tmp_path, rows)
    assert not (tmp_path / "out").exists()
    report, tops = build(tmp_path, rows, default_height_m=12.0)
    assert tops == [(12, "default")] * 2 and not report.problems


def test_a_known_column_without_a_usable_value_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"column 'height' holds none above 0 and up to 1,000 m, only such as -5"):
        build(tmp_path, [{"height": -5, "id": 1}, {"height": -5, "id": 2}])


def test_an_elevation_without_its_ground_is_explained(tmp_path):
    with pytest.raises(BadInput, match=r"b3_h_dak_max is an elevation, .* \(b3_h_maaiveld\) has to be subtracted"):
        build(tmp_path, [{"b3_h_dak_max": 12.5}])


def test_a_table_without_numbers_gets_the_default_with_a_warning(tmp_path):
    report, tops = build(tmp_path, [{"use": "flats"}, {}])
    (problem,) = report.problems
    assert problem.severity == "warning" and "2 of 2 building(s) have no height in the map: 10 m" in problem.message
    assert tops == [(10, "default")] * 2


def test_some_buildings_without_a_height_are_told(tmp_path):
    report, tops = build(tmp_path, [{"num_floors": 4}, {"num_floors": None}])
    (problem,) = report.problems
    assert "1 of 2 building(s) have no height in the map" in problem.message and "'feature 2'" in problem.message
    assert tops == [(12, "num_floors"), (10, "default")]
    assert dict(report.facts)["heights from"] == "num_floors × 3 m: 1, default: 1 (10 m)"


@pytest.mark.parametrize(("column", "ground", "missing"), [("roof", None, "'roof'"), ("a", "dtm", "'dtm'")])
def test_a_declared_column_that_is_not_there(tmp_path, column, ground, missing):
    with pytest.raises(BadInput, match=f"has no column {missing}; its columns are: 'a', 'building'"):
        build(tmp_path, [{"A": 1}], height_column=column, ground_column=ground)
