"""Files of a coverage prediction, read back by the programs that they are for."""

import json
import xml.etree.ElementTree as ET
import zipfile
from io import BytesIO

import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
import shapely
import xarray as xr
from PIL import Image
from pyproj import CRS, Transformer

from radiotwin.coverage import CoverageSettings, predict_coverage
from radiotwin.coverage.output import (
    FILES,
    available_formats,
    drawn_rasters,
    legend_of,
    write_formats,
    write_tables,
)
from radiotwin.errors import BadInput
from radiotwin.geo import to_geographic
from radiotwin.report import write_coverage_pictures
from radiotwin.report.labels import attribution
from radiotwin.scene import Scene
from tests.coverage.conftest import box, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene") / "house", [box(100, 100, 300, 200, 20)],
                       [("west", -200.0, 0.0, 30.0), ("east", 350.0, 30.0, 30.0)], 400.0)


@pytest.fixture(scope="module")
def coverage(scene):
    return predict_coverage("p1411", scene, settings=CoverageSettings(step_m=10.0, classes_dbm=(-60.0, -70.0, -80.0)))


def test_all_files_and_no_others(coverage, scene, tmp_path):
    formats, notes = available_formats(scene, None)
    assert formats == ["nc", "tif", "gpkg", "kmz", "png"] and not notes
    write_tables(coverage, tmp_path / "out")
    write_formats(coverage, scene, tmp_path / "out", formats)
    write_coverage_pictures(coverage, scene, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names <= FILES and {"coverage.json", "coverage.csv", "sinr.tif", "best_server.png", "coverage.gpkg"} <= names


def test_tables_say_the_same(coverage, tmp_path):
    write_tables(coverage, tmp_path)
    record = json.loads((tmp_path / "coverage.json").read_text(encoding="utf-8"))
    table = pd.read_csv(tmp_path / "coverage.csv")
    assert record["schema"] == "radiotwin.coverage/1" and record["model"].startswith("p1411 (ITU-R P.1411-12")
    of_power = table[(table["quantity"] == "received_power_dbm") & (table["area"] == "extent")]
    assert of_power["threshold"].tolist() == [-60, -70, -80, -105]
    assert of_power["share"].tolist() == pytest.approx([each["share"] for each in record["areas"][0]["received_power_dbm"]])
    outdoors_m2 = 800.0**2 - 200 * 100
    assert of_power["area_m2"].to_numpy() == pytest.approx(of_power["share"].to_numpy() * outdoors_m2)
    servers = table[table["quantity"] == "best_server"]
    assert servers["device"].tolist() == ["west", "east"] and servers["share"].sum() == pytest.approx(1.0)


def test_netcdf_opens_anywhere(coverage, scene, tmp_path):
    write_formats(coverage, scene, tmp_path, ["nc"])
    with xr.open_dataset(tmp_path / "coverage.nc") as opened:
        for name in coverage.dataset.data_vars:
            np.testing.assert_array_equal(opened[name].values, coverage.dataset[name].values)
        assert opened["sinr_db"].attrs["units"] == "dB"
        assert CRS.from_cf(opened["crs"].attrs).coordinate_operation.method_name == "Azimuthal Equidistant"
        assert opened["transmitter"].values.tolist() == ["west", "east"]


def test_geotiffs_lie_at_their_place(coverage, scene, tmp_path):
    write_formats(coverage, scene, tmp_path, ["tif"])
    longitude, latitude = to_geographic(scene.config.origin, [-195.0], [5.0])
    for name, variable in (("received_power", "received_power_dbm"), ("best_server", "best_server"), ("rate", "rate_bps")):
        with rasterio.open(tmp_path / f"{name}.tif") as file:
            to_file = Transformer.from_crs("EPSG:4326", CRS.from_wkt(file.crs.to_wkt()), always_xy=True)
            (value,) = file.sample([to_file.transform(longitude[0], latitude[0])])
            assert value[0] == coverage.dataset[variable].sel(x=-195.0, y=5.0)
            masked = file.read(1, masked=True)
            assert masked.mask.sum() == coverage.dataset["indoor"].sum()
            assert file.tags()["server_1"] == "east"


def test_vectors_have_the_areas_of_the_cells(coverage, scene, tmp_path):
    write_formats(coverage, scene, tmp_path, ["gpkg"])
    once = (tmp_path / "coverage.gpkg").read_bytes()
    write_formats(coverage, scene, tmp_path, ["gpkg"])
    assert (tmp_path / "coverage.gpkg").read_bytes() == once
    layers = dict(pyogrio.list_layers(tmp_path / "coverage.gpkg"))
    assert layers.keys() == {"received_power", "best_server", "sinr", "rate", "coverage_probability", "transmitters"}
    for name in drawn_rasters(coverage):
        legend = legend_of(name, coverage)
        numbers = legend.classes(coverage.dataset[name].values)
        meta, _, shapes, fields = pyogrio.raw.read(tmp_path / "coverage.gpkg",
                                                   layer=name.removesuffix("_dbm").removesuffix("_db").removesuffix("_bps"))
        assert meta["crs"] == "EPSG:4326"
        values = dict(zip(meta["fields"], fields))
        counts = {legend.labels[number]: (numbers == number).sum() for number in np.unique(numbers[numbers >= 0])}
        assert dict(zip(values["class"], values["area_m2"])) == {
            label: pytest.approx(100.0 * count) for label, count in counts.items()}
        areas = shapely.from_wkb(shapes)
        assert shapely.is_valid(areas).all()
        for x_m, y_m in ((-195.0, 5.0), (385.0, -385.0), (105.0, 205.0)):
            place = shapely.Point(*np.ravel(to_geographic(scene.config.origin, x_m, y_m)))
            (holder,) = np.flatnonzero(shapely.contains(areas, place))
            cell = legend.classes(coverage.dataset[name].sel(x=x_m, y=y_m).values[None])[0]
            assert values["class"][holder] == legend.labels[cell]
    meta, _, shapes, fields = pyogrio.raw.read(tmp_path / "coverage.gpkg", layer="transmitters")
    assert fields[list(meta["fields"]).index("device")].tolist() == ["west", "east"]


def test_overlays_have_the_colours_of_the_legend(coverage, scene, tmp_path):
    write_formats(coverage, scene, tmp_path, ["kmz"])
    with zipfile.ZipFile(tmp_path / "coverage.kmz") as archive:
        names = archive.namelist()
        document = ET.fromstring(archive.read("doc.kml"))
        pixels = np.asarray(Image.open(BytesIO(archive.read("overlays/000-00.png"))))
    assert names[0] == "doc.kml" and len([name for name in names if name.startswith("overlays/")]) == 5
    kml = "{http://www.opengis.net/kml/2.2}"
    assert [each.find(f"{kml}name").text for each in document.iter(f"{kml}Placemark")] == ["west", "east"]
    assert [each.find(f"{kml}name").text for each in document.iter(f"{kml}GroundOverlay")][:2] == ["Received power", "Best server"]
    legend = legend_of("received_power_dbm", coverage)
    times = pixels.shape[0] // 80
    for x_m, y_m in ((-195.0, 5.0), (-395.0, -395.0)):
        column, row = round((x_m + 395) / 10), round((y_m + 395) / 10)
        shown = pixels[::-1][row * times, column * times]
        number = legend.classes(coverage.dataset["received_power_dbm"].values)[row, column]
        assert "#" + bytes(shown[:3]).hex() == legend.colours[number] and shown[3] > 0
    inside = pixels[::-1][round((155 + 395) / 10) * times, round((195 + 395) / 10) * times]
    assert inside[3] == 0


def test_classes_begin_at_their_lower_end(coverage):
    legend = legend_of("received_power_dbm", coverage)
    assert legend.labels == ("≥ −60 dBm", "≥ −70 dBm", "≥ −80 dBm", "< −80 dBm")
    values = np.array([-59.9, -60.0, -60.1, -80.0, -80.1, np.nan])
    assert legend.classes(values).tolist() == [0, 0, 1, 2, 3, -1]


def test_without_an_origin_there_is_no_globe_and_without_rasterio_no_raster(coverage, scene, tmp_path, monkeypatch):
    local = Scene(scene.folder, scene.config.model_copy(update={"origin": None}))
    formats, notes = available_formats(local, None)
    assert formats == ["nc", "tif", "gpkg", "png"] and len(notes) == 1 and "has no [origin]" in notes[0]
    with pytest.raises(BadInput, match="has no .origin."):
        available_formats(local, ["kmz"])
    with pytest.raises(BadInput, match="unknown format 'shp'; allowed are nc, tif, gpkg, kmz, png"):
        available_formats(local, ["shp"])
    write_formats(coverage, local, tmp_path, ["tif", "gpkg"])
    with rasterio.open(tmp_path / "sinr.tif") as file:
        assert file.crs is None and file.bounds == (-400, -400, 400, 400)
    meta, _, shapes, _ = pyogrio.raw.read(tmp_path / "coverage.gpkg", layer="sinr")
    assert meta["crs"] is None or "Undefined" in meta["crs"]
    assert shapely.union_all(shapely.from_wkb(shapes)).bounds == (-400, -400, 400, 400)
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    formats, notes = available_formats(local, None)
    assert formats == ["nc", "png"] and all("rasterio" in note and "'radiotwin[gis]'" in note for note in notes[:2])


def test_maps_of_openstreetmap_are_credited(scene):
    assert attribution(scene) == ""
    of_osm = scene.config.model_copy(update={"provenance": {"source": "data/town.osm.pbf"}})
    assert attribution(Scene(scene.folder, of_osm)) == "© OpenStreetMap contributors (ODbL)"
