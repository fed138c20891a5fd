"""Sectors of one mast: what their residuals share is learnt, what they do not share is not."""

import json

import numpy as np
import pytest

from radiotwin.effects.catalogue.declared_sectors import (
    GROUP_SD_DB,
    level_groups,
    unheard_sd_db,
    unshared_sd_db,
)
from radiotwin.links.sites import antenna_of, relatives_of
from radiotwin.twin.model.correlated_shadowing import Relatives, RelativesState
from tests.worlds import synthetic_links

MASTS_M = np.array([[100.0, 100, 25], [400, 300, 25]])
# Two masts of two directions, two carriers of each; and a device by itself.
MAST = np.array([0, 0, 0, 0, 1, 1, 1, 1, 2])
AZIMUTHS_DEG = np.array([30.0, 31, 210, 212, 359, 2, 120, 118, np.nan])
DIRECTION = np.array([0, 0, 1, 1, 2, 2, 3, 3, 4])


def links_of(rng, points=150, declared=True):
    """Return the links of nine devices to a car that drives about, each device measured elsewhere."""
    device = np.repeat(np.arange(9), points)
    receiver_m = np.column_stack([rng.uniform(0, 500, (len(device), 2)), np.full(len(device), 1.5)])
    device_m = np.vstack([MASTS_M, [[250.0, 50, 10]]])[MAST]
    links = synthetic_links(device_m, device, receiver_m, frequency_hz=3.6e9)
    return links.with_ends(boresight_deg=AZIMUTHS_DEG) if declared else links


def shadows(rng, links, group):
    """Return a field of 80 m and unit variance for each group of devices, at its links."""
    apart_m = np.linalg.norm(links.receiver_m[:, None] - links.receiver_m[None], axis=2)
    same = group[links.device][:, None] == group[links.device][None]
    covariance = same * np.exp(-apart_m / 80.0) + 1e-6 * np.eye(len(links))
    return np.linalg.cholesky(covariance) @ rng.normal(size=len(links))


def test_relatives_are_the_carriers_of_an_antenna_or_else_the_sectors_of_a_mast():
    links = links_of(np.random.default_rng(0), 1)
    assert [antenna_of(links, device) for device in (0, 4, 8)] == [[0, 1], [4, 5], [8]]
    everyone = set(range(9))
    assert [relatives_of(links, device, everyone) for device in (0, 5, 6, 8)] == [[1], [4], [7], []]
    # Two planned carriers of one direction tell nothing of each other.
    assert relatives_of(links, 0, everyone - {0, 1}) == [2, 3]
    undeclared = links_of(np.random.default_rng(0), 1, declared=False)
    assert [relatives_of(undeclared, device, everyone) for device in (0, 5, 8)] == [[1, 2, 3], [4, 6, 7], []]
    # A device that was located, not declared, may be on the mast by mistake.
    assert relatives_of(undeclared.with_ends(anchors=frozenset({0, 1, 4})), 0, everyone) == [1]
    # Azimuths of 30, 34 and 38 degrees are one group, whichever of them is asked for.
    steps = links.with_ends(boresight_deg=np.array([30.0, 34, 38, 212, *AZIMUTHS_DEG[4:]]))
    assert [antenna_of(steps, device) for device in range(4)] == [[0, 1, 2], [0, 1, 2], [0, 1, 2], [3]]


@pytest.mark.parametrize("seed", range(3))
def test_an_unheard_carrier_is_predicted_by_the_other_one_as_surely_as_said(seed):
    rng = np.random.default_rng(seed)
    links = links_of(rng)
    z = shadows(rng, links, DIRECTION) + 0.4 * rng.normal(size=len(links))
    heard = links.device != 0
    relatives = Relatives.fit(links.select(heard), z[heard], None, seed)
    assert relatives.passed_on[0] > 0.6 and relatives.passed_on[1] < 0.25  # whose only relatives are of another direction
    mean, left = relatives.at(links.select(~heard))
    error = z[~heard] - mean
    assert error.std() < 0.88 * z[~heard].std()
    assert 0.8 < (error / (left * z.std())).std() < 1.3
    alone_mean, alone_left = relatives.at(links.select(links.device == 8))  # which has none
    assert (alone_mean == 0).all() and (alone_left == 1).all()


