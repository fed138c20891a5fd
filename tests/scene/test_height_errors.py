"""How well heights are known, from the table of a scene made from a map."""

import pickle

import numpy as np
import pytest

from radiotwin.effects.boxes import Box
from radiotwin.effects.catalogue.missing_obstacle import _with_box
from radiotwin.errors import BadInput
from radiotwin.io.content_hash import content_hash
from radiotwin.scene.citymap import CityMap, shape_height_sds_m
from tests.scene.conftest import city_of


def table(folder, *rows, header="building,shape,area_m2,height_sd_m"):
    (folder / "buildings.csv").write_text("\n".join([header, *rows]) + "\n")
    return shape_height_sds_m(folder)


def test_a_block_has_the_mean_of_its_buildings_by_area(tmp_path):
    assert shape_height_sds_m(tmp_path) is None
    found = table(tmp_path, "way/1,block,300,1.5", "way/2,block,100,5.5", "way/3,alone,50,3")
    assert found == pytest.approx({"block": 2.5, "alone": 3.0})
    assert table(tmp_path, "way/1,block,300", header="building,shape,area_m2") is None


@pytest.mark.parametrize("cell", ["0", "-1", "nan", "", "1e9", "wide"])
def test_an_impossible_one_is_refused_by_row(tmp_path, cell):
    with pytest.raises(BadInput, match=r"buildings.csv: row 3, column height_sd_m.*allowed"):
        table(tmp_path, "way/1,block,300,1.5", f"way/2,block,100,{cell}")


def test_a_table_elsewhere_is_not_read(tmp_path):
    (tmp_path / "secret.csv").write_text("shape,area_m2,height_sd_m\na,1,1\n")
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "buildings.csv").symlink_to(tmp_path / "secret.csv")
    with pytest.raises(BadInput, match="leads out of"):
        shape_height_sds_m(scene)


def test_maps_made_from_a_map_keep_it():
    sd_m, terrain = np.repeat([1.5, 6.0], 12), np.repeat([True, False], 12)
    city = city_of([(0, 0, 20, 20, 15), (50, 0, 80, 20, 25)], height_sd_m=sd_m, terrain=terrain)
    assert set(city.without(sd_m == 1.5).height_sd_m) == {6.0}
    for same in (city.with_vertices(city.vertices + 1.0), pickle.loads(pickle.dumps(city))):
        assert (same.height_sd_m == sd_m).all() and (same.terrain == terrain).all()
    more = _with_box(city, Box(100.0, 0.0, 10.0, 10.0, 12.0, 0.0))
    assert len(more.height_sd_m) == len(more.faces) and np.isnan(more.height_sd_m[24:]).all()


def test_what_was_fitted_with_other_errors_is_not_taken_for_this():
    corners_m = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 5.0]])
    maps = [CityMap(corners_m, np.array([[0, 1, 2]]), height_sd_m=sd_m) for sd_m in (None, np.array([1.5]), np.array([3.0]))]
    assert len({content_hash(each) for each in maps}) == 3
