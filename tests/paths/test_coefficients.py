"""Coefficients against their limits and against exact integrals."""

import numpy as np
import pytest
from scipy.special import modfresnelm

from radiotwin.paths.coefficients import (
    concrete_permittivity,
    fresnel,
    transition,
    wedge_coefficients,
)

CONDUCTOR = complex(np.inf, 0)
CONCRETE = concrete_permittivity(2.4e9)
WAVE_NUMBER = 2 * np.pi * 2.4e9 / 299_792_458.0


def test_concrete_at_one_gigahertz():
    assert concrete_permittivity(1e9).real == 5.24
    assert concrete_permittivity(1e9).imag == pytest.approx(-17.98 * 0.0462, rel=1e-3)  # P.2040, eq. 9b


def test_fresnel_straight_on_and_grazing():
    te, tm = fresnel(1.0, complex(4, 0))
    assert te == pytest.approx(-1 / 3) and tm == pytest.approx(1 / 3)
    assert np.allclose(fresnel(0.0, CONCRETE), -1)
    assert abs(fresnel(np.sin(np.arctan(1 / 2)), complex(4, 0))[1]) < 1e-12  # Brewster's angle


@pytest.mark.parametrize("x", [0.0, 0.01, 0.5, 3.0, 4.8, 4.9, 10.0, 29.9, 30.1, 500.0])
def test_transition_function(x):
    exact = 2j * np.sqrt(x) * np.exp(1j * x) * modfresnelm(np.sqrt(x))[0]
    assert transition(x) == pytest.approx(exact, abs=2e-5)


def field(phi, phi_in, n, permittivity, soft):
    """Direct, reflected and diffracted field of a line source's ray across a wedge, over that of free space."""
    before_m, after_m = 40.0, 70.0
    row = 0 if soft else 1
    total = wedge_coefficients(phi, phi_in, 1.0, before_m * after_m / (before_m + after_m), WAVE_NUMBER, n,
                               permittivity)[row] / np.sqrt(before_m * after_m * (before_m + after_m))
    total *= np.exp(-1j * WAVE_NUMBER * (before_m + after_m))
    for seen, angle in ((phi < np.pi + phi_in, phi - phi_in), (phi < np.pi - phi_in, phi + phi_in)):
        if seen:
            length_m = np.sqrt(before_m ** 2 + after_m ** 2 - 2 * before_m * after_m * np.cos(angle))
            image = 1.0
            if angle == phi + phi_in:
                sine = before_m * np.sin(phi_in) / length_m + after_m * np.sin(phi) / length_m
                image = (-1.0, 1.0)[row] if np.isinf(permittivity.real) else fresnel(sine, permittivity)[row]
            total += image * np.exp(-1j * WAVE_NUMBER * length_m) / length_m
    return total * (before_m + after_m)


@pytest.mark.parametrize("permittivity", [CONDUCTOR, CONCRETE])
@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("n", [1.5, 1.25, 2.0])
def test_the_field_has_no_step_at_the_boundaries(permittivity, soft, n):
    phi_in = 0.5
    for boundary in (np.pi + phi_in, np.pi - phi_in):
        # Across the boundary, and from its limiting form to the full one.
        for low, high in ((-1e-7, 1e-7), (0.99e-5, 1.01e-5), (-1.01e-5, -0.99e-5)):
            before, after = (field(boundary + step, phi_in, n, permittivity, soft) for step in (low, high))
            assert abs(before - after) < 2e-3
    at_shadow = wedge_coefficients(np.pi + phi_in + 1e-7, phi_in, 1.0, 25.0, WAVE_NUMBER, n, permittivity)
    assert np.allclose(np.abs(at_shadow) / np.sqrt(25.0), 0.5, atol=0.06)  # half the free-space field


@pytest.mark.parametrize("permittivity", [CONDUCTOR, CONCRETE])
def test_wedge_is_reciprocal(permittivity):
    there = wedge_coefficients(4.1, 0.7, 0.8, 30.0, WAVE_NUMBER, 1.5, permittivity)
    back = wedge_coefficients(0.7, 4.1, 0.8, 30.0, WAVE_NUMBER, 1.5, permittivity)
    turned = wedge_coefficients(1.5 * np.pi - 0.7, 1.5 * np.pi - 4.1, 0.8, 30.0, WAVE_NUMBER, 1.5, permittivity)
    assert np.allclose(there, back) and np.allclose(there, turned)
