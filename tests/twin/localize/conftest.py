"""Truth for the tests: an exact sight line through boxes and the published law, written apart from the package."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.presets import preset_boxes
from tests.worlds import narrow_street, open_ground

__all__ = ["narrow_street", "open_ground"]

LIMIT_DB = -120.0


class PublishedLaw:
    """The statistical truth of Chen et al. as a channel: mean and sigma for LoS and NLoS."""

    def predict(self, links):
        offset = links.receiver_m - links.device_m
        log_d = np.log10(np.linalg.norm(offset, axis=1))
        return np.where(links.los, -30 - 25 * log_d, -35 - 30.4 * log_d), np.where(links.los, 2**0.5, 5**0.5)


class FreeSpace:
    def predict(self, links):
        log_d = np.log10(np.linalg.norm(links.receiver_m - links.device_m, axis=1))
        return -40 - 20 * log_d, np.full(len(log_d), 2.0)


def blocked(boxes, a, b):
    """(n,) bool: whether a segment passes through a box (slab method, double precision)."""
    hit = np.zeros(len(a), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for x0, y0, x1, y1, height in boxes:
            t0, t1 = (np.array([x0, y0, 0.0]) - a) / (b - a), (np.array([x1, y1, height]) - a) / (b - a)
            enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
            hit |= np.maximum(enter, 0) < np.minimum(leave, 1)
    return hit


def indoors(boxes, xy, z):
    within = (boxes[:, :2] < xy[:, None]) & (xy[:, None] < boxes[:, 2:4])
    return (within.all(axis=2) & (boxes[:, 4] > z)).any(axis=1)


@pytest.fixture(scope="session")
def boxes():
    """(n, 5) buildings of the RBM preset."""
    return preset_boxes("rbm")


@pytest.fixture(scope="session")
def city(boxes):
    """The RBM preset's buildings as overlapping solids."""
    solids = [trimesh.creation.box(bounds=[[x0, y0, 0], [x1, y1, h]]) for x0, y0, x1, y1, h in boxes]
    merged = trimesh.util.concatenate(solids)
    return CityMap(merged.vertices, merged.faces)


@pytest.fixture(scope="session")
def one_block():
    solid = trimesh.creation.box(bounds=[[80, 80, 0], [120, 120, 30]])
    return CityMap(solid.vertices, solid.faces)


@pytest.fixture(scope="session")
def flown():
    """Five random-waypoint flights of three UAVs on the 20 m lattice, 61 slots each: (915, 3)."""

    def fly(rng):
        track = []
        for altitude in np.repeat([55.0, 60.0, 65.0], 5):
            at, goal = np.array([16, 23]), np.array([16, 23])
            for _ in range(61):
                track.append([*(20.0 * at), altitude])
                while (goal == at).all():
                    goal = np.array([rng.integers(31), rng.integers(41)])
                axis = rng.choice(np.flatnonzero(goal != at))
                at = at + np.sign(goal - at) * (np.arange(2) == axis)
        return np.array(track)

    return fly


@pytest.fixture(scope="session")
def measured(boxes):
    """Draws levels by the published law: (receiver_m, device, level_db) of every device at every receiver."""

    def measure(device_xy, receiver_m, rng, z_m=1.5):
        k, n = len(device_xy), len(receiver_m)
        device = np.tile(np.arange(k), n)
        ends = np.column_stack([device_xy, np.full(k, z_m)])[device]
        receivers = np.repeat(receiver_m, k, axis=0)
        los = ~blocked(boxes, ends, receivers)
        log_d = np.log10(np.linalg.norm(receivers - ends, axis=1))
        level = np.where(los, -30 - 25 * log_d, -35 - 30.4 * log_d)
        level += np.where(los, 2**0.5, 5**0.5) * rng.standard_normal(len(level))
        return receivers, device, np.where(level < LIMIT_DB, np.nan, level)

    return measure


@pytest.fixture(scope="session")
def on_free_ground(boxes):
    def draw(n, rng):
        xy = rng.uniform([0, 0], [600, 800], (20 * n, 2))
        return xy[~indoors(boxes, xy, 1.5)][:n]

    return draw


@pytest.fixture(scope="session")
def published_law():
    return PublishedLaw()


@pytest.fixture(scope="session")
def free_space():
    return FreeSpace()
