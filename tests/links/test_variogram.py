"""What detrending leaves of a field, against covariances that are multiplied out, and lengths of fields that are known."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from radiotwin.links import correlation as variogram
from radiotwin.links.correlation import Trend, Variogram, pairs_of_links


def tracks(seed, flights=4, slots=80, side_m=400.0):
    rng = np.random.default_rng(seed)
    ends = rng.uniform(0, side_m, (flights, 2, 2))
    share = np.linspace(0, 1, slots)[:, None]
    place_m = np.vstack([a + share * (b - a) for a, b in ends])
    from_m = place_m - side_m / 2
    links = SimpleNamespace(azimuth_deg=np.degrees(np.arctan2(*from_m.T)), distance_m=np.hypot(*from_m.T) + 20.0)
    return place_m, links, np.repeat(np.arange(flights), slots)


def test_what_is_left_of_a_field_is_what_its_covariance_says():
    place_m, links, series = tracks(0)
    trend = Trend.of(links, np.arange(len(series)), series)
    i, j = np.array([0, 5, 100, 200]), np.array([3, 60, 101, 239])
    left = trend.semivariances(place_m, i, j, np.array([15.0, 60.0]))
    minus = np.eye(len(series)) - trend.basis @ trend.basis.T
    for found, covariance in zip(left, (np.eye(len(series)), *(np.exp(-cdist(place_m, place_m) / length_m)
                                                               for length_m in (15.0, 60.0))), strict=True):
        rest = minus @ covariance @ minus
        np.testing.assert_allclose(found, 0.5 * (rest[i, i] + rest[j, j] - 2 * rest[i, j]), atol=1e-6)


def test_some_links_stand_for_many(monkeypatch):
    place_m, links, series = tracks(1, slots=400)
    trend = Trend.of(links, np.arange(len(series)), series)
    i = np.arange(0, 1590, 30)
    exact = Trend.semivariances(trend, place_m, i, i + 9, np.array([10.0, 100.0]))
    monkeypatch.setattr(variogram, "NODES", 10_000)
    np.testing.assert_allclose(exact, trend.semivariances(place_m, i, i + 9, np.array([10.0, 100.0])), atol=0.02)


@pytest.mark.seconds
@pytest.mark.parametrize(("length_m", "within"), [(20.0, 1.4), (40.0, 1.5), (80.0, 1.9)])
def test_a_length_that_trends_take_much_of_is_recovered(length_m, within):
    """Flights are 150 to 450 m long, a few lengths."""
    found = []
    for seed in range(8):
        place_m, links, series = tracks(10 + seed, flights=5, slots=120)
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(np.exp(-cdist(place_m, place_m) / length_m) + 1e-6 * np.eye(len(series)))
        fields = root @ rng.normal(size=(len(series), 5)) + 0.6 * rng.normal(size=(len(series), 5))
        rows = np.arange(len(series) * 5).reshape(5, -1)
        many = SimpleNamespace(azimuth_deg=np.tile(links.azimuth_deg, 5), distance_m=np.tile(links.distance_m, 5))
        all_series = np.tile(series, 5) + np.repeat(np.arange(5), len(series)) * 10
        trends = [Trend.of(many, each, all_series) for each in rows]
        place = np.column_stack([np.tile(place_m, (5, 1)), 1e5 * all_series])
        measured = Variogram.of(place[:, :2], trends, *pairs_of_links(place), np.geomspace(3.0, 140.0, 24))
        found.append(measured.length_m(fields.T.ravel()))
    assert length_m / within < np.exp(np.mean(np.log(found))) < within * length_m
