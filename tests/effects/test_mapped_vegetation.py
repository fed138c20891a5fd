"""Loss in the vegetation of the map: found with its specific attenuation, and not where there is none."""

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.effects.catalogue.mapped_vegetation import MappedVegetation
from radiotwin.scene.vegetation import Vegetation, VegetationConfig
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Model
from tests.worlds import city_of_boxes

WOOD = [(100.0, 0.0), (220.0, 0.0), (220.0, 300.0), (100.0, 300.0)]
HEIGHT_M, SPECIFIC_DB_M, MOST_DB = 15.0, 0.2, 1.37 * 2400.0**0.42  # A_m of ITU-R P.833-10 at 2.4 GHz


def city(with_wood=True, height_m=HEIGHT_M):
    declared = [VegetationConfig(name="w", kind="wood", height_m=height_m, rings_m=[WOOD])] if with_wood else []
    return city_of_boxes(ground_m=1200, vegetation=Vegetation.of(declared))


def in_wood_m(a_m, b_m, steps=2000):
    """Metres between x = 100 and 220 below the tops, by points along the way."""
    share = (np.arange(steps) + 0.5) / steps
    x, z = (a_m[:, i, None] + share * (b_m - a_m)[:, i, None] for i in (0, 2))
    return ((x > 100) & (x < 220) & (z < HEIGHT_M)).mean(axis=1) * np.linalg.norm(b_m - a_m, axis=1)


@pytest.fixture
def world(make_links):
    def make(seed, loss=True, map_=None):
        rng = np.random.default_rng(seed)
        device_m = np.array([[20.0, 150.0, 20.0], [280.0, 60.0, 12.0]])
        receiver_m = np.column_stack([rng.uniform(-300, 320, 600), rng.uniform(0, 300, 600), np.full(600, 1.5)])
        links = make_links(device_m, receiver_m, city=map_ or city())
        a_m, b_m = links.device_m[links.device], links.receiver_m
        loss_db = MOST_DB * -np.expm1(-SPECIFIC_DB_M * in_wood_m(a_m, b_m) / MOST_DB) if loss else 0.0
        gain_db = -40 - 24 * np.log10(np.linalg.norm(b_m - a_m, axis=1)) - loss_db + rng.normal(0, 3, len(a_m))
        return make_links(device_m, receiver_m, city=map_ or city(), level_db=gain_db)
    return make


def model_of(links):
    twin = make_bases(None, 0)["log-distance"].fit(links)
    return Model.build(links, twin.channel, 8.0).fit()


def test_its_specific_attenuation_is_found(world):
    found = []
    for seed in range(5):
        fit = model_of(world(seed))
        better = add_effect(fit, MappedVegetation())
        assert fit.objective - better.objective > 100
        found.append(better.effects[-1].params.specific_attenuation_db_m)
        assert better.effects[-1].params.greatest_loss_db == pytest.approx(MOST_DB)
    # The law was fitted before, and has taken part of the loss for distance.
    assert 0.7 * SPECIFIC_DB_M < np.mean(found) < 1.05 * SPECIFIC_DB_M and np.std(found) < 0.2 * SPECIFIC_DB_M


def test_a_wood_that_costs_nothing_is_not_plausible(world):
    fit = model_of(world(0, loss=False))
    better = add_effect(fit, MappedVegetation())
    params = better.effects[-1].params
    gain = fit.objective - better.objective
    assert gain < 5 or MappedVegetation().with_params(params).implausible(np.zeros(0)) is not None


def test_it_is_not_looked_for_without_vegetation(world):
    assert MappedVegetation().unavailable(world(0, map_=city(with_wood=False))) == "the map shows no vegetation"
    assert "fewer than 60 links" in MappedVegetation().unavailable(world(0, map_=city(height_m=0.5)))



