"""What a surface and an edge leave of a field.

A wall is a half space of one dielectric [1]. An edge is a wedge by the uniform theory of diffraction [2] with
Luebbers' heuristic for faces that do not conduct [3]. The knife edge of ITU-R P.526 would not do: it knows neither
the angle of the corner nor the material nor the polarisation, and holds close to the shadow boundary only.

Luebbers takes the angles at which the faces reflect from the incoming ray, so that his coefficient changes when the
ends are swapped. Here the smaller of the two rays' angles to each face is taken. This is the same at the boundaries
of reflection and in the shadow behind a lit face, which is what he gave it for, and it is reciprocal everywhere.

[1] Recommendation ITU-R P.2040-3, "Effects of building materials and structures on radiowave propagation above about
    100 MHz", 2023: Table 3 (concrete).
[2] Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly conducting
    surface", Proc. IEEE 62(11), 1974: eq. 25-29 and 33.
[3] Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction in prediction of propagation path loss",
    IEEE Trans. Antennas Propag. 32(1), 1984.
"""

import numpy as np
from numba import njit

VACUUM_PERMITTIVITY_F_M = 8.8541878128e-12


def concrete_permittivity(frequency_hz: float) -> complex:
    """Complex relative permittivity of concrete (P.2040-3, Table 3), for fields exp(+j omega t)."""
    conductivity_s_m = 0.0462 * (frequency_hz / 1e9) ** 0.7822
    return complex(5.24, -conductivity_s_m / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY_F_M))


@njit(cache=True)
def fresnel(sine, permittivity):
    """Reflection coefficients for the field across (TE) and in (TM) the plane of incidence.

    Args:
        sine: of the angle between ray and surface.
        permittivity: complex relative permittivity of the half space.

    Returns:
        (TE, TM), which tend to (-1, +1) for a perfect conductor.
    """
    root = np.sqrt(permittivity - (1.0 - sine * sine) + 0j)
    return (sine - root) / (sine + root), (permittivity * sine - root) / (permittivity * sine + root)


@njit(cache=True)
def transition(x):
    """The transition function F(x) of Kouyoumjian and Pathak, x >= 0, exact to 1e-5."""
    if x > 30.0:
        inverse = 1.0 / x
        return complex(1.0 - 0.75 * inverse * inverse, 0.5 * inverse - 1.875 * inverse ** 3)
    root = np.sqrt(x)
    return 2j * root * np.exp(1j * x) * _tail(root)


@njit(cache=True)
def _tail(a):
    """The integral of exp(-j t^2) from a >= 0 to infinity."""
    total = 0j
    if a < 2.2:
        # Power series of the integral from 0 to a.
        term = complex(a, 0.0)
        square = -1j * a * a
        for n in range(60):
            total += term / (2 * n + 1)
            term *= square / (n + 1)
            if abs(term) < 1e-15:
                break
        return 0.5 * np.sqrt(np.pi / 2) * (1 - 1j) - total
    # Continued fraction of the complementary error function (Abramowitz and Stegun, 7.1.14).
    z = a * np.exp(0.25j * np.pi)
    fraction = z
    for n in range(60, 0, -1):
        fraction = z + 0.5 * n / fraction
    return 0.5 * np.exp(-0.25j * np.pi) * np.exp(-1j * a * a) / fraction


@njit(cache=True)
def wedge_coefficients(phi, phi_in, sine_edge, distance_m, wave_number, n, permittivity):
    """Diffraction coefficients for the field along (soft) and across (hard) the edge [2, eq. 25-28, 3].

    Args:
        phi, phi_in: angles of the outgoing and the incoming ray from face 0, across the edge [rad], 0 to n pi.
        sine_edge: of the angle between ray and edge.
        distance_m: s s' sin² / (s + s') of the distances before and behind the edge [m].
        wave_number: 2 pi / wavelength [1/m].
        n: exterior angle of the wedge / pi.
        permittivity: of the faces; with an infinite real part they conduct perfectly.

    Returns:
        (soft, hard), in m^(1/2)
    """
    sine_0 = sine_edge * abs(np.sin(min(phi, phi_in)))
    sine_n = sine_edge * abs(np.sin(n * np.pi - max(phi, phi_in)))
    if np.isinf(permittivity.real):
        soft_0, soft_n, hard_0, hard_n = -1.0 + 0j, -1.0 + 0j, 1.0 + 0j, 1.0 + 0j
    else:
        soft_0, hard_0 = fresnel(sine_0, permittivity)
        soft_n, hard_n = fresnel(sine_n, permittivity)
    x = wave_number * distance_m
    incident = _term(phi - phi_in, x, n, 1) + _term(phi - phi_in, x, n, -1)
    at_n, at_0 = _term(phi + phi_in, x, n, 1), _term(phi + phi_in, x, n, -1)
    scale = -np.exp(-0.25j * np.pi) / (2.0 * n * np.sqrt(2.0 * np.pi * wave_number) * sine_edge)
    return (scale * (incident + soft_n * at_n + soft_0 * at_0), scale * (incident + hard_n * at_n + hard_0 * at_0))


@njit(cache=True)
def _term(beta, x, n, sign):
    """cot((pi + sign beta) / 2n) F(x a(beta)), finite at the shadow boundary [2, eq. 26-29, 33]."""
    turns = np.rint((beta + sign * np.pi) / (2.0 * np.pi * n))
    half = 0.5 * (2.0 * np.pi * n * turns - beta)
    a = 2.0 * np.cos(half) ** 2
    epsilon = np.pi + sign * (beta - 2.0 * np.pi * n * turns)
    if abs(epsilon) < 1e-5:
        side = 1.0 if epsilon >= 0 else -1.0
        return n * (np.sqrt(2.0 * np.pi * x) * side - 2.0 * x * epsilon * np.exp(0.25j * np.pi)) \
            * np.exp(0.25j * np.pi)
    return transition(x * a) / np.tan((np.pi + sign * beta) / (2.0 * n))
