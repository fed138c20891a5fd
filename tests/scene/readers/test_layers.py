"""GeoPackages and archives with several layers: which one holds the buildings, and what is told of the others."""

import zipfile

import numpy as np
import pandas as pd
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.readers import build_scene
from tests.scene.readers.conftest import write_table

AT = np.array([477_400.0, 5_261_000.0])  # in UTM zone 32


def areas(*boxes, three=False):
    found = [shapely.transform(shapely.box(*box), lambda points: points + AT) for box in boxes]
    return [shapely.force_3d(area, 7.0) for area in found] if three else found


def write(path, layer, shapes, **more):
    return write_table(path, shapes, "EPSG:32632", layer, **more)


def built(source, tmp_path, **options):
    """Return area and top of each building, the warnings, and what is not used."""
    out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
    report = build_scene(source, out, **options)
    table = pd.read_csv(out / "buildings.csv")
    return (sorted(zip(table["area_m2"].round(-1), table["top_m"])), "\n".join(one.message for one in report.problems),
            dict(report.facts).get("not used", ""))


@pytest.fixture
def tile(tmp_path):
    """A tile as of 3D BAG: a house of two roofs, and a greenhouse without roofs of its own."""
    path = tmp_path / "tile.gpkg"
    house, low, glass = (0, 0, 30, 20), (15, 0, 30, 20), (50, 0, 70, 20)
    write(path, "pand", areas(house, glass), identificatie=["a", "b"], b3_h_maaiveld=[2.0, 1.0],
          b3_h_dak_max=[20.0, 6.0])
    write(path, "lod12_2d", areas(house), identificatie=["a"], b3_h_max=[20.0])
    write(path, "lod22_2d", areas((0, 0, 15, 20), low), identificatie=["a", "a"], b3_h_max=[20.0, 12.2])
    write(path, "lod22_3d", areas(house, three=True), kind="Polygon Z", identificatie=["a"])
    write(path, "ondergrond", areas((0, 30, 30, 60)), identificatie=["a"])
    return path


def test_of_3d_bag_the_most_detailed_roofs_and_outlines_without_roofs(tile, tmp_path):
    found, told, _ = built(tile, tmp_path)
    assert found == [(300, 10.2), (300, 18.0), (400, 5.0)]
    assert "3 layer(s) were not read ('lod12_2d', 'lod22_3d', 'ondergrond')" in told


def test_a_layer_can_be_chosen(tile, tmp_path):
    assert built(tile, tmp_path, layers=["pand"])[0] == [(400, 5.0), (600, 18.0)]
    with pytest.raises(BadInput, match=r"no layer of areas called 'roofs'; its layers are: 'lod12_2d', 'lod22_2d'"):
        built(tile, tmp_path, layers=["roofs"])


@pytest.mark.parametrize(("name", "columns"), [
    ("gis_osm_buildings_a_free_1", {"fclass": ["building"]}), ("Batiment", {"nature": ["x"]}),
    ("layer 1", {"building": ["yes"]}), ("layer 1", {"has_parts": [0]}), ("layer 1", {"storeys": [3]})])
def test_woods_and_railways_are_no_buildings(tmp_path, name, columns):
    path = write(tmp_path / "a.gpkg", "landuse", areas((-500, -500, 500, 500)), fclass=["forest"])
    write(path, name, areas((0, 0, 10, 10)), **columns)
    write(path, "railways", [shapely.LineString(AT + [[0, 0], [9, 9]])], kind="LineString", fclass=["rail"])
    found, told, unused = built(path, tmp_path, default_height_m=7.0)
    assert [area for area, _ in found] == [100]
    assert "1 layer(s) were not read ('landuse')" in told and "layers 'railways'" in unused


def test_buildings_and_parts_of_overture_are_two_layers(tmp_path):
    path = write(tmp_path / "a.gpkg", "building", areas((0, 0, 20, 20)), has_parts=[1], is_underground=[0], height=[40.0])
    write(path, "building_part", areas((0, 0, 20, 10), (0, 10, 20, 20)), building_id=["a", "a"], is_underground=[0, 0],
          height=[9.0, 40.0])
    assert built(path, tmp_path)[0] == [(200, 9.0), (200, 40.0)]


def test_layers_that_hold_the_same_buildings_are_refused(tmp_path):
    path = write(tmp_path / "a.gpkg", "houses_2020", areas((0, 0, 20, 20), (40, 0, 60, 20)), height=[9.0, 9.0])
    write(path, "houses_2024", areas((0, 0, 20, 20), (40, 0, 60, 22)), height=[9.0, 12.0])
    with pytest.raises(BadInput, match="'houses_2020' and 'houses_2024' hold the same buildings; choose one with --layer"):
        built(path, tmp_path)
    assert built(path, tmp_path, layers=["houses_2024"])[0] == [(400, 9.0), (440, 12.0)]


def test_layers_that_nothing_tells_apart_are_refused(tmp_path):
    path = write(tmp_path / "a.gpkg", "a", areas((0, 0, 20, 20)), use=[1])
    write(path, "b", areas((40, 0, 60, 20)), use=[1])
    with pytest.raises(BadInput, match="none is known to hold buildings .* choose with --layer NAME: 'a', 'b'"):
        built(path, tmp_path)
    assert len(built(path, tmp_path, layers=["a", "b"], default_height_m=5.0)[0]) == 2


def test_an_archive_of_shapefiles_with_other_things(tmp_path):
    folder = tmp_path / "shapes"
    folder.mkdir()
    write(folder / "landuse.shp", None, areas((-500, -500, 500, 500)), fclass=["forest"])
    write(folder / "buildings.shp", None, areas((0, 0, 10, 10)), height=[8.0])
    write(folder / "places.shp", None, shapely.points([AT]), kind="Point", fclass=["village"])
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for part in folder.iterdir():
            archive.write(part, part.name)
    found, told, unused = built(tmp_path / "a.zip", tmp_path)
    assert found == [(100, 8.0)] and "1 layer(s) were not read ('landuse')" in told and "layers 'places'" in unused


def test_a_file_without_layers(tmp_path, empty_map):
    with pytest.raises(BadInput, match="has no layers; leave --layer out"):
        build_scene(empty_map.box(0, 0, 9, 9).write(tmp_path / "a.osm"), tmp_path / "out", layers=["a"])
