"""Worlds whose truth is written down here, apart from the package: a law, a law with a break point, random positions."""

from dataclasses import dataclass

import numpy as np
import pytest

from radiotwin.links import LinkGeometry

ANCHOR_M = np.array([[60.0, 320.0, 1.5], [320.0, 120.0, 1.5], [580.0, 520.0, 1.5]])
LAW = {True: (-30.0, 2.5, 2.0**0.5), False: (-35.0, 3.04, 5.0**0.5)}


@dataclass
class World:
    """n links with the mean and the level [dB] that they truly have; NaN = not detected."""

    links: LinkGeometry
    mean_db: np.ndarray
    level_db: np.ndarray


def paper_law(distance_m, los, elevation_rad):
    """The published segmented law [dB]."""
    lines = np.array([LAW[False], LAW[True]])[los.astype(int)]
    return lines[:, 0] - 10.0 * lines[:, 1] * np.log10(distance_m)


def law_with_break_point(distance_m, los, elevation_rad):
    """Return free space in LoS to a break point at 200 m and the sixth power beyond (nearly two-ray); in NLoS a loss that
    falls with elevation, as over roofs [dB]."""
    decades = np.log10(distance_m / 200.0)
    los_db = -86.0 - 20.0 * decades - 40.0 * np.maximum(decades, 0.0)
    nlos_db = -90.0 - 20.0 * decades - 25.0 * np.exp(-elevation_rad / 0.2)
    return np.where(los, los_db, nlos_db)


@pytest.fixture(scope="session")
def world():
    """world(seed, n, limit_db=None, law=paper_law, nlos_share=...) -> World around three anchors in 600 x 800 m."""

    def make(seed, n, limit_db=None, law=paper_law, los_range_m=400.0, device_m=ANCHOR_M):
        rng = np.random.default_rng(seed)
        device = rng.integers(0, len(device_m), n)
        receiver_m = np.column_stack(
            [rng.uniform(0, 600, n), rng.uniform(0, 800, n), rng.choice([55.0, 60.0, 65.0], n)]
        )
        offset = receiver_m - device_m[device]
        distance_m = np.linalg.norm(offset, axis=1)
        los = rng.uniform(size=n) < np.exp(-distance_m / los_range_m)
        mean_db = law(distance_m, los, np.arcsin(offset[:, 2] / distance_m))
        sigma_db = np.where(los, LAW[True][2], LAW[False][2])
        level_db = mean_db + sigma_db * rng.standard_normal(n)
        if limit_db is not None:
            level_db[level_db < limit_db] = np.nan
        return World(LinkGeometry(device_m[device], receiver_m, los, device), mean_db, level_db)

    return make


@pytest.fixture(scope="session")
def laws():
    """The laws by name."""
    return {"paper": paper_law, "break point": law_with_break_point, "parameters": LAW}


@pytest.fixture(scope="session")
def fitted_nn(world):
    """One network, fitted to 900 links of the paper's law, and its world; many tests only read it."""
    from radiotwin.propagation.laws.segmented_nn import SegmentedNN

    train = world(100, 900, limit_db=-120.0)
    return SegmentedNN().fit(train.links, train.level_db, -120.0, seed=1), train
