import math

import numpy as np
import pytest

from radiotwin.coverage.radio import (
    RateModel,
    ServerTally,
    channel_overlap,
    location_probability,
    rate_bps,
    thermal_noise_dbm,
)


def test_thermal_noise_is_minus_174_dbm_a_hertz():
    assert thermal_noise_dbm(1.0) == pytest.approx(-173.98, abs=0.005)
    assert thermal_noise_dbm(20e6) == pytest.approx(-173.98 + 73.01, abs=0.01)


def test_rate_is_an_attenuated_truncated_shannon_bound():
    """3GPP TR 36.942 Annex A.1: nothing below -10 dB, 4.4 bit/s/Hz from 22.05 dB on, 0.6 of Shannon's bound between."""
    sinr_db = np.array([-10.01, -10.0, 0.0, 10.0, 22.04, 22.06, 60.0, np.nan])
    expected = [0, 0.6 * math.log2(1.1), 0.6, 0.6 * math.log2(11), 4.4, 4.4, 4.4, 0]
    np.testing.assert_allclose(rate_bps(sinr_db, 1.0, RateModel()), expected, atol=2e-3)
    np.testing.assert_allclose(rate_bps(sinr_db, 20e6, RateModel(1.0, -20.0, 100.0))[3], 20e6 * math.log2(11))


def test_interference_is_that_of_the_others_of_the_same_frequency():
    """Against a sum over all transmitters at once."""
    rng = np.random.default_rng(0)
    power_dbm = rng.uniform(-140, -40, (7, 300))
    power_dbm[rng.random((7, 300)) < 0.2] = np.nan
    power_dbm[:, 0] = np.nan
    frequency, load = np.array([0, 1, 0, 0, 1, 1, 0]), rng.uniform(0, 1, 7)
    tally = ServerTally(300, np.eye(2))
    for row in range(7):
        tally.add(row, power_dbm[row], 3.0 + row, load[row], frequency[row])
    sinr_db = tally.sinr_db(-100.0)
    assert tally.server[0] == -1 and np.isnan(sinr_db[0]) and np.isnan(tally.power_dbm[0])
    for n in range(1, 300):
        best = int(np.nanargmax(power_dbm[:, n]))
        others = [row for row in range(7) if row != best and frequency[row] == frequency[best]]
        noise_mw = 1e-10 + np.nansum([load[row] * 10 ** (power_dbm[row, n] / 10) for row in others])
        assert tally.server[n] == best and tally.sd_db[n] == 3.0 + best
        assert sinr_db[n] == pytest.approx(power_dbm[best, n] - 10 * math.log10(noise_mw), abs=1e-9)


@pytest.mark.parametrize(("apart", "share"), [
    (0.0, 1.0), (1e3 / 20e6, 1 - 1e3 / 20e6), (0.25, 0.75), (0.999, 0.001), (1.0, 0.0), (2.0, 0.0), (2.5, 0.0), (9.0, 0.0)])
def test_a_channel_gets_the_share_of_its_overlap_and_what_leaks(apart, share):
    """Against a sum over slices of the spectrum: even within the channel, 45 dB less in two channels on each side."""
    found = channel_overlap(2e9 + np.array([0.0, apart * 20e6]), 20e6, 45.0)
    at = np.arange(-4, 4, 1e-4) + 5e-5  # bandwidths from the middle of the transmitter's channel
    density = np.where(np.abs(at) < 0.5, 1.0, np.where(np.abs(at) < 2.5, 10**-4.5, 0.0))
    np.testing.assert_allclose(found[1, 0], density[np.abs(at - apart) < 0.5].sum() * 1e-4, atol=1e-6 + 2e-4 * (0 < apart < 0.01))
    assert found[1, 0] == found[0, 1] and found[0, 0] == 1.0 and found[1, 0] == pytest.approx(share, abs=1e-4)


def test_location_probability():
    power_dbm, sd_db = np.array([-90.0, -80.0, -100.0, -90.0, np.nan, -90.0]), np.array([5.0, 5, 5, 0, np.nan, np.nan])
    found = location_probability(power_dbm, sd_db, -90.0)
    np.testing.assert_allclose(found[:5], [0.5, 0.97725, 0.02275, 1.0, 0.0], atol=1e-5)
    assert np.isnan(found[5])
