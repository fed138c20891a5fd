"""Effects that are linear: offsets, and loss per kilometre."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.params import Estimate

DEVICES_M = np.array([[0.0, 0, 1.5], [100, 0, 1.5], [0, 100, 1.5]])


@pytest.fixture
def links(make_links):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-200, 200, (60, 2)), np.full(60, 40.0)])
    return make_links(DEVICES_M, receiver_m, receiver=np.repeat(np.arange(60) % 2, 3),
                      heading_deg=np.repeat(rng.uniform(0, 360, 60), 3))


@pytest.mark.parametrize("effect, kind", [(DeviceGainOffset(), "device"), (ReceiverGainOffset(), "receiver")])
def test_an_offset_is_added_to_its_own_links(links, view, effect, kind):
    (params,) = effect.propose(view(links, np.zeros(len(links)), 1.0))
    term = effect.with_params(params).term(links, None)
    offsets_db = np.array([2.0, -3.0, 7.0])[:len(params.members)]
    np.testing.assert_array_equal(term.columns @ offsets_db, offsets_db[getattr(links, kind)])


def test_offsets_are_reported_relative_to_the_median_member_with_the_error_of_the_difference(links):
    covariance = np.array([[0.5, 0.1, 0.2], [0.1, 0.4, 0.0], [0.2, 0.0, 0.9]])
    estimate = Estimate(np.array([5.0, -1.0, 2.0]), [0.3 * np.eye(3), covariance], np.zeros((2, 0)))
    params = DeviceGainOffset.Params(members=[0, 1, 2], offsets_sd_db=2.5)
    offsets = DeviceGainOffset().with_params(params).parameters(links, estimate)
    assert [offsets[f"offset_db[d{i}]"].value for i in range(3)] == [3.0, -3.0, 0.0]
    half = 1.6449 * np.sqrt(0.5 + 0.9 - 2 * 0.2)
    assert offsets["offset_db[d0]"].high == pytest.approx(3 + half, abs=1e-3)
    assert offsets["offset_db[d2]"].low == offsets["offset_db[d2]"].high == 0


def test_one_member_cannot_be_off(make_links):
    assert "two receivers" in ReceiverGainOffset().unavailable(make_links(DEVICES_M, np.ones((60, 3))))


def test_a_loss_per_kilometre_is_in_proportion_to_distance(links):
    term = ExcessAttenuation().with_params(ExcessAttenuation.Params(scale_height_m=1e7)).term(links, None)
    distance_km = np.sqrt(((links.receiver_m - DEVICES_M[links.device]) ** 2).sum(axis=1)) / 1000
    np.testing.assert_allclose(term.columns @ [12.0], -12 * distance_km, rtol=1e-4)
    unbounded = ExcessAttenuation.Params(scale_height_m=1e7)
    assert ExcessAttenuation().with_params(unbounded).implausible(np.array([12.0])) is None
    assert "amplify" in ExcessAttenuation().with_params(unbounded).implausible(np.array([-12.0]))


def test_a_loss_that_decreases_with_height_is_the_integral_along_the_link(links):
    term = ExcessAttenuation().with_params(ExcessAttenuation.Params(scale_height_m=30.0)).term(links, None)
    share = (np.arange(2000) + 0.5)[:, None] / 2000
    start_m, end_m = DEVICES_M[links.device], links.receiver_m
    density = np.exp(-(start_m[:, 2] + share * (end_m - start_m)[:, 2]) / 30).mean(axis=0)
    expected_db = -12 * np.linalg.norm(end_m - start_m, axis=1) / 1000 * density
    np.testing.assert_allclose(term.columns @ [12.0], expected_db, rtol=1e-4)


def test_no_offset_is_proposed_where_one_member_only_has_enough_links(links, view):
    few = links.select((links.device == 0) | (np.arange(len(links)) < 30))
    assert np.bincount(few.device).tolist() == [60, 10, 10]
    assert DeviceGainOffset().propose(view(few, np.zeros(len(few)), 1.0)) == []


def test_a_member_without_an_estimate_has_the_standard_deviation_of_the_others(links):
    params = DeviceGainOffset.Params(members=[0, 1], offsets_sd_db=2.5)
    np.testing.assert_array_equal(DeviceGainOffset().with_params(params).term(links, None).unheard_sd_db,
                                  np.where(links.device == 2, 2.5, 0.0))
