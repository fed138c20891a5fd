"""Multipatches that pyshp wrote: boxes with roofs of triangles, a courtyard; and damaged ones."""

import numpy as np
import pytest
from pyproj import CRS

from radiotwin.errors import BadInput
from radiotwin.scene.readers.shapefiles import read_shapefile

shapefile = pytest.importorskip("shapefile")
STRIP, FAN, OUTER, INNER, FIRST, RING = range(6)
AT = np.array([477_400.0, 5_261_000.0, 400.0])
LOW = np.array([[0, 0, 0], [0, 20, 0], [20, 20, 0], [20, 0, 0]], float)
TOP = LOW + [0, 0, 9]
APEX = np.array([10, 10, 15.0])


def write(folder, parts, kinds, prj="EPSG:32632"):
    with shapefile.Writer(str(folder / "a"), shapeType=shapefile.MULTIPATCH) as writer:
        writer.field("NAME", "C", 10)
        writer.multipatch([(AT + part).tolist() for part in parts], partTypes=kinds)
        writer.record("a")
    if prj:
        (folder / "a.prj").write_text(CRS(prj).to_wkt("WKT1_ESRI"))
    return folder / "a.shp"


def house():
    """Walls as one strip, a floor as a ring, and a pyramid on it as a fan."""
    around = [0, 1, 2, 3, 0]
    strip = np.array([point for i in around for point in (LOW[i], TOP[i])])
    return [strip, np.array([APEX, *TOP[around]]), LOW[[0, 3, 2, 1, 0]]], [STRIP, FAN, RING]


def test_surfaces_of_a_house(tmp_path):
    (one,) = read_shapefile(write(tmp_path, *house())).features
    assert one.tags == {"name": "a", "building": "yes"} and len(one.shell.polygons) == 8 + 4 + 1
    assert one.shell.ground_m == 400 and one.shell.points[:, 2].max() == pytest.approx(415)
    assert one.area.bounds[:2] == pytest.approx((8.7, 47.5), abs=0.02)


def test_holes_belong_to_the_ring_before_them(tmp_path):
    hole = LOW[[0, 1, 2, 3, 0]] * 0.5 + [5, 5, 0]
    around = LOW[[0, 3, 2, 1, 0]]
    (one,) = read_shapefile(write(tmp_path, [around, hole, TOP[[0, 1, 2, 3, 0]], TOP[[0, 1, 2, 3, 0]] + 30, hole + 30],
                                  [OUTER, INNER, RING, FIRST, RING])).features
    assert [[len(ring) for ring in rings] for rings in one.shell.polygons] == [[4, 4], [4], [4, 4]]


def test_feet_become_metres(tmp_path):
    """US survey feet, of New York."""
    path = write(tmp_path, *house(), prj=None)
    (one,) = read_shapefile(path, "EPSG:2263").features
    assert np.ptp(one.shell.points[:, 2]) == pytest.approx(15 * 0.3048, abs=1e-3)


def test_without_a_system(tmp_path):
    path = write(tmp_path, *house(), prj=None)
    with pytest.raises(BadInput, match="has no .prj, which names its coordinate reference system; .*declare --crs"):
        read_shapefile(path)
    assert read_shapefile(path, "EPSG:32632").features
    write(tmp_path, *house())
    with pytest.raises(BadInput, match="and --crs says 'WGS 84 / UTM zone 33N'; leave --crs out"):
        read_shapefile(path, "EPSG:32633")


def test_a_damaged_part(tmp_path):
    path = write(tmp_path, *house())
    data = bytearray(path.read_bytes())
    data[100 + 8 + 44 + 4:100 + 8 + 44 + 8] = (10**6).to_bytes(4, "little")  # where the second part begins
    path.write_bytes(data)
    with pytest.raises(BadInput, match="is not a readable Shapefile .a part begins outside its shape"):
        read_shapefile(path)
