"""Names of coordinate reference systems, and the order of coordinates."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from radiotwin.errors import BadInput
from radiotwin.scene.readers.systems import (
    find_city_system,
    find_system,
    plane_of,
    to_degrees,
    vertical_unit_m,
)

FILE = Path("a.gml")


@pytest.mark.parametrize(("name", "code"), [
    ("EPSG:25832", 25832), ("urn:ogc:def:crs:EPSG::7415", 7415), ("urn:ogc:def:crs:EPSG:6.12:28992", 28992),
    ("https://www.opengis.net/def/crs/EPSG/0/7415", 7415), ("http://www.opengis.net/def/crs/EPSG/9.9.1/25832", 25832),
    ("urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::5783", 25832), ("http://www.opengis.net/gml/srs/epsg.xml#4326", 4326),
    ("urn:adv:crs:ETRS89_UTM33*DE_DHHN2016_NH", 25833), ("urn:adv:crs:DE_DHDN_3GK4", 31468),
    ("urn:ogc:def:crs:OGC::CRS84", 4326)])
def test_names_of_city_models(name, code):
    assert find_city_system(FILE, name).equals(CRS.from_epsg(code), ignore_axis_order=True)


@pytest.mark.parametrize("name", ["local", "EPSG:1", "EPSG:999999", "/etc/passwd", "+proj=latlong +nadgrids=/etc/passwd",
                                  "urn:adv:crs:DE_DHDN_3GK9", "", "file:///etc/passwd"])
def test_unknown_names(name):
    with pytest.raises(BadInput, match="a.gml: its coordinate reference system .* is unknown"):
        find_city_system(FILE, name)
    with pytest.raises(BadInput, match="is unknown"):
        find_system(FILE, name or "?")


@pytest.mark.parametrize(("name", "point"), [
    ("EPSG:25832", (691_607, 5_334_760)), ("EPSG:4326", (48.1374, 11.5755)), ("OGC:CRS84", (11.5755, 48.1374)),
    ("EPSG:31468", (4_468_503, 5_333_318)), ("EPSG:31468", (5_333_318, 4_468_503)), ("EPSG:25832", (5_334_760, 691_607))])
def test_the_place_tells_the_order_of_coordinates(name, point):
    # Marienplatz in Munich, 48.1374° N 11.5755° E
    assert to_degrees(FILE, find_system(FILE, name), np.array([point]))[0] == pytest.approx((11.5755, 48.1374), abs=2e-3)


@pytest.mark.parametrize(("name", "point"), [("EPSG:25832", (85_000, 446_000)), ("EPSG:7415", (691_607, 5_334_760)),
                                             ("EPSG:4326", (691_607, 5_334_760)), ("EPSG:25832", (11.6, 48.1))])
def test_a_wrong_system_is_noticed(name, point):
    with pytest.raises(BadInput, match="are not in the area of .*; correct the coordinate reference system"):
        to_degrees(FILE, find_system(FILE, name), np.array([point]))


def test_units_of_elevations():
    assert vertical_unit_m(CRS.from_epsg(7415)) == 1 and vertical_unit_m(CRS.from_epsg(4979)) == 1
    assert vertical_unit_m(CRS.from_epsg(25832)) == 1 and vertical_unit_m(CRS.from_epsg(4326)) == 1
    assert vertical_unit_m(CRS.from_epsg(2263)) == pytest.approx(0.3048006)  # New York, US survey feet
    assert plane_of(CRS.from_epsg(7415)) == CRS.from_epsg(28992)
