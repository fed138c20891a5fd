"""Paths that are followed once: several devices at a time, by as many threads as there are, with the same result."""

import numpy as np
import pytest
import trimesh

from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws import followed_paths
from radiotwin.propagation.laws.followed_paths import path_gains, paths_of
from radiotwin.runtime.pieces import keep_pieces
from radiotwin.scene.citymap import CityMap

DEVICES, PLACES, RECEIVERS = 4, 3, 12


@pytest.fixture
def geometry():
    """Links from three places, one of them of two devices, over two walls; in no order."""
    walls = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in
                                      ([[-20, 20, 0], [220, 25, 30]], [[95, -30, 0], [100, -15, 30]])])
    city, rng = CityMap(walls.vertices, walls.faces), np.random.default_rng(0)
    places_m = np.array([[0.0, 0, 10], [60, -40, 5], [150, 10, 2], [0, 0, 10]])
    device = rng.permutation(np.repeat(np.arange(DEVICES), RECEIVERS))
    receiver_m = np.column_stack([rng.uniform(110, 200, len(device)), rng.uniform(-60, 15, len(device)),
                                  rng.uniform(10, 40, len(device))])
    device_m = places_m[device]
    return LinkGeometry(device_m, receiver_m, city.line_of_sight(device_m, receiver_m), device, city, 2.4e9)


def test_several_devices_are_followed_as_each_by_itself(geometry, monkeypatch, tmp_path):
    """By one thread or three, in one batch or several, and from what an earlier run kept."""
    alone = np.zeros(len(geometry))
    for device in range(DEVICES):
        rows = np.flatnonzero(geometry.device == device)
        alone[rows] = path_gains(geometry.select(rows))
    assert (alone > 0).all()
    monkeypatch.setattr("radiotwin.runtime.pieces.MIN_SECONDS", 0.0)
    for threads, most in (("3", followed_paths.BATCH_LINKS), ("1", 1.5 * RECEIVERS)):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        monkeypatch.setattr(followed_paths, "BATCH_LINKS", most)
        followed_paths._remembered.clear()
        np.testing.assert_array_equal(path_gains(geometry), alone)
    with keep_pieces(tmp_path) as store:
        for made in (DEVICES, DEVICES):  # all at first, none more after that
            followed_paths._remembered.clear()
            np.testing.assert_array_equal(path_gains(geometry), alone)
            assert store.made == made


def test_parts_of_a_devices_links_change_nothing(geometry, monkeypatch):
    whole = path_gains(geometry), paths_of(geometry)
    followed_paths._remembered.clear()
    monkeypatch.setattr(followed_paths, "ENDS_CHUNK", 5)
    np.testing.assert_array_equal(path_gains(geometry), whole[0])
    for each, other in zip(paths_of(geometry), whole[1], strict=True):
        np.testing.assert_array_equal(each, other)


def test_sectors_of_one_mast_are_followed_once(geometry, monkeypatch):
    """Two of the devices stand at one place; each had the other's paths forgotten."""
    asked, follow = [], followed_paths.path_powers

    def spied(city, device_m, receiver_m, *more):
        asked.append(len(receiver_m))
        return follow(city, device_m, receiver_m, *more)

    monkeypatch.setattr(followed_paths, "path_powers", spied)
    followed_paths._remembered.clear()
    first = path_gains(geometry)
    assert len(asked) == PLACES and sum(asked) == len(geometry)
    np.testing.assert_array_equal(path_gains(geometry), first)
    assert len(asked) == PLACES, "all is remembered"
    monkeypatch.setattr(followed_paths, "MAX_REMEMBERED_BYTES", 0)
    path_gains(geometry)
    assert len(followed_paths._remembered) == followed_paths.MIN_REMEMBERED