@pytest.mark.parametrize("seed", range(3))
def test_fields_that_have_nothing_in_common_are_not_passed_on(seed):
    rng = np.random.default_rng(seed)
    links = links_of(rng)
    z = shadows(rng, links, np.arange(9)) + 0.4 * rng.normal(size=len(links))
    assert max(Relatives.fit(links, z, None, seed).passed_on.values()) < 0.25


def test_what_is_stored_says_the_same():
    rng = np.random.default_rng(4)
    links = links_of(rng, 60)
    relatives = Relatives.fit(links, shadows(rng, links, DIRECTION), None, 0)
    stored = json.loads(json.dumps(relatives.state()))
    again = Relatives.of(RelativesState.model_validate(stored))
    np.testing.assert_allclose(again.at(links), relatives.at(links), atol=0.02)  # positions to a decimetre
    with pytest.raises(ValueError, match="passed_on"):
        RelativesState.model_validate(stored | {"passed_on": [1.5] * 8})
    with pytest.raises(ValueError, match="not of the devices"):
        Relatives.of(RelativesState.model_validate(stored | {"passed_on": [0.5]}))


def test_with_nobody_beside_it_nothing_is_said():
    rng = np.random.default_rng(5)
    links = links_of(rng, 60)
    alone = links.select(links.device == 8)
    assert Relatives.fit(alone, rng.normal(size=len(alone)), None, 0) is None


def test_levels_are_nested_in_masts_and_directions():
    links = links_of(np.random.default_rng(0), 1)
    groups = level_groups(links, list(range(9)))
    assert groups == [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1], [2, 3], [4, 5], [6, 7]]
    assert unshared_sd_db(list(range(9)), groups).tolist() == [3.0] * 8 + [pytest.approx(np.sqrt(27))]  # a mast for itself
    assert level_groups(links, [0, 2, 8]) == [[0, 2]]  # of three directions two are on a mast
    assert level_groups(links, [0, 1]) == [[0, 1], [0, 1]]  # a mast of one direction


def test_how_uncertain_an_unheard_level_is_against_drawn_ones():
    """A hundred thousand networks, and the regression of one device's level on those of the others."""
    rng = np.random.default_rng(6)
    groups = [[0, 1, 2, 3], [4, 5], [0, 1], [2, 3], [4, 5]]
    level_db = 15.0 * rng.normal(size=(100_000, 1)) + 3.0 * rng.normal(size=(100_000, 6))
    for group in groups:
        level_db[:, group] += GROUP_SD_DB * rng.normal(size=(100_000, 1))
    found = unheard_sd_db(list(range(6)), groups, {1, 2, 3, 4, 5}, 15.0)
    others = level_db[:, 1:]
    slopes = np.linalg.lstsq(others, level_db[:, 0], rcond=None)[0]
    assert found == {0: pytest.approx((level_db[:, 0] - others @ slopes).std(), rel=0.02)}
    fewer = unheard_sd_db(list(range(6)), groups, {4}, 15.0)
    assert sorted(fewer) == [0, 1, 2, 3, 5]
    assert found[0] < fewer[0] and fewer[5] < fewer[0]  # its own carrier tells most of it
    # A mast that nobody has heard: between masts, directions and devices there are 3 dB each, heard ones known.
    many = [[2 * mast, 2 * mast + 1] for mast in range(200) for _ in range(2)]
    alone = unheard_sd_db(list(range(401)), many, set(range(400)), 15.0)
    assert alone == {400: pytest.approx(np.sqrt(27), rel=0.02)}
