import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer

from radiotwin.geo import local_crs, to_geographic, to_local
from radiotwin.io.forms import Origin

ORIGIN = Origin(latitude_deg=47.5, longitude_deg=8.7)


def test_distance_and_bearing_from_the_origin_are_those_on_the_ellipsoid():
    longitude, latitude = np.array([8.71, 8.6]), np.array([47.52, 47.4])
    x_m, y_m = to_local(ORIGIN, longitude, latitude)
    azimuth, _, distance_m = Geod(ellps="WGS84").inv([8.7] * 2, [47.5] * 2, longitude, latitude)
    assert np.hypot(x_m, y_m) == pytest.approx(distance_m, abs=1e-3)
    assert np.degrees(np.arctan2(x_m, y_m)) == pytest.approx(azimuth, abs=1e-6)


def test_there_and_back_and_as_proj_reads_the_text():
    x_m, y_m = np.array([-2000.0, 0.0, 700.0]), np.array([10.0, 0.0, -1500.0])
    longitude, latitude = to_geographic(ORIGIN, x_m, y_m)
    for axis, back in zip((x_m, y_m), to_local(ORIGIN, longitude, latitude)):
        assert back == pytest.approx(axis, abs=1e-6)
    proj = Transformer.from_crs(CRS(local_crs(ORIGIN)), "EPSG:4326", always_xy=True)
    assert np.array(proj.transform(x_m, y_m)) == pytest.approx(np.array([longitude, latitude]), abs=1e-9)
