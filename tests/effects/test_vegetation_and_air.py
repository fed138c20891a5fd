"""Loss in the air and in vegetation: against published values, the package `itur`, and worlds with a wood.

ITU-R P.676 (gas), P.838 (rain), P.833 (vegetation).
"""

from pathlib import Path

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation, max_at_ground_db_km
from radiotwin.effects.catalogue.foliage import Foliage, VegetationLoss
from radiotwin.effects.catalogue.mapped_vegetation import MappedVegetation
from radiotwin.effects.losses import (
    TABLE,
    max_gas_db_km,
    max_loss_db,
    max_rain_db_km,
    specific_db_m,
)
from radiotwin.scene.vegetation import Vegetation, VegetationConfig
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Model
from tests.effects.conftest import with_params
from tests.worlds import city_of_boxes

WOOD_M = [(100.0, 0.0), (220.0, 0.0), (220.0, 300.0), (100.0, 300.0)]
HEIGHT_M, SPECIFIC_DB_M, MOST_DB = 15.0, 0.2, 1.37 * 2400.0**0.42  # A_m of ITU-R P.833-10 at 2.4 GHz


def test_the_table_is_that_of_itur():
    """Straight lines between the rows included; where a line of the spectrum is curved, the table has more.

    `itur.csv` has, for the rows of the table, 150 frequencies from 1 to 450 GHz and 40 around two lines of water, what
    the package itur 0.4.0 (MIT) says: of air `gamma0_exact + gammaw_exact` of `itur.models.itu676` at 1013.25 hPa, the
    greater of 15 °C with 7.5 g/m³ and 35 °C with 30 g/m³ of water; of rain of 150 mm/h that of `itu838`, horizontal.
    """
    published = np.loadtxt(Path(__file__).with_name("itur.csv"), delimiter=",", skiprows=1)
    assert set(TABLE[:, 0]) <= set(published[:, 0]) and len(published) > 220
    for ghz, gas_db_km, rain_db_km in published:
        assert 0.965 * gas_db_km <= max_gas_db_km(ghz * 1e9) <= 1.45 * gas_db_km, ghz
        assert max_rain_db_km(ghz * 1e9) == pytest.approx(rain_db_km, rel=0.09), ghz


@pytest.mark.parametrize("mhz, specific, greatest_db", [  # ITU-R P.833-10, Sec. 2.1, St. Petersburg
    (105.9, 0.04, 9.4), (466.475, 0.12, 18.0), (949.0, 0.17, 26.5), (1852.2, 0.30, 29.0), (2117.5, 0.34, 34.1)])
def test_woodland_is_that_of_the_recommendation(mhz, specific, greatest_db):
    """The values that were measured; the recommendation's own A_1 f^alpha differs from them by up to 11 %."""
    assert specific_db_m(mhz * 1e6) == pytest.approx(specific, rel=0.13)
    assert max_loss_db(mhz * 1e6) == pytest.approx(greatest_db, rel=0.12)


def test_the_bound_is_the_sum_of_what_there_is():
    """High up there are no trees: 14.78 + 39.89 dB/km of air and rain at 60 GHz. Within one scale height of 30 m there
    is 1 - 1/e of a profile."""
    assert max_at_ground_db_km(60e9, 1e6) == pytest.approx(54.67, abs=0.01)
    trees_db_km = 2000 * 0.04 * (2400 / 105.9) ** (np.log(0.34 / 0.04) / np.log(2117.5 / 105.9))
    assert max_at_ground_db_km(2.4e9, 30.0) == pytest.approx(trees_db_km * 0.632 + 0.0074 + 0.033, rel=0.01)


@pytest.mark.parametrize("frequency_hz, scale_height_m, db_km, why", [
    (2.4e9, 5000.0, 12.0, "P.676, P.838, P.833"),   # of the whole air at 2.4 GHz: no rain does that
    (2.4e9, 5000.0, 0.03, ""),
    (2.4e9, 35.0, 45.0, ""),  # of trees
    (2.4e9, 35.0, 900.0, "P.676, P.838, P.833"),
    (60e9, 5000.0, 15.0, ""),  # oxygen
    (60e9, 5000.0, 60.0, "P.676, P.838, P.833"),
    (None, 5000.0, 30.0, ""), (None, 1e7, -12.0, "amplify")])
def test_more_than_there_is_to_absorb_is_refused(frequency_hz, scale_height_m, db_km, why):
    absorbs = with_params(ExcessAttenuation, scale_height_m=scale_height_m, frequency_hz=frequency_hz)
    found = absorbs.implausible(np.array([db_km])) or ""
    assert why in found and bool(found) == bool(why)


@pytest.mark.parametrize("frequency_hz", [2.4e9, np.nan])
def test_the_frequency_is_that_of_the_links(make_links, view, frequency_hz):
    links = make_links([[0.0, 0, 1.5]], [[100.0, 0, 60], [0, 200, 90]], frequency_hz=frequency_hz)
    known_hz = {each.frequency_hz for each in ExcessAttenuation().propose(view(links))}
    assert known_hz == {None if np.isnan(frequency_hz) else frequency_hz}


@pytest.fixture
def lost_db(make_links):
    """Loss of level links at 5 m through a grove that is `depth_m` long, 20 m wide and 12 m high."""
    def make(depth_m, device_m=(-200.0, 0, 5), receiver_m=(200.0, 0, 5)):
        grove = with_params(Foliage, box=(0.0, 0.0, depth_m, 20.0, 12.0, 0.0), law=VegetationLoss(0.8, 18.0))
        return -grove.term(make_links([device_m], [receiver_m]), None).offset_db[0]
    return make


