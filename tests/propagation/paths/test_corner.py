"""A link round one corner of a metal house, from either end, against the uniform theory of diffraction."""

import numpy as np
import pytest

from radiotwin.propagation.paths import path_powers
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material
from tests.propagation.links import FREQUENCY_HZ, WAVELENGTH_M
from tests.propagation.wedges import gain, wedge

FAR_M = np.array([-30.0, 20.0, 30.0])  # at the level of both ends, so that rays are at right angles to the edge


@pytest.mark.parametrize("offset_m", [0.5, 2.0, 5.0, 25.0])
def test_round_a_metal_corner_from_either_end(box_mesh, offset_m):
    """The house fills x > 0, y > 0; the field is along the edge. Angles are from the face y = 0."""
    house = box_mesh(0, 0, 60, 60, 60)
    city = CityMap(house.vertices, house.faces, [itu_material("metal")])
    wall_m = np.array([40.0, -offset_m, 30.0])
    before_m, after_m = np.hypot(*FAR_M[:2]), np.hypot(40.0, offset_m)
    phi_in, phi = 2 * np.pi - np.arctan2(FAR_M[1], FAR_M[0]), np.arctan2(offset_m, 40.0)
    coefficient = wedge(before_m, after_m, phi_in, phi, 1.5, (-1, -1), WAVELENGTH_M)
    expected_db = 10 * np.log10(gain(before_m, after_m, coefficient, WAVELENGTH_M))
    for from_m, to_m in ((FAR_M, wall_m), (wall_m, FAR_M)):
        diffracted = path_powers(city, from_m, to_m[None], FREQUENCY_HZ, depth=1).diffracted
        assert 10 * np.log10(diffracted[0]) == pytest.approx(expected_db, abs=0.1)
