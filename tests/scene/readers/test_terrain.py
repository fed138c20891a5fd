"""Buildings of a map on the terrain of a GeoTIFF: heights on a slope, references and units, and rasters to refuse."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.io.budgets import TERRAIN_BLOCK_BYTES, TERRAIN_PIXELS
from radiotwin.io.forms import Origin
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.scene.readers.terrain import read_heights
from tests.scene.readers import city_models as made
from tests.scene.readers.conftest import Map
from tests.terrains import LAT_M, LON_M, incline, write_dem

rasterio = pytest.importorskip("rasterio")
ORIGIN = Origin(latitude_deg=10.0, longitude_deg=20.0)
BOX_M = (-300.0, 300.0, -200.0, 200.0)
SLOPE = incline(0.1, -0.05, 431.5)


def build(tmp_path, drawn, dem, **more):
    path = drawn.write(tmp_path / "a.osm")
    report = build_scene_from_map(path, tmp_path / "out",
                                  BuildOptions(terrain=dem, origin=ORIGIN, devices=4, **more))
    return report, pd.read_csv(tmp_path / "out" / "buildings.csv").set_index("building")


def hamlet():
    """A house, a tower on a podium of two parts, and a bridge between houses."""
    return (Map().box(-60, -60, -40, -40, height="12")
            .box(100, 0, 140, 40, height="30").box(100, 0, 140, 20, building="no", building__part="yes", height="8")
            .box(100, 20, 140, 40, building="no", building__part="yes", height="30")
            .box(0, 80, 10, 90, height="9", min_height="5"))


@pytest.fixture(scope="module")
def slope(tmp_path_factory):
    """The hamlet on a slope: report and table of buildings."""
    folder = tmp_path_factory.mktemp("slope")
    return build(folder, hamlet(), write_dem(folder / "a.tif", SLOPE))


@pytest.fixture
def copied(slope, tmp_path):
    """The scene of the hamlet on a slope, to be changed."""
    return Path(shutil.copytree(slope[0].folder, tmp_path / "scene"))


def test_buildings_stand_on_the_slope(slope):
    """Tops count from the lowest ground under the whole building; walls begin a metre below it."""
    report, table = slope
    scene = Scene.load(report.folder)
    datum_m = scene.config.terrain.datum_m
    west_m, north_m = scene.city.vertices[:, 0].min(), scene.city.vertices[:, 1].max()
    assert datum_m == np.floor(SLOPE(west_m, north_m)) and west_m <= -160 and north_m >= 190
    lowest_m = SLOPE(-60, -40) - datum_m
    assert table.loc["way/1", ["ground_m", "bottom_m", "top_m"]].tolist() == pytest.approx(
        [lowest_m, lowest_m - 1, lowest_m + 12], abs=0.05)
    whole_m = SLOPE(100, 40) - datum_m
    for part, height_m in (("way/3", 8), ("way/4", 30)):
        assert table.loc[part, ["ground_m", "top_m"]].tolist() == pytest.approx([whole_m, whole_m + height_m], abs=0.05)
    bridge_m = SLOPE(0, 90) - datum_m
    assert table.loc["way/5", ["bottom_m", "top_m"]].tolist() == pytest.approx([bridge_m + 5, bridge_m + 9], abs=0.05)


def test_parts_of_a_city_model_stand_on_the_ground_of_their_building(tmp_path):
    """Their heights count from its lowest point: a part 50 m up a slope of 10 % begins 5 m above it."""
    from pyproj import Transformer

    east, north = Transformer.from_crs(4326, 32634, always_xy=True).transform(20, 10)
    model = made.in_one_building(
        made.cityjson([(0, 0, 500), (50, 0, 505)], "EPSG:32634", at=(round(east), round(north))))
    (tmp_path / "a.city.json").write_text(json.dumps(model))
    dem = write_dem(tmp_path / "a.tif", incline(0.1, 0, 500))
    report = build_scene_from_map(tmp_path / "a.city.json", tmp_path / "out",
                                  BuildOptions(terrain=dem, origin=ORIGIN))
    low_m = 500 - Scene.load(report.folder).config.terrain.datum_m
    table = pd.read_csv(report.folder / "buildings.csv").sort_values("x_m")
    assert table["ground_m"].tolist() == pytest.approx([low_m] * 2, abs=0.1)
    assert table["bottom_m"].tolist() == pytest.approx([low_m - 1, low_m + 5], abs=0.1)
    assert table["top_m"].tolist() == pytest.approx([low_m + made.RIDGE_M, low_m + 5 + made.RIDGE_M], abs=0.1)
    house, = (trimesh.load(path, process=False) for path in (report.folder / "meshes").glob("B0*.ply") if path.stem == "B0")
    assert house.is_volume and house.bounds[0, 2] == pytest.approx(low_m - 1, abs=0.1)


def test_the_scene_knows_its_ground(slope):
    report, _ = slope
    scene = Scene.load(report.folder)
    datum_m = scene.config.terrain.datum_m
    assert scene.config.origin.altitude_m == datum_m
    assert scene.config.terrain.model_dump() == {
        "shape": "ground", "source": str(report.folder.with_name("a.tif")), "datum_m": datum_m,
        "reference": "EGM96 height", "kind": "geoid"}
    x_m, y_m = np.meshgrid(np.arange(-100, 180, 7.3), np.arange(-100, 120, 6.1))
    assert scene.city.ground_height_m(x_m, y_m) == pytest.approx(SLOPE(x_m, y_m) - datum_m, abs=0.05)
    for device in scene.config.devices:
        assert device.z_m == pytest.approx(SLOPE(device.x_m, device.y_m) - datum_m + 1.5, abs=0.05)
    assert scene.config.lattice.above == "ground"
    positions_m = scene.lattice.positions_m
    above_m = positions_m[:, 2] + datum_m - SLOPE(positions_m[:, 0], positions_m[:, 1])
    assert above_m == pytest.approx(np.repeat(scene.config.lattice.altitudes_m, above_m.size // 3), abs=0.05)
    assert "terrain from 405.5 to 463.5 m (EGM96 height, above the geoid); z = 0 is at 405 m" in \
        dict(report.facts)["ground"]


def test_the_ground_is_no_building_of_a_table(slope):
    """Heights count from the ground below: on the slope of 10 and 5 % those of the map, from the lower corner."""
    pytest.importorskip("geopandas", reason="the extra geo is not installed")
    report, _ = slope
    table = Scene.load(report.folder).to_geodataframe().set_index("building")
    assert "ground" not in table.index and len(table) == 3
    assert sorted(table["height_m"]) == pytest.approx([9, 12, 30], abs=0.1)


def test_a_device_or_a_flight_in_the_hill_is_refused(copied):
    path = copied / "scene.toml"
    text = path.read_text()
    path.write_text(text + '\n[[devices]]\ndevice = "low"\nx_m = 40.0\ny_m = 0.0\nz_m = 2.0\n')
    with pytest.raises(BadInput, match=r"device 'low' at \(40, 0, 2\) m is below the ground, which is 30\.5 m above"):
        Scene.load(copied)
    path.write_text(text + '\n[[devices]]\ndevice = "mast"\nx_m = 40.0\ny_m = 0.0\nabove_ground_m = 20.0\n'
                           '\n[[devices]]\ndevice = "phone"\nx_m = 40.0\ny_m = 1.0\n')
    scene = Scene.load(copied)
    mast, phone = scene.config.devices[-2:]
    ground_m = SLOPE(40, 0) - scene.config.terrain.datum_m
    assert mast.z_m == pytest.approx(ground_m + 20, abs=0.05) and phone.z_m == pytest.approx(ground_m + 1.45, abs=0.06)
    low = text.replace('above = "ground"', 'above = "datum"').replace("altitude_m = 45.0", "altitude_m = 12.0")
    path.write_text(low.replace("    45.0,", "    12.0,"))
    with pytest.raises(BadInput, match=r"uav 'uav\d': its start .* is below the ground"):
        Scene.load(copied)


def test_the_altitude_of_an_origin_is_the_datum(tmp_path):
    dem = write_dem(tmp_path / "a.tif", SLOPE)
    at = Origin(latitude_deg=10, longitude_deg=20, altitude_m=400.0)
    report = build_scene_from_map(hamlet().write(tmp_path / "a.osm"), tmp_path / "out",
                                  BuildOptions(terrain=dem, origin=at))
    scene = Scene.load(report.folder)
    assert scene.config.terrain.datum_m == scene.config.origin.altitude_m == 400
    assert scene.city.ground_height_m(0.0, 0.0) == pytest.approx(31.5, abs=0.05)
    with pytest.raises(BadInput, match=r"the altitude of --origin, 500 m, is above the lowest ground of the scene"):
        build_scene_from_map(tmp_path / "a.osm", tmp_path / "out",
                             BuildOptions(terrain=dem, origin=at.model_copy(update={"altitude_m": 500.0})))


def heights(path, box_m=BOX_M):
    return read_heights(path, ORIGIN, box_m)


def check_plane(grid, factor=1.0):
    x_m, y_m = np.meshgrid(grid.x_m, grid.y_m)
    assert grid.height_m == pytest.approx(factor * SLOPE(x_m, y_m), abs=0.1)


def test_a_raster_in_another_projection(tmp_path):
    """UTM, whose grid is turned against the local frame: pixels hold the height of the place that they lie at."""
    from pyproj import Transformer

    east, north = Transformer.from_crs(4326, 32634, always_xy=True).transform(20, 10)
    e, n = np.meshgrid(east + 10 * np.arange(-59.5, 60), north - 10 * np.arange(-59.5, 60))
    longitude, latitude = Transformer.from_crs(32634, 4326, always_xy=True).transform(e, n)
    values = SLOPE((longitude - 20) * LON_M, (latitude - 10) * LAT_M).astype("float32")
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=120, height=120, count=1, dtype="float32",
                       crs="EPSG:32634", transform=rasterio.Affine(10, 0, east - 600, 0, -10, north + 600)) as file:
        file.write(values, 1)
    grid = heights(tmp_path / "a.tif")
    check_plane(grid)
    assert (grid.kind, grid.reference) == ("unknown", "not declared")


@pytest.mark.parametrize(("crs", "unit", "kind", "reference", "factor"), [
    ("EPSG:4979", None, "ellipsoid", "ellipsoid of WGS 84", 1.0), ("EPSG:4326+3855", None, "geoid", "EGM2008 height", 1.0),
    ("EPSG:4326+6360", None, "geoid", "NAVD88 height (ftUS)", 1200 / 3937), ("EPSG:4326", "ft", "unknown", "not declared", 0.3048)])
def test_vertical_references_and_their_units(tmp_path, crs, unit, kind, reference, factor):
    grid = heights(with_unit(write_dem(tmp_path / "a.tif", SLOPE, crs=crs), unit))
    assert (grid.kind, grid.reference) == (kind, reference)
    check_plane(grid, factor)
    assert (grid.notes != ()) == (factor != 1)


def with_unit(path, unit):
    if unit:
        with rasterio.open(path, "r+") as file:
            file.units = [unit]
    return path


def test_pixels_finer_than_needed_are_averaged(tmp_path):
    """A chessboard of ± 3 m of pixels of 0.25 m: means of 4 x 4 pixels are the plane."""
    def chessboard(x_m, y_m):
        return SLOPE(x_m, y_m) + np.where((np.floor(x_m / 0.25) + np.floor(y_m / 0.25)) % 2, 3.0, -3.0)
    grid = heights(write_dem(tmp_path / "a.tif", chessboard, half_m=120, pixel_m=0.25), (-100, 100, -100, 100))
    assert np.diff(grid.x_m)[0] == pytest.approx(1, abs=0.01)
    check_plane(grid)


def test_places_without_data_get_the_nearest_height(tmp_path):
    def with_lake(x_m, y_m):
        return np.where(np.hypot(x_m - 30, y_m) < 45, -9999.0, np.full_like(x_m, 440.0) + np.sign(x_m - 1e4))
    report, _ = build(tmp_path, hamlet(), write_dem(tmp_path / "a.tif", with_lake, nodata=-9999))
    said = "\n".join(problem.message for problem in report.problems)
    assert f"a.tif has no height for {np.pi * 45**2 / (420 * 400):.1%} of" in said and "the nearest one was taken" in said
    assert Scene.load(report.folder).city.ground_height_m(30.0, 0.0) == pytest.approx(0, abs=1e-3)
    # The same where the file does not declare it: no land is that low
    undeclared = heights(write_dem(tmp_path / "b.tif", with_lake))
    assert undeclared.height_m == pytest.approx(439, abs=1e-6) and "are no heights on land" in undeclared.notes[0]


def overview_elsewhere(path):
    write_dem(path, SLOPE)
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE="/etc/passwd")


def complex_integers(path):
    """Of a type that numpy does not have."""
    with rasterio.open(path, "w", driver="GTiff", width=9, height=9, count=1, dtype="complex_int16", crs="EPSG:4326",
                       transform=rasterio.Affine(0.1, 0, 19.6, 0, -0.1, 10.4)):
        pass


REFUSED = {
    "a VRT": (lambda path: path.write_text("<VRTDataset rasterXSize='1' rasterYSize='1'/>"), "cannot be read as a GeoTIFF"),
    "a picture": (lambda path: write_dem(path, SLOPE, count=3), "has 3 bands, as a picture has"),
    "complex": (lambda path: write_dem(path, SLOPE, dtype="complex64"), "pixels of type complex64"),
    "complex integers": (complex_integers, "pixels of type complex_int16"),
    "no system": (lambda path: write_dem(path, SLOPE, crs=None), "does not say where on the earth it lies"),
    "elsewhere": (lambda path: write_dem(path, SLOPE, half_m=100), r"has heights for 1\d% of the scene, 50% are needed"),
    "overviews": (overview_elsewhere, "names another file as its overview"),
    "unit": (lambda path: with_unit(write_dem(path, SLOPE, crs="EPSG:4326"), "fathom"),
             "heights in 'fathom'; allowed are metres and feet"),
    "none": (lambda path: None, "does not exist"),
    "a server": (lambda path: "/vsicurl/http://127.0.0.1:1/a.tif", "does not exist"),
    "an archive": (lambda path: "zip://a.zip!a.tif", "does not exist"),
}


@pytest.mark.parametrize(("make", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_terrain_is_refused(tmp_path, monkeypatch, make, message):
    monkeypatch.chdir(tmp_path)
    named = make(tmp_path / "a.tif")
    with pytest.raises(BadInput, match=message):
        heights(Path(named) if isinstance(named, str) else tmp_path / "a.tif")


def test_raster_far_away(tmp_path):
    far = Origin(latitude_deg=-10.0, longitude_deg=100.0)
    with pytest.raises(BadInput, match="has heights for 0% of the scene"):
        read_heights(write_dem(tmp_path / "a.tif", SLOPE), far, BOX_M)


def test_files_beside_the_raster_are_not_read(tmp_path):
    """An overview, a mask, statistics, a position and a system of a stranger beside the file change nothing."""
    path = write_dem(tmp_path / "a.tif", SLOPE)
    before = heights(path).height_m
    other = write_dem(tmp_path / "other.tif", incline(0, 0, 9.0)).read_bytes()
    for suffix in (".ovr", ".msk"):
        (tmp_path / f"a.tif{suffix}").write_bytes(other)
    (tmp_path / "a.tif.aux.xml").write_text('<PAMDataset><PAMRasterBand band="1"><Scale>7</Scale></PAMRasterBand>'
                                            "</PAMDataset>")
    (tmp_path / "a.tfw").write_text("1\n0\n0\n-1\n0\n0\n")
    names = sorted(os.listdir(tmp_path))
    assert heights(path).height_m.tobytes() == before.tobytes()
    assert sorted(os.listdir(tmp_path)) == names


def test_budgets(tmp_path, monkeypatch):
    path = write_dem(tmp_path / "a.tif", SLOPE, tiled=True, blockxsize=256, blockysize=256)
    monkeypatch.setenv(TERRAIN_BLOCK_BYTES.variable, "100000")
    with pytest.raises(BadInput, match="a block of 256 x 256 pixels: 262,144 bytes.*RADIOTWIN_MAX_TERRAIN_BLOCK_BYTES"):
        heights(path)
    monkeypatch.delenv(TERRAIN_BLOCK_BYTES.variable)
    monkeypatch.setenv(TERRAIN_PIXELS.variable, "2000")
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_TERRAIN_PIXELS"):
        heights(path)


def test_a_missing_ground_shape_is_named(copied):
    path = copied / "scene.toml"
    path.write_text(path.read_text().replace('shape = "ground"', 'shape = "soil"'))
    with pytest.raises(BadInput, match=r"has no shape 'soil', which scene.toml declares as the ground"):
        Scene.load(copied)
