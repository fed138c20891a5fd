"""Curves without a cause: of which a map has some."""

import numpy as np
import pytest
from pydantic import ValidationError

from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from radiotwin.effects.registry import effect_named
from radiotwin.errors import BadInput


@pytest.mark.parametrize(("variable", "receivers", "is_on_maps"), [
    ("azimuth_deg", [None], True), ("azimuth_deg", [0, 1], False), ("time_s", [None], False),
    ("heading_deg", [None], False), ("quality", [None], False), ("distance_m", [None], True)])
def test_a_map_has_what_depends_on_places_alone(variable, receivers, is_on_maps):
    trend = UnexplainedTrend(variable)
    assert trend.with_params(trend.Params(knots=[0.0, 1.0], receivers=receivers)).is_on_maps() == is_on_maps


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
    device_m, receiver_m = np.zeros((1, 3)), rng.uniform(20, 300, (400, 3))
    time_s = 1.7e9 + np.arange(400) * 10.0
    wave_db = 6.0 * np.sin(2 * np.pi * np.arange(400) / 400)
    links = make_links(device_m, receiver_m, time_s=time_s, level_db=-80.0 + wave_db)
    trend = UnexplainedTrend("time_s")
    (params,) = trend.propose(view(links, np.full(400, -80.0), 2.0, lambda of, exact=False: np.full(len(of), -80.0)))
    assert 1.7e9 <= params.knots[0] < params.knots[-1] <= 1.7e9 + 4000
    columns = trend.with_params(params).term(links, lambda of, exact=False: np.full(len(of), -80.0)).columns
    left_db = wave_db - columns @ np.linalg.lstsq(columns, wave_db, rcond=None)[0]
    assert np.sqrt(np.mean(left_db**2)) < 1.0
