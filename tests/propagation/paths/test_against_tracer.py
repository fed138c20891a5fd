"""The engine against Sionna RT, which shares no code with it."""

import numpy as np
import pytest

from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.interactions import reflection, slabs_of
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import constants, itu_material
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains, import_sionna

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


@pytest.mark.slow
@pytest.mark.llvm
@pytest.mark.parametrize("frequency_hz", [0.9e9, 2.4e9, 28e9])
@pytest.mark.parametrize("name", ["concrete", "brick", "glass", "marble", "metal", "wood"])
def test_slabs_are_those_of_the_ray_tracer(name, frequency_hz):
    """Sionna RT's coefficient in single precision, over angles of 5 to 85 degrees and both polarisations."""
    import_sionna()
    import mitsuba
    from sionna.rt.utils import complex_relative_permittivity, itu_coefficients_single_layer_slab

    real, conductivity_s_m, _ = constants(itu_material(name), frequency_hz)
    sine = np.sin(np.radians(np.arange(5, 86)))
    permittivity = complex_relative_permittivity(mitsuba.Float(real), mitsuba.Float(conductivity_s_m),
                                                 mitsuba.Float(2 * np.pi * frequency_hz))
    for thickness_m in (0.1, 0.2):
        traced = itu_coefficients_single_layer_slab(mitsuba.Float(sine), permittivity, mitsuba.Float(thickness_m),
                                                    mitsuba.Float(299_792_458.0 / frequency_hz))[:2]
        slabs = slabs_of([itu_material(name, thickness_m=thickness_m)], frequency_hz)
        engine = np.array([reflection(each, slabs, 0) for each in sine]).T
        for ours, theirs in zip(engine, traced):
            difference_db = 20 * np.log10(np.abs(ours) / np.hypot(np.array(theirs.real), np.array(theirs.imag)))
            assert np.abs(difference_db).max() < 0.05
