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
    ({"b3_h_max": "15.2"}, 10, "default"), ({"roof:height": "5", "area": "100"}, 10, "default"),
    ({"b3_h_max": "2", "b3_h_maaiveld": "3", "hoehe": "-9999"}, 10, "default")])
def test_known_columns(tags, top_m, source):
    found = height_of(tags, 10.0)
    assert (found.top_m, found.source) == (pytest.approx(top_m), source)
    if "-9999" in tags.values():
        assert found.unusable == ["hoehe=-9999", "b3_h_max=2, b3_h_maaiveld=3"]


@pytest.mark.parametrize(("column", "tags", "top_m"), [
    (HeightColumn("hgt", "ft"), {"hgt": "100"}, 30.48), (HeightColumn("hgt", "cm"), {"hgt": "850"}, 8.5),
    (HeightColumn("n", "storeys"), {"n": "3"}, 9), (HeightColumn("z", ground="dtm"), {"z": "412", "dtm": "400"}, 12),
    (HeightColumn("z", "ft", "dtm"), {"z": "1100", "dtm": "1000"}, 30.48), (HeightColumn("hgt"), {"hgt": "x"}, 77)])
def test_a_declared_column_goes_first(column, tags, top_m):
    assert height_of({"height": "77"} | tags, 10.0, column).top_m == pytest.approx(top_m)


@pytest.mark.parametrize(("text", "ground", "column"), [
    ("HGT", None, HeightColumn("hgt")), ("HGT:ft", None, HeightColumn("hgt", "ft")),
    ("a:b:CM", None, HeightColumn("a:b", "cm")), ("building:levels", None, HeightColumn("building:levels")),
    ("Floors:storeys", None, HeightColumn("floors", "storeys")), ("roof", "DTM", HeightColumn("roof", "m", "dtm"))])
def test_declared_columns(text, ground, column):
    assert declared_column(text, ground) == column


def test_names_that_shapefiles_cut():
    assert full_names(["measuredhe", "b3_h_maaiv", "b3_h_dak_m", "height", "whatever_x"]) == {
        "measuredhe": "measuredheight", "b3_h_maaiv": "b3_h_maaiveld"}


@pytest.mark.parametrize(("rows", "found", "fact", "said"), [
    ([{"HOEHE": 12.5}, {"Hoehe": 8}], [(12.5, "hoehe"), (8, "hoehe")], "hoehe: 2, default: 0 (10 m)", None),
    ([{"use": "flats"}, {}], [(10, "default")] * 2, "default: 2 (10 m)", "2 of 2 building(s) have no height in the map: 10 m"),
    ([{"num_floors": 4}, {"num_floors": None}], [(12, "num_floors"), (10, "default")],
     "num_floors × 3 m: 1, default: 1 (10 m)", "1 of 2 building(s) have no height in the map")])
def test_sources_of_heights_are_told(tmp_path, rows, found, fact, said):
    report, tops = build(tmp_path, rows)
    assert tops == found and dict(report.facts)["heights from"] == fact
    assert [said in problem.message for problem in report.problems] == ([True] if said else [])


@pytest.mark.parametrize(("rows", "options", "message"), [
    ([{"height": -5, "id": 1}] * 2, {}, "column 'height' holds none above 0 and up to 1,000 m, only such as -5"),
    ([{"b3_h_dak_max": 12.5}], {}, r"b3_h_dak_max is an elevation, .* \(b3_h_maaiveld\) has to be subtracted"),
    ([{"A": 1}], {"height_column": "roof"}, "has no column 'roof'; its columns are: 'a', 'building'"),
    ([{"A": 1}], {"height_column": "a", "ground_column": "dtm"}, "has no column 'dtm'; its columns are: 'a', 'building'"),
    ([{"A": 1}], {"ground_column": "dtm"}, "name that with --height-column, too")])
def test_columns_that_hold_no_heights(tmp_path, rows, options, message):
    with pytest.raises(BadInput, match=message):
        build(tmp_path, rows, **options)


def test_no_known_column_is_an_error_that_lists_the_columns(tmp_path):
    rows = [{"OBJECTID": 7, "roof_z": 412.5, "use": "flats"}, {"OBJECTID": 8, "roof_z": 415.0, "use": "8"}]
    with pytest.raises(BadInput, match=r"none of its columns is known .*--height-column NAME .*--height-default M"
                                       r".*columns of numbers are: 'objectid', 'roof_z', 'use'"):
        build(tmp_path, rows)
    assert not (tmp_path / "out").exists()
    report, tops = build(tmp_path, rows, default_height_m=12.0)
    assert tops == [(12, "default")] * 2 and not report.problems
