"""Curves without a cause: of which a map has some."""

import numpy as np
import pytest
from pydantic import ValidationError

from radiotwin.effects.registry import effect_named
from radiotwin.effects.unexplained_trend import UnexplainedTrend
from radiotwin.errors import BadInput


@pytest.mark.parametrize(("variable", "receivers", "is_on_maps"), [
    ("azimuth_deg", [None], True), ("azimuth_deg", [0, 1], False), ("time_s", [None], False),
    ("heading_deg", [None], False), ("quality", [None], False), ("distance_m", [None], True)])
def test_a_map_has_what_depends_on_places_alone(variable, receivers, is_on_maps):
    trend = UnexplainedTrend(variable)
    assert trend.is_on_maps(trend.Params(knots=[0.0, 1.0], receivers=receivers)) == is_on_maps


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
