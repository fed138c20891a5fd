"""The most that air, rain and woodland can take: the table against published values and the package `itur`, and the
bound of `excess_attenuation`."""

from pathlib import Path

import numpy as np
import pytest

from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation, max_at_ground_db_km
from radiotwin.effects.losses import (
    TABLE,
    max_gas_db_km,
    max_loss_db,
    max_rain_db_km,
    specific_db_m,
)


@pytest.mark.parametrize("ghz, k, alpha", [  # ITU-R P.838-3, Table 5, horizontal polarisation
    (1, 0.0000259, 0.9691), (2, 0.0000847, 1.0664), (4, 0.0001071, 1.6009), (6, 0.0007056, 1.5900),
    (10, 0.01217, 1.2571), (20, 0.09164, 1.0568), (30, 0.2403, 0.9485), (60, 0.8606, 0.7656), (100, 1.3671, 0.6815)])
def test_rain_is_that_of_the_recommendation(ghz, k, alpha):
    assert max_rain_db_km(ghz * 1e9) == pytest.approx(k * 150**alpha, rel=0.01)



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


@pytest.mark.parametrize("frequency_hz, scale_height_m, db_km, refused", [
    (2.4e9, 5000.0, 12.0, True),   # of the whole air at 2.4 GHz: no rain does that
    (2.4e9, 5000.0, 0.03, False),
    (2.4e9, 35.0, 45.0, False),  # of trees
    (2.4e9, 35.0, 900.0, True),
    (60e9, 5000.0, 15.0, False),  # oxygen
    (60e9, 5000.0, 60.0, True),
    (None, 5000.0, 30.0, False)])
def test_more_than_there_is_to_absorb_is_refused(frequency_hz, scale_height_m, db_km, refused):
    params = ExcessAttenuation.Params(scale_height_m=scale_height_m, frequency_hz=frequency_hz)
    reason = ExcessAttenuation().with_params(params).implausible(np.array([db_km]))
    assert (reason is not None) == refused
    assert not refused or "P.676, P.838, P.833" in reason


def test_the_frequency_is_that_of_the_links(make_links, view):
    links = make_links([[0.0, 0, 1.5]], [[100.0, 0, 60], [0, 200, 90]])
    proposed = ExcessAttenuation().propose(view(links, np.zeros(2), 1.0))
    assert all(each.frequency_hz == 2.4e9 for each in proposed)
    unknown = make_links([[0.0, 0, 1.5]], [[100.0, 0, 60]], frequency_hz=np.nan)
    assert ExcessAttenuation().propose(view(unknown, np.zeros(1), 1.0))[0].frequency_hz is None
