"""The engine against Sionna RT, which shares no code with it."""

import numpy as np
import pytest

from radiotwin.propagation.paths import path_powers
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import itu_material
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains

FREQUENCY_HZ = 2.4e9


@pytest.fixture
def corner(tmp_path, box_mesh):
    """A brick building of right angles on ground of concrete, and links into its shadow; all paths have 3 steps at most."""
    ground = box_mesh(-300, -300, 300, 300, 1)
    ground.apply_translation([0, 0, -1.0])
    shapes = [CityShape("house", box_mesh(0, 0, 40, 30, 25), itu_material("brick", thickness_m=0.3)),
              CityShape("ground", ground, itu_material("concrete", thickness_m=0.2))]
    write_city(tmp_path, shapes)
    receiver_m = np.random.default_rng(0).uniform([60, 35, 2], [120, 90, 20], (10, 3))
    return tmp_path / "city.xml", np.array([-20.0, -15.0, 3.0]), receiver_m


@pytest.mark.slow
@pytest.mark.llvm
def test_diffraction_is_that_of_the_ray_tracer(corner):
    """Single diffraction over a roof edge or round a corner, directly or by way of the ground."""
    xml_path, device_m, receiver_m = corner
    settings = SolverSettings(samples_per_src=1_000_000, max_depth=1, batch_receivers=10, diffraction="reciprocal")
    traced_db = PathGains(xml_path, FREQUENCY_HZ, settings).gains(device_m, receiver_m)
    powers = path_powers(CityMap.from_xml(xml_path), device_m, receiver_m, FREQUENCY_HZ, depth=1)
    assert (powers.diffracted > 0).all() and (powers.direct == 0).all()
    np.testing.assert_allclose(10 * np.log10(powers.total), traced_db, atol=0.02)
