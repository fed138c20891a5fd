"""A link round one corner of a metal house, from either end, against the uniform theory of diffraction."""

import numpy as np
import pytest
from scipy.constants import speed_of_light
from scipy.special import fresnel

from radiotwin.propagation.paths import path_powers
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material

FREQUENCY_HZ = 2.4e9
WAVE_NUMBER = 2 * np.pi * FREQUENCY_HZ / speed_of_light
FAR_M = np.array([-30.0, 20.0, 30.0])  # at the level of both ends, so that rays are at right angles to the edge


def soft_gain_db(offset_m):
    """Gain by way of the corner at the origin, fields along the edge: Kouyoumjian and Pathak (1974), eq. 25 to 33.

    The house fills x > 0, y > 0. Angles are from its face y = 0; the receiver is `offset_m` before that face.
    """
    def transition(x):
        sine, cosine = fresnel(np.sqrt(2 * x / np.pi))
        tail = np.sqrt(np.pi / 2) * ((0.5 - cosine) - 1j * (0.5 - sine))
        return 2j * np.sqrt(x) * np.exp(1j * x) * tail

    n, before_m, after_m = 1.5, np.hypot(*FAR_M[:2]), np.hypot(40.0, offset_m)
    phi_in, phi = 2 * np.pi - np.arctan2(FAR_M[1], FAR_M[0]), np.arctan2(offset_m, 40.0)
    distance_m = before_m * after_m / (before_m + after_m)
    coefficient = 0j
    for beta, reflected in ((phi - phi_in, 1), (phi + phi_in, -1)):
        for sign in (1, -1):
            turns = np.rint((beta + sign * np.pi) / (2 * np.pi * n))
            a = 2 * np.cos((2 * np.pi * n * turns - beta) / 2) ** 2
            coefficient += reflected / np.tan((np.pi + sign * beta) / (2 * n)) * transition(WAVE_NUMBER * distance_m * a)
    coefficient *= -np.exp(-0.25j * np.pi) / (2 * n * np.sqrt(2 * np.pi * WAVE_NUMBER))
    spread = 1 / (before_m * after_m * (before_m + after_m))
    return 10 * np.log10(abs(coefficient) ** 2 * spread / (2 * WAVE_NUMBER) ** 2)


@pytest.mark.parametrize("offset_m", [0.5, 1.0, 2.0, 5.0, 12.0, 25.0])
def test_round_a_metal_corner_from_either_end(box_mesh, offset_m):
    house = box_mesh(0, 0, 60, 60, 60)
    city = CityMap(house.vertices, house.faces, [itu_material("metal")])
    wall_m = np.array([40.0, -offset_m, 30.0])
    for from_m, to_m in ((FAR_M, wall_m), (wall_m, FAR_M)):
        diffracted = path_powers(city, from_m, to_m[None], FREQUENCY_HZ, depth=1).diffracted
        assert 10 * np.log10(diffracted[0]) == pytest.approx(soft_gain_db(offset_m), abs=0.1)