@pytest.mark.parametrize(("depth_m", "expected_db"), [
    (0.1, 0.0798), (1.0, 0.782), (10.0, 6.459), (40.0, 14.958), (300.0, 18.0)])  # 18 (1 - exp(-0.8 d / 18)) dB
def test_the_loss_is_that_of_the_recommendation(lost_db, depth_m, expected_db):
    assert lost_db(depth_m) == pytest.approx(expected_db, abs=0.001)


@pytest.mark.parametrize(("device_m", "receiver_m", "inside_m"), [
    ((-200, 15, 5), (200, 15, 5), 0), ((-200, 0, 13), (200, 0, 13), 0),  # beside it, above it
    # From 22 m down to 2 m over 400 m: 12 m high above the middle, within the grove's last 15 m only.
    ((-200, 0, 22), (200, 0, 2), 15 * np.hypot(400, 20) / 400)])
def test_what_dips_into_the_crowns_loses_by_the_metres_inside(lost_db, device_m, receiver_m, inside_m):
    assert lost_db(30.0, device_m, receiver_m) == pytest.approx(18 * (1 - np.exp(-inside_m * 0.8 / 18)))


@pytest.mark.parametrize("frequency_hz, ceiling_db", [(2.4e9, 36.0), (900e6, 23.9), (200e6, 12.7), (28e9, 45.7), (np.nan, 25.0)])
def test_no_grove_costs_more_than_the_recommendation_has_at_the_frequency(make_links, view, frequency_hz, ceiling_db):
    """1.37 f^0.42 (ITU-R P.833-10), up to 4.235 GHz, twice the greatest frequency that was measured."""
    rng = np.random.default_rng(0)
    links = make_links(np.column_stack([rng.uniform(-200, 200, (6, 2)), np.full(6, 1.5)]),
                       np.column_stack([rng.uniform(-200, 200, (150, 2)), np.full(150, 8.0)]),
                       frequency_hz=frequency_hz)
    grove = with_params(Foliage, box=(0.0, 0.0, 70.0, 70.0, 15.0, 0.0), law=VegetationLoss(1.0, 20.0))
    links.level_db[:] = -80.0 + grove.gain_db(links) + rng.normal(0, 2.0, len(links))
    proposed = Foliage().propose(view(links, -80.0, 3.0))
    assert proposed
    for params in proposed:
        variation = Foliage().with_params(params).variation()
        most = variation.effect(variation.high).params
        assert most.law.max_db == pytest.approx(ceiling_db, abs=0.1) and params.law.max_db <= ceiling_db + 0.1


def in_wood_m(a_m, b_m, steps=2000):
    """Metres between x = 100 and 220 below the tops, by points along the way."""
    share = (np.arange(steps) + 0.5) / steps
    x, z = (a_m[:, i, None] + share * (b_m - a_m)[:, i, None] for i in (0, 2))
    return ((x > 100) & (x < 220) & (z < HEIGHT_M)).mean(axis=1) * np.linalg.norm(b_m - a_m, axis=1)


@pytest.fixture
def searched(make_links):
    """Make links around a wood of the map, with its loss or without: the fit of a law, and that with the effect."""
    def make(seed, loss=True):
        wood = VegetationConfig(name="w", kind="wood", height_m=HEIGHT_M, rings_m=[WOOD_M])
        rng = np.random.default_rng(seed)
        device_m = np.array([[20.0, 150.0, 20.0], [280.0, 60.0, 12.0]])
        receiver_m = np.column_stack([rng.uniform(-300, 320, 600), rng.uniform(0, 300, 600), np.full(600, 1.5)])
        links = make_links(device_m, receiver_m, city=city_of_boxes(ground_m=1200, vegetation=Vegetation.of([wood])))
        a_m, b_m = links.device_m[links.device], links.receiver_m
        loss_db = MOST_DB * -np.expm1(-SPECIFIC_DB_M * in_wood_m(a_m, b_m) / MOST_DB) if loss else 0.0
        links.level_db[:] = -40 - 24 * np.log10(links.distance_m) - loss_db + rng.normal(0, 3, len(a_m))
        fit = Model.build(links, make_bases(None, 0)["log-distance"].fit(links).channel, 8.0).fit()
        better = add_effect(fit, MappedVegetation())
        return fit.objective - better.objective, better.effects[-1]
    return make


def test_the_specific_attenuation_of_a_mapped_wood_is_found(searched):
    found = [searched(seed) for seed in range(5)]
    assert min(gain for gain, _ in found) > 100
    assert {round(effect.params.greatest_loss_db, 6) for _, effect in found} == {round(MOST_DB, 6)}
    # The law was fitted before, and has taken part of the loss for distance.
    specific_db_m = [effect.params.specific_attenuation_db_m for _, effect in found]
    assert 0.7 * SPECIFIC_DB_M < np.mean(specific_db_m) < 1.05 * SPECIFIC_DB_M
    assert np.std(specific_db_m) < 0.2 * SPECIFIC_DB_M


def test_a_wood_that_costs_nothing_is_not_plausible(searched):
    gain, effect = searched(0, loss=False)
    assert gain < 5 or effect.implausible(np.zeros(0)) is not None
