"""Loss through vegetation: in proportion to its depth at first, and no more than a greatest loss (ITU-R P.833)."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.foliage import Foliage, VegetationLoss
from radiotwin.effects.losses import max_loss_db


@pytest.fixture
def lost_db(make_links):
    """Loss of level links at 5 m through a grove that is `depth_m` long, 20 m wide and 12 m high."""
    def make(depth_m, law, device_m=(-200.0, 0, 5), receiver_m=(200.0, 0, 5)):
        params = Foliage.Params(box=(0.0, 0.0, depth_m, 20.0, 12.0, 0.0), law=VegetationLoss(*law))
        return -Foliage().with_params(params).term(make_links([device_m], [receiver_m]), None).offset_db[0]
    return make


@pytest.mark.parametrize(("depth_m", "expected_db"), [
    (0.1, 0.0798), (1.0, 0.782), (10.0, 6.459), (40.0, 14.958), (300.0, 18.0)])  # 18 (1 - exp(-0.8 d / 18)) dB
def test_the_loss_is_that_of_the_recommendation(lost_db, depth_m, expected_db):
    assert lost_db(depth_m, [0.8, 18.0]) == pytest.approx(expected_db, abs=0.001)


def test_what_passes_beside_or_above_loses_nothing(lost_db):
    assert lost_db(30.0, [0.8, 18.0], (-200, 15, 5), (200, 15, 5)) == 0
    assert lost_db(30.0, [0.8, 18.0], (-200, 0, 13), (200, 0, 13)) == 0


def test_what_dips_into_the_crowns_loses_by_the_metres_inside(lost_db):
    """From 22 m down to 2 m over 400 m: 12 m high above the middle, within the grove's last 15 m only."""
    inside_m = 15 * np.hypot(400, 20) / 400
    assert lost_db(30.0, [0.8, 18.0], (-200, 0, 22), (200, 0, 2)) == pytest.approx(
        18 * (1 - np.exp(-inside_m * 0.8 / 18)))


@pytest.mark.parametrize("frequency_hz, ceiling_db", [(2.4e9, 36.0), (900e6, 23.9), (200e6, 12.7), (28e9, 45.7), (np.nan, 25.0)])
def test_no_grove_costs_more_than_the_recommendation_has_at_the_frequency(make_links, view, frequency_hz, ceiling_db):
    """1.37 f^0.42 (ITU-R P.833-10), up to 4.235 GHz, twice the greatest frequency that was measured."""
    assert np.isnan(frequency_hz) or max_loss_db(frequency_hz) == pytest.approx(ceiling_db, abs=0.1)
    rng = np.random.default_rng(0)
    links = make_links(np.column_stack([rng.uniform(-200, 200, (6, 2)), np.full(6, 1.5)]),
                       np.column_stack([rng.uniform(-200, 200, (150, 2)), np.full(150, 8.0)]),
                       frequency_hz=frequency_hz)
    grove = Foliage.Params(box=(0.0, 0.0, 70.0, 70.0, 15.0, 0.0), law=VegetationLoss(1.0, 20.0))
    links.level_db[:] = -80.0 + Foliage().with_params(grove).gain_db(links) + rng.normal(0, 2.0, len(links))
    proposed = Foliage().propose(view(links, np.full(len(links), -80.0), 3.0))
    assert proposed
    for params in proposed:
        variation = Foliage().with_params(params).variation()
        most = variation.effect(variation.high).params
        assert most.law.max_db == pytest.approx(ceiling_db, abs=0.1) and params.law.max_db <= ceiling_db + 0.1
