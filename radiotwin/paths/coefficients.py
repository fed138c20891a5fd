"""Reflection coefficients of surfaces and diffraction coefficients of edges.

A wall is a half space of one dielectric [1]. An edge is a wedge in the uniform theory of
diffraction [2] with Luebbers' heuristic for faces that are not conductors [3]. The knife edge of
ITU-R P.526 is not used: it has neither the angle of the wedge nor its material nor the
polarisation, and it holds close to the shadow boundary only.

Luebbers takes the angles of reflection at the faces from the incident ray, so that his
coefficient changes when the two ends are swapped. Here the smaller of the angles of the incident
and the diffracted ray to each face is taken. It is the same at the reflection boundaries and in
the shadow behind a lit face, for which he gave it, and it is reciprocal everywhere.

[1] Recommendation ITU-R P.2040-3, "Effects of building materials and structures on radiowave
    propagation above about 100 MHz", 2023: Table 3.
[2] Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
    conducting surface", Proc. IEEE 62(11), 1974: eq. 25-29 and 33.
[3] Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction in prediction of
    propagation path loss", IEEE Trans. Antennas Propag. 32(1), 1984.
[4] Balanis, "Advanced Engineering Electromagnetics", 2nd ed., 2012: section 5.3.
"""

import numpy as np
from numba import njit

from radiotwin.scene.materials import ITU_TABLE

VACUUM_PERMITTIVITY_F_M = 8.8541878128e-12  # [F/m], CODATA 2018


def concrete_permittivity(frequency_hz: float) -> complex:
    """Return the complex relative permittivity of concrete [1].

    The power law of the table holds from 1 to 100 GHz and is extrapolated outside this range.

    Args:
        frequency_hz: frequency [Hz].

    Returns:
        The permittivity for fields that vary as exp(+j ω t).
    """
    _, _, real, _, c, d = ITU_TABLE["concrete"][0]
    conductivity_s_m = c * (frequency_hz / 1e9) ** d
    return complex(real, -conductivity_s_m / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY_F_M))


@njit(cache=True)
def fresnel(sine: float, permittivity: complex) -> tuple[complex, complex]:
    """Return the Fresnel reflection coefficients of a half space [4].

    Args:
        sine: sine of the angle between ray and surface.
        permittivity: complex relative permittivity of the half space.

    Returns:
        The coefficients for the field across (TE) and in (TM) the plane of incidence, which tend
        to -1 and +1 for a perfect conductor.
    """
    root = np.sqrt(permittivity - (1.0 - sine * sine) + 0j)
    te = (sine - root) / (sine + root)
    return te, (permittivity * sine - root) / (permittivity * sine + root)


@njit(cache=True)
def transition(x: float) -> complex:
    """Return the transition function F(x) of Kouyoumjian and Pathak, x >= 0, exact to 1e-5."""
    if x > 30.0:  # asymptotic series
        inverse = 1.0 / x
        return complex(1.0 - 0.75 * inverse * inverse, 0.5 * inverse - 1.875 * inverse**3)
    root = np.sqrt(x)
    return 2j * root * np.exp(1j * x) * _fresnel_tail(root)


@njit(cache=True)
def _fresnel_tail(a: float) -> complex:
    """Return the integral of exp(-j t²) over t from a >= 0 to infinity."""
    if a < 2.2:  # power series of the integral from 0 to a
        total = 0j
        term = complex(a, 0.0)
        square = -1j * a * a
        for n in range(60):
            total += term / (2 * n + 1)
            term *= square / (n + 1)
            if abs(term) < 1e-15:
                break
        return 0.5 * np.sqrt(np.pi / 2) * (1 - 1j) - total
    # Continued fraction of the complementary error function (Abramowitz and Stegun, 7.1.14)
    z = a * np.exp(0.25j * np.pi)
    fraction = z
    for n in range(60, 0, -1):
        fraction = z + 0.5 * n / fraction
    return 0.5 * np.exp(-0.25j * np.pi) * np.exp(-1j * a * a) / fraction


@njit(cache=True)
def wedge_coefficients(
    phi: float, phi_in: float, sine_edge: float, distance_m: float, wave_number: float, n: float,
    permittivity: complex,
) -> tuple[complex, complex]:
    """Return the diffraction coefficients of a wedge [2, eq. 25-28, 3].

    Args:
        phi: angle of the diffracted ray from face 0, across the edge [rad], 0 to n π.
        phi_in: the same angle of the incident ray.
        sine_edge: sine of the angle between ray and edge.
        distance_m: s s' sin² / (s + s') of the distances s' before and s after the edge [m].
        wave_number: 2 π / wavelength [1/m].
        n: exterior angle of the wedge divided by π.
        permittivity: of both faces; an infinite real part stands for a perfect conductor.

    Returns:
        The coefficients for the field along (soft) and across (hard) the edge [√m].
    """
    sine_0 = sine_edge * abs(np.sin(min(phi, phi_in)))
    sine_n = sine_edge * abs(np.sin(n * np.pi - max(phi, phi_in)))
    if np.isinf(permittivity.real):
        soft_0, soft_n, hard_0, hard_n = -1.0 + 0j, -1.0 + 0j, 1.0 + 0j, 1.0 + 0j
    else:
        soft_0, hard_0 = fresnel(sine_0, permittivity)
        soft_n, hard_n = fresnel(sine_n, permittivity)
    x = wave_number * distance_m
    incident = _cotangent_term(phi - phi_in, x, n, 1) + _cotangent_term(phi - phi_in, x, n, -1)
    at_n = _cotangent_term(phi + phi_in, x, n, 1)
    at_0 = _cotangent_term(phi + phi_in, x, n, -1)
    scale = -np.exp(-0.25j * np.pi) / (2.0 * n * np.sqrt(2.0 * np.pi * wave_number) * sine_edge)
    return (scale * (incident + soft_n * at_n + soft_0 * at_0),
            scale * (incident + hard_n * at_n + hard_0 * at_0))


@njit(cache=True)
def _cotangent_term(beta: float, x: float, n: float, sign: int) -> complex:
    """Return cot((π + sign β) / 2n) F(x a(β)), finite at the shadow boundary [2, eq. 26-29, 33]."""
    turns = np.rint((beta + sign * np.pi) / (2.0 * np.pi * n))
    half = 0.5 * (2.0 * np.pi * n * turns - beta)
    a = 2.0 * np.cos(half) ** 2
    epsilon = np.pi + sign * (beta - 2.0 * np.pi * n * turns)
    if abs(epsilon) < 1e-5:
        side = 1.0 if epsilon >= 0 else -1.0
        return n * (np.sqrt(2.0 * np.pi * x) * side - 2.0 * x * epsilon * np.exp(0.25j * np.pi)) \
            * np.exp(0.25j * np.pi)
    return transition(x * a) / np.tan((np.pi + sign * beta) / (2.0 * n))
