"""Effects that are linear: offsets, loss per kilometre, curves without a cause; and what a change is worth in nats."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import t

from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from radiotwin.effects.params import Estimate
from radiotwin.effects.registry import effect_named
from radiotwin.errors import BadInput
from tests.effects.conftest import with_params

SCALE_DB, LIMIT_DB = 4.0, -100.0
DEVICES_M = np.array([[0.0, 0, 1.5], [100, 0, 1.5], [0, 100, 1.5]])


@pytest.fixture
def links(make_links):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-200, 200, (60, 2)), np.full(60, 40.0)])
    return make_links(DEVICES_M, receiver_m, receiver=np.repeat(np.arange(60) % 2, 3),
                      heading_deg=np.repeat(rng.uniform(0, 360, 60), 3))


@pytest.mark.parametrize("effect, kind", [(DeviceGainOffset(), "device"), (ReceiverGainOffset(), "receiver")])
def test_an_offset_is_added_to_its_own_links(links, view, effect, kind):
    (params,) = effect.propose(view(links))
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


@pytest.mark.parametrize("scale_height_m", [1e7, 30.0])
def test_a_loss_per_kilometre_is_the_integral_along_the_link(links, scale_height_m):
    term = with_params(ExcessAttenuation, scale_height_m=scale_height_m).term(links, None)
    share = (np.arange(2000) + 0.5)[:, None] / 2000
    start_m, end_m = DEVICES_M[links.device], links.receiver_m
    density = np.exp(-(start_m[:, 2] + share * (end_m - start_m)[:, 2]) / scale_height_m).mean(axis=0)
    expected_db = -12 * np.linalg.norm(end_m - start_m, axis=1) / 1000 * density
    np.testing.assert_allclose(term.columns @ [12.0], expected_db, rtol=1e-4)


def test_no_offset_is_proposed_where_one_member_only_has_enough_links(links, view):
    few = links.select((links.device == 0) | (np.arange(len(links)) < 30))
    assert np.bincount(few.device).tolist() == [60, 10, 10]
    assert DeviceGainOffset().propose(view(few)) == []


def test_a_member_without_an_estimate_has_the_standard_deviation_of_the_others(links):
    params = DeviceGainOffset.Params(members=[0, 1], offsets_sd_db=2.5)
    np.testing.assert_array_equal(DeviceGainOffset().with_params(params).term(links, None).unheard_sd_db,
                                  np.where(links.device == 2, 2.5, 0.0))


@pytest.mark.parametrize(("variable", "receivers", "is_on_maps"), [
    ("azimuth_deg", [None], True), ("azimuth_deg", [0, 1], False), ("time_s", [None], False),
    ("heading_deg", [None], False), ("quality", [None], False), ("distance_m", [None], True)])
def test_a_map_has_what_depends_on_places_alone(variable, receivers, is_on_maps):
    curve = UnexplainedTrend.Params(knots=[0.0, 1.0], receivers=receivers)
    assert UnexplainedTrend(variable).with_params(curve).is_on_maps() == is_on_maps


def test_only_such_curves_are_read_from_a_twin():
    found = effect_named("unexplained_trend", "over azimuth_deg")
    assert isinstance(found, UnexplainedTrend) and found.variable == "azimuth_deg"
    for variant in ("over time_s", "azimuth", ""):
        with pytest.raises(BadInput, match="unexplained_trend"):
            effect_named("unexplained_trend", variant)


@pytest.mark.parametrize("knots", [[], [1.0, 1.0], [2.0, 1.0], [0.0, np.inf], [0.0, 1e300], list(np.arange(1000.0))])
def test_knots_are_few_and_ascend(knots):
    with pytest.raises(ValidationError):
        UnexplainedTrend.Params(knots=knots, receivers=[None])


def test_times_since_1970_have_a_curve(make_links, view):
    """A log's times are seconds since 1970, of which a curve over time has its knots."""
    rng = np.random.default_rng(0)
    time_s = 1.7e9 + np.arange(400) * 10.0
    wave_db = 6.0 * np.sin(2 * np.pi * np.arange(400) / 400)
    links = make_links(np.zeros((1, 3)), rng.uniform(20, 300, (400, 3)), time_s=time_s, level_db=-80.0 + wave_db)

    def flat_db(of, exact=False):
        return np.full(len(of), -80.0)

    trend = UnexplainedTrend("time_s")
    (params,) = trend.propose(view(links, -80.0, 2.0, flat_db))
    assert 1.7e9 <= params.knots[0] < params.knots[-1] <= 1.7e9 + 4000
    columns = trend.with_params(params).term(links, flat_db).columns
    left_db = wave_db - columns @ np.linalg.lstsq(columns, wave_db, rcond=None)[0]
    assert np.sqrt(np.mean(left_db**2)) < 1.0


def test_a_blank_may_rise_up_to_the_limit_of_detection(make_links, view):
    links = make_links(np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0).uniform(20, 90, (3, 3)),
                       level_db=np.full(3, np.nan), limit_db=LIMIT_DB)
    seen = view(links, np.array([-125.0, -125.0, -95.0]), SCALE_DB)
    rows = np.arange(3)
    assert seen.gain_nats(rows, np.array([20.0, 25.0, 0.0])) == pytest.approx(np.zeros(3))
    risen, _, lowered = seen.gain_nats(rows, np.array([30.0, 0.0, -6.0]))
    five_db = (t.logpdf(0.0, 4) - t.logpdf(5.0 / SCALE_DB, 4)) / seen.design_effect
    assert (risen, lowered) == pytest.approx((-five_db, five_db))


def test_a_reading_gains_what_a_heavy_tail_says(make_links, view):
    links = make_links(np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0).uniform(20, 90, (2, 3)), level_db=np.full(2, -90.0))
    seen = view(links, np.array([-94.0, -82.0]), SCALE_DB)
    gained = seen.gain_nats(np.arange(2), np.array([4.0, 0.0])) * seen.design_effect
    expected = t.logpdf(0.0, 4) - t.logpdf(1.0, 4)
    assert gained == pytest.approx([expected, 0.0])
