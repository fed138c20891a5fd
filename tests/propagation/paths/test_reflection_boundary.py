"""The total field at a corner where the reflection at one of its faces ends: a step is not physical."""

import numpy as np
import pytest
import trimesh

from radiotwin.propagation.paths.listing import follow_rays
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import itu_material
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains

DEVICE_M = np.array([-30.0, 20.0, 0.0])
METAL = itu_material("metal")


@pytest.fixture(scope="module")
def corner():
    """A metal block whose faces x = 0 and y = 0 meet in an upright edge at the origin."""
    block = trimesh.creation.box([100, 100, 200])
    return block.apply_translation([-50, -50, 0])


@pytest.fixture(scope="module")
def receivers_m():
    """On both sides of the end of the reflection at the face y = 0, 40 m from the edge and 3 mm apart."""
    angle = np.arctan2(20, 30) + np.radians([0.002, -0.002])  # from the face's continuation beyond the edge
    return 40 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(2)])


def test_the_field_has_no_step(corner, receivers_m):
    rays, _ = next(follow_rays(CityMap(corner.vertices, corner.faces, [METAL]), DEVICE_M, receivers_m, 2.4e9, depth=1))
    assert (np.bincount(rays.receiver[rays.kinds[:, 0] != 2]) == [2, 1]).all()  # of two paths one ends here
    field = np.array([rays.amplitude[rays.receiver == row].sum() for row in range(2)])
    reflected = np.abs(rays.amplitude[(rays.receiver == 0) & (rays.kinds[:, 0] == 1)][0])
    assert np.abs(field[1] - field[0]) < 0.3 * reflected  # which is what the fading over 3 mm makes


@pytest.mark.slow
@pytest.mark.llvm
@pytest.mark.parametrize("diffraction", ["sionna", "reciprocal"])
def test_that_of_sionna_rt_has_one_until_it_is_mended(corner, receivers_m, tmp_path, diffraction):
    """Of 2.2.0; where this fails, its coefficient has changed, and docs/results.md with it."""
    write_city(tmp_path, [CityShape("block", corner, METAL)])
    settings = SolverSettings(samples_per_src=300_000, batch_receivers=2, max_depth=1, combining="coherent",
                              diffraction=diffraction)
    before_db, after_db = PathGains(tmp_path / "city.xml", 2.4e9, settings).solve(DEVICE_M, receivers_m)
    assert (abs(after_db - before_db) > 10) == (diffraction == "sionna")
    assert diffraction == "sionna" or abs(after_db - before_db) < 3  # over 3 mm, as that of the engine above
