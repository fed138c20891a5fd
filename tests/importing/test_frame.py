"""From degrees to local metres, against closed forms on the WGS84 ellipsoid."""

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad

from radiotwin.importing.positions import find_origin, to_geographic
from radiotwin.io.forms import Origin
from radiotwin.links.site_table import local_positions

A_M, F = 6378137.0, 1 / 298.257223563
E2 = F * (2 - F)


def positions(**columns):
    return to_geographic(pd.DataFrame({name: np.atleast_1d(values) for name, values in columns.items()}), None)


def origin(latitude, longitude, altitude=0.0):
    return Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)


@pytest.mark.parametrize("latitude", [-33.9, 0.0, 48.1, 69.6])
def test_north_is_the_arc_of_the_meridian(latitude):
    radius_m = lambda phi: A_M * (1 - E2) / (1 - E2 * np.sin(phi) ** 2) ** 1.5  # noqa: E731
    arc_m, _ = quad(radius_m, np.radians(latitude), np.radians(latitude + 0.2))
    x_m, y_m, _ = local_positions(positions(latitude=latitude + 0.2, longitude=11.5), origin(latitude, 11.5))[0]
    assert y_m == pytest.approx(arc_m, abs=1e-4) and x_m == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("latitude", [-33.9, 0.0, 48.1, 69.6])
def test_east_is_the_circle_of_the_prime_vertical(latitude):
    """Over a hundred metres the ellipsoid is the circle with the prime vertical's radius; x is east, not north."""
    radius_m = A_M / np.sqrt(1 - E2 * np.sin(np.radians(latitude)) ** 2)
    x_m, y_m, _ = local_positions(positions(latitude=latitude, longitude=-179.9995), origin(latitude, 179.9995))[0]
    assert x_m == pytest.approx(radius_m * np.cos(np.radians(latitude)) * np.radians(0.001), abs=1e-4) and abs(y_m) < 2e-3


def test_heights_are_kept_above_the_declared_ground():
    mixed = pd.concat([positions(latitude=48.2, longitude=11.5, altitude=540.0),
                       positions(latitude=48.1, longitude=11.5, height=7.0),
                       positions(latitude=48.1, longitude=11.5)])
    np.testing.assert_array_equal(local_positions(mixed, origin(48.1, 11.5, 519.0))[:, 2], [21.0, 7.0, np.nan])


def test_the_origin_is_the_median_of_the_receivers():
    receivers = positions(latitude=[48.0, 48.1, 49.9], longitude=[11.0, 11.3, 11.2])
    found = find_origin(None, receivers, positions(latitude=10.0, longitude=10.0))
    assert found == Origin(latitude_deg=48.1, longitude_deg=11.2)
    np.testing.assert_allclose(local_positions(positions(latitude=48.1, longitude=11.2), found)[0, :2], 0, atol=1e-9)


def test_the_median_across_the_date_line():
    receivers = positions(latitude=[-17.0, -17.0, -17.0], longitude=[179.9, -179.9, -179.8])
    found = find_origin(None, receivers, receivers)
    assert found.longitude_deg == -179.9
    assert np.abs(local_positions(receivers, found)[:, 0]).max() < 30_000


def test_utm_gives_the_same_metres_as_degrees():
    """Easting 500 km, on the central meridian of zone 32 (9° E), where UTM has the scale 0.9996 exactly."""
    utm = to_geographic(pd.DataFrame({"x": [500_000.0, 500_000.0], "y": [5_300_000.0, 5_301_000.0], "z": [3.0, 4.0]}),
                        "EPSG:32632")
    np.testing.assert_allclose(utm["longitude"], 9.0, atol=1e-9)
    found = find_origin(Origin(latitude_deg=utm["latitude"][0], longitude_deg=9.0), utm, utm)
    np.testing.assert_allclose(local_positions(utm, found), [[0, 0, 3], [0, 1000 / 0.9996, 4]], atol=1e-4)


def test_an_area_across_the_date_line():
    """Zone 1 begins at 180° W; half a degree west of it is 179.5° E."""
    from pyproj import Proj
    x, y = Proj("EPSG:32601")(179.5, 52.0)
    found = to_geographic(pd.DataFrame({"x": [x], "y": [y]}), "EPSG:32601")
    assert found["longitude"][0] == pytest.approx(179.5) and found["latitude"][0] == pytest.approx(52.0)
