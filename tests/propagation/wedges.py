"""The uniform theory of diffraction at normal incidence, from the papers.

Kouyoumjian and Pathak, Proc. IEEE 62(11), 1974, eq. 25-29, with the reflections of Luebbers, IEEE Trans. AP 32(1), 1984.
"""

import numpy as np
from scipy.special import modfresnelm


def transition(x):
    """Kouyoumjian and Pathak's F(x), from Fresnel's integral."""
    return 2j * np.sqrt(x) * np.exp(1j * x) * modfresnelm(np.sqrt(x))[0]


def wedge(before_m, after_m, phi_in, phi, n, reflected, wavelength_m):
    """Coefficient [m^0.5] of angles from face 0, by the reflection coefficients of face 0 and face n."""
    k, spread_m = 2 * np.pi / wavelength_m, before_m * after_m / (before_m + after_m)

    def term(beta, sign):
        turns = np.round((beta + sign * np.pi) / (2 * np.pi * n))
        a = 2 * np.cos((2 * np.pi * n * turns - beta) / 2) ** 2
        return transition(k * spread_m * a) / np.tan((np.pi + sign * beta) / (2 * n))

    at_0, at_n = reflected
    return -np.exp(-0.25j * np.pi) / (2 * n * np.sqrt(2 * np.pi * k)) * (
        term(phi - phi_in, 1) + term(phi - phi_in, -1) + at_0 * term(phi + phi_in, -1) + at_n * term(phi + phi_in, 1))


def gain(before_m, after_m, coefficient, wavelength_m):
    """Power gain of the diffracted ray between isotropic antennas."""
    return (wavelength_m / (4 * np.pi)) ** 2 * abs(coefficient) ** 2 / (before_m * after_m * (before_m + after_m))
