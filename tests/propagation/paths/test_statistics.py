"""Figures of links against channels made by hand."""

import numpy as np
import pytest

from radiotwin.propagation.paths.listing import (
    EDGE_TAPS,
    angular_spread_deg,
    impulse_response,
    k_factor_db,
    rms_spread,
)

# Two links: two paths of 0.8 and 0.2, 1 µs apart; one path alone. A third has none.
LINK, POWER = np.array([0, 0, 1]), np.array([0.8, 0.2, 0.5])
DELAY_S = np.array([2e-6, 3e-6, 5e-6])


def test_two_paths_spread_by_the_root_of_the_product_of_their_shares():
    assert rms_spread(DELAY_S, POWER, LINK, 3) == pytest.approx([0.4e-6, 0, np.nan], nan_ok=True)


def test_k_factor():
    direct = np.array([True, False, True])
    assert k_factor_db(POWER, direct, LINK, 3) == pytest.approx([10 * np.log10(4), np.nan, np.nan], nan_ok=True)


@pytest.mark.parametrize("turned_rad", [0.0, 2.0, 3.1])
def test_angular_spread_does_not_depend_on_where_north_is(turned_rad):
    """3GPP TR 38.901, A-1, of two paths 60 degrees apart."""
    angle = np.radians([0.0, 60.0, 10.0]) + turned_rad
    resultant = np.sqrt(0.8**2 + 0.2**2 + 2 * 0.8 * 0.2 * np.cos(np.radians(60)))
    spread = angular_spread_deg(angle, POWER, LINK, 3)
    assert spread == pytest.approx([np.degrees(np.sqrt(-2 * np.log(resultant))), 0, np.nan], abs=1e-5, nan_ok=True)


def test_paths_a_whole_number_of_taps_apart_keep_their_amplitudes():
    response, = impulse_response(np.array([0.5j, -0.2]), np.array([0, 1e-6]), np.array([0, 0]), 1, 10e6, 2 * EDGE_TAPS + 11)
    assert np.flatnonzero(np.abs(response) > 1e-12).tolist() == [EDGE_TAPS, EDGE_TAPS + 10]
    assert response[[EDGE_TAPS, EDGE_TAPS + 10]] == pytest.approx([0.5j, -0.2])


def test_energy_of_a_response_is_that_of_its_paths_and_the_sum_of_taps_their_field():
    """Parseval: taps of all times hold the sum of a_i conj(a_j) sinc(B (t_i - t_j))."""
    rng = np.random.default_rng(1)
    amplitude = rng.normal(size=6) + 1j * rng.normal(size=6)
    excess_s, bandwidth_hz = rng.uniform(0, 2e-6, 6), 20e6
    link = np.zeros(6, dtype=int)
    response = impulse_response(amplitude, excess_s, link, 1, bandwidth_hz, 300)[0]
    apart = excess_s[:, None] - excess_s
    energy = (amplitude[:, None] * amplitude.conj() * np.sinc(bandwidth_hz * apart)).sum().real
    assert (np.abs(response) ** 2).sum() == pytest.approx(energy, rel=0.03)  # 16 taps of ringing hold 98 %
    assert response.sum() == pytest.approx(amplitude.sum(), abs=0.3)
    at_carrier = impulse_response(amplitude, excess_s, link, 1, 1e3, 2 * EDGE_TAPS + 2)[0]
    assert at_carrier[EDGE_TAPS] == pytest.approx(amplitude.sum(), rel=1e-3)  # in a narrow band: the coherent sum
