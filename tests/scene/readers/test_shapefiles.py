"""Shapefiles that GDAL wrote: outlines, courtyards, columns and systems; and damaged ones."""

import struct
import zipfile

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Geod

from radiotwin.errors import BadInput
from radiotwin.io.budgets import FEATURES, FILE_BYTES
from radiotwin.scene.readers.shapefiles import read_shapefile

SQUARE = np.array([[0, 0], [20, 0], [20, 20], [0, 20]]) + [477_400, 5_261_000]
COURTYARD = SQUARE[[0, 3, 2, 1]] * 0.5 + [238_705, 2_630_505]
PARTS = (".shp", ".shx", ".dbf", ".prj", ".cpg")


def write(folder, *areas, geometry_type="MultiPolygon", crs="EPSG:32632", encoding="UTF-8", **columns):
    columns = {"HOEHE": np.full(len(areas), 12.5)} | columns
    pyogrio.raw.write(folder / "a.shp", shapely.to_wkb(list(areas)), list(columns.values()), list(columns),
                      geometry_type=geometry_type, crs=crs, driver="ESRI Shapefile", encoding=encoding)
    return folder / "a.shp"


def area_m2(feature):
    return abs(Geod(ellps="WGS84").geometry_area_perimeter(shapely.orient_polygons(feature.area))[0])


@pytest.fixture
def town(tmp_path):
    """A house with a courtyard, and one of two wings."""
    wings = shapely.MultiPolygon([shapely.Polygon(SQUARE + 50), shapely.Polygon(SQUARE + 100)])
    return write(tmp_path, shapely.Polygon(SQUARE, [COURTYARD]), wings, num_floors=np.array([3, 4]),
                 name=np.array(["Müller", "b"], dtype=object))


def test_outlines_courtyards_and_columns(town):
    first, second = read_shapefile(town).features
    assert area_m2(first) == pytest.approx(300, rel=2e-3) and area_m2(second) == pytest.approx(800, rel=2e-3)
    assert len(first.area.geoms[0].interiors) == 1 and len(second.area.geoms) == 2
    assert first.tags == {"hoehe": "12.5", "num_floors": "3", "name": "Müller", "building": "yes"}
    assert first.area.bounds[:2] == pytest.approx((8.7, 47.5), abs=0.02)


@pytest.mark.parametrize("courtyard_turn", [1, -1])
@pytest.mark.parametrize("turn", [1, -1])
def test_a_courtyard_whichever_way_rings_turn(tmp_path, turn, courtyard_turn):
    shapefile = pytest.importorskip("shapefile")
    path = write(tmp_path, shapely.Polygon(SQUARE))  # for its .prj
    with shapefile.Writer(str(tmp_path / "a"), shapeType=shapefile.POLYGON) as writer:
        writer.field("HOEHE", "N", decimal=1)
        writer.poly([SQUARE[[0, 3, 2, 1, 0]][::turn].tolist(),
                     COURTYARD[[0, 1, 2, 3, 0]][::courtyard_turn].tolist()])
        writer.record(12.5)
    (one,) = read_shapefile(path).features
    assert area_m2(one) == pytest.approx(300, rel=2e-3) and one.area.is_valid


def test_text_of_another_code_page(tmp_path):
    path = write(tmp_path, shapely.Polygon(SQUARE), encoding="CP1252", name=np.array(["Straße"], dtype=object))
    assert read_shapefile(path).features[0].tags["name"] == "Straße"


def test_an_archive_holds_the_same(town, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for suffix in PARTS:
            archive.write(town.with_suffix(suffix), f"data/town{suffix.upper()}")
    found, plain = read_shapefile(tmp_path / "a.zip").features, read_shapefile(town).features
    assert [one.tags for one in found] == [one.tags for one in plain] and found[0].name == "data/town 1"
    assert all(one.area.equals(other.area) for one, other in zip(found, plain))


def damaged(suffix, offset, number):
    def change(town):
        path = town.with_suffix(suffix)
        data = bytearray(path.read_bytes())
        data[offset:offset + len(number)] = number
        path.write_bytes(data)
    return change


WITH_GRIDS = 'PROJCS["x",EXTENSION["PROJ4","+proj=latlong +nadgrids=/etc/passwd"]]'


@pytest.mark.parametrize(("change", "message"), [
    (lambda town: town.with_suffix(".dbf").unlink(), "the Shapefile a has no .dbf; keep its .shp, .dbf and .prj together"),
    (lambda town: town.with_suffix(".prj").unlink(), "the Shapefile a has no .prj, which names its coordinate reference system"),
    (lambda town: town.with_suffix(".prj").write_text(WITH_GRIDS), "WKT without grids"),
    (lambda town: write(town.parent, shapely.LineString(SQUARE), geometry_type="LineString"), "type 3, which is none of poly"),
    *((lambda town, at=at: town.write_bytes(town.read_bytes()[:at]), "cut off or damaged|its .shp begins otherwise")
      for at in (50, 101, 150, -1)),
    (damaged(".shp", 104, struct.pack(">i", -60)), "shape 1 is cut off"),  # a record that leads backwards
    (damaged(".shp", 144, struct.pack("<i", 2**31 - 1)), "not a readable Shapefile"),  # rings
    (damaged(".shp", 148, struct.pack("<i", 2**31 - 1)), "not a readable Shapefile"),  # corners
    (damaged(".shp", 152, struct.pack("<i", -7)), "a part begins outside"),
    (damaged(".shp", 160, struct.pack("<d", float("nan"))), "not finite"),
    (damaged(".dbf", 4, struct.pack("<I", 2**32 - 1)), "2 shapes, but 4,294,967,295 rows")])
def test_what_is_no_shapefile(town, change, message):
    change(town)
    with pytest.raises(BadInput, match=message):
        read_shapefile(town)


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"not an archive", None])
def test_what_is_no_archive_of_shapefiles(tmp_path, data):
    if data is None:
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            archive.writestr("../../etc/readme.txt", "x")
    else:
        (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(BadInput, match="holds no .shp file" if data is None else "not a readable ZIP archive"):
        read_shapefile(tmp_path / "a.zip")


def test_a_link_out_of_the_folder(town, tmp_path):
    (tmp_path / "in").mkdir()
    for suffix in PARTS:
        town.with_suffix(suffix).rename(tmp_path / "in" / f"a{suffix}")
    (tmp_path / "in" / "a.dbf").rename(tmp_path / "a.dbf")
    (tmp_path / "in" / "a.dbf").symlink_to(tmp_path / "a.dbf")
    with pytest.raises(BadInput, match="leads out of"):
        read_shapefile(tmp_path / "in" / "a.shp")


def test_budgets(town, tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.shp", bytes(10_000_000))
    monkeypatch.setenv(FILE_BYTES.variable, "1_000_000")
    with pytest.raises(BadInput, match="unpacked: 10,000,000 bytes; at most 1,000,000"):
        read_shapefile(tmp_path / "a.zip")
    monkeypatch.setenv(FEATURES.variable, "1")
    with pytest.raises(BadInput, match="2 buildings; at most 1"):
        read_shapefile(town)
