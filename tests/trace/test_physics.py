"""The tracer against closed forms that are written here, from the books, and share no code with it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.special import fresnel

from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains

pytestmark = pytest.mark.llvm

ROOT = Path(__file__).parents[2]
FREQUENCY_HZ = 2.4e9
WAVELENGTH_M = 299_792_458.0 / FREQUENCY_HZ
SETTINGS = SolverSettings(samples_per_src=20_000, batch_receivers=16, max_num_paths_per_src=20_000)


def solver(folder, mesh, material, settings=SETTINGS):
    write_city(folder, [CityShape("thing", mesh, material)])
    return PathGains(folder / "city.xml", FREQUENCY_HZ, settings)


def to_db(power):
    return 10 * np.log10(power)


def test_free_space_is_friis():
    points_m = np.random.default_rng(0).uniform(-500, 500, (40, 3))  # three batches, the last not full
    device_m = np.array([3.0, -2.0, 1.5])
    solved_db = PathGains(None, FREQUENCY_HZ, SETTINGS).gains(device_m, points_m)
    distance_m = np.linalg.norm(points_m - device_m, axis=1)
    assert solved_db == pytest.approx(to_db((WAVELENGTH_M / (4 * np.pi * distance_m)) ** 2), abs=0.01)


# Ground of half-space: so thick and lossy that nothing comes back from its lower side.
PERMITTIVITY, CONDUCTIVITY = 15.0, 0.2
GROUND = Material("ground", relative_permittivity=PERMITTIVITY, conductivity_s_per_m=CONDUCTIVITY, thickness_m=0.1)
DEVICE_M = np.array([0.0, 0.0, 1.5])


def two_rays(points_m):
    """Field of the direct and of the reflected ray at (n, 3) points, by Fresnel's coefficient (Jakes, ch. 2)."""
    horizontal_m = np.hypot(*(points_m - DEVICE_M)[:, :2].T)
    direct_m = np.hypot(horizontal_m, points_m[:, 2] - DEVICE_M[2])
    reflected_m = np.hypot(horizontal_m, points_m[:, 2] + DEVICE_M[2])
    grazing_rad = np.arctan2(points_m[:, 2] + DEVICE_M[2], horizontal_m)
    eta = PERMITTIVITY - 1j * CONDUCTIVITY / (2 * np.pi * FREQUENCY_HZ * 8.8541878128e-12)
    root = np.sqrt(eta - np.cos(grazing_rad) ** 2)
    vertical = (eta * np.sin(grazing_rad) - root) / (eta * np.sin(grazing_rad) + root)
    scale = WAVELENGTH_M / (4 * np.pi)
    waves = 2 * np.pi / WAVELENGTH_M
    return (scale / direct_m * np.exp(-1j * waves * direct_m),
            scale / reflected_m * vertical * np.exp(-1j * waves * reflected_m))


@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_two_rays_over_flat_ground(tmp_path, combining):
    """Single precision leaves about 1e-3 rad of phase at 400 m: 0.1 dB, but for the deepest fades."""
    generator = np.random.default_rng(1)
    points_m = np.column_stack([generator.uniform(20, 400, 16), generator.uniform(-200, 200, 16), generator.uniform(2, 60, 16)])
    corners = [(-2000, -2000, 0), (2000, -2000, 0), (2000, 2000, 0), (-2000, 2000, 0)]
    ground = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
    direct, reflected = two_rays(points_m)
    sums_db = {"power": to_db(abs(direct) ** 2 + abs(reflected) ** 2), "coherent": to_db(abs(direct + reflected) ** 2)}
    assert np.ptp(sums_db["coherent"] - to_db(abs(direct) ** 2)) > 10  # the points do fade
    solved_db = solver(tmp_path, ground, GROUND, replace(SETTINGS, combining=combining)).solve(DEVICE_M, points_m)
    assert solved_db == pytest.approx(sums_db[combining], abs=0.02 if combining == "power" else 0.1)


def test_a_street_between_metal_walls_may_bring_nine_decibels(tmp_path):
    """More than 6 dB above free space is no error: nine images at nearly one distance (Balanis 2012, sec. 11.2).

    Rationale: vertical polarisation along vertical walls of a good conductor is reflected without loss, so that the
    power is that of the device and of its images of up to four reflections. Expected: their sum, and no link flagged.
    """
    width_m, device_y_m = 4.0, 1.3
    corners = [(x, y, z) for y in (0.0, width_m) for x, z in ((-2000, -2000), (2000, -2000), (2000, 2000), (-2000, 2000))]
    walls = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)], process=False)
    settings = SolverSettings(samples_per_src=100_000, batch_receivers=8, max_num_paths_per_src=20_000, diffraction="off")
    points_m = np.array([(x_m, y_m, 1.0) for x_m in (15.0, 30.0, 60.0, 90.0) for y_m in (0.7, 2.9)])
    solved_db = solver(tmp_path, walls, Material("metal", itu="metal"), settings).solve(
        np.array([0.0, device_y_m, 0.0]), points_m)
    images_m = [sign * device_y_m + 2 * m * width_m for sign, ms in ((1, (-2, -1, 0, 1, 2)), (-1, (-1, 0, 1, 2)))
                for m in ms]  # 0, 2 and 4 reflections; 1 and 3
    squares_m2 = points_m[:, :1] ** 2 + (points_m[:, 1:2] - images_m) ** 2 + 1.0
    direct_db = to_db((WAVELENGTH_M / (4 * np.pi * np.linalg.norm(points_m - [0, device_y_m, 0], axis=1))) ** 2)
    closed_db = to_db(np.sum((WAVELENGTH_M / (4 * np.pi)) ** 2 / squares_m2, axis=1))
    assert solved_db == pytest.approx(closed_db, abs=0.1)
    assert (closed_db - direct_db)[-2:].min() > 9


def test_a_direct_path_counts_once_where_sionna_returns_it_many_times():
    """Seen: of 20 receivers at this device of scenes/rbm, the first had 28 direct paths, and 14 dB too much."""
    device_m = np.array([147.9, 279.9, 1.5])
    generator = np.random.default_rng(0)
    points_m = device_m + np.column_stack([generator.normal(0, 60, (20, 2)), generator.uniform(0, 40, 20)])
    points_m[0] = device_m + [3, 2, 8]
    settings = SolverSettings(samples_per_src=30_000, batch_receivers=20)
    solved_db = PathGains(ROOT / "scenes" / "rbm" / "city.xml", FREQUENCY_HZ, settings).solve(device_m, points_m)[0]
    friis_db = to_db((WAVELENGTH_M / (4 * np.pi * np.sqrt(3**2 + 2**2 + 8**2))) ** 2)
    assert friis_db < solved_db < friis_db + 1


EDGE_M = 30.0


def thin_screen():
    """A wedge of 2 degrees with its edge along y at height EDGE_M, too deep and wide for any way around it."""
    half_m = (EDGE_M + 2000) * np.tan(np.deg2rad(1))
    sides = [(x, y, z) for y in (-2000, 2000) for x, z in ((0, EDGE_M), (half_m, -2000), (-half_m, -2000))]
    return trimesh.convex.convex_hull(np.array(sides, dtype=float))


def test_knife_edge_in_the_shadow(tmp_path):
    """The field behind a screen is that of Fresnel's integrals (ITU-R P.526-15, section 4.1).

    Rationale: the tracer uses the uniform theory of diffraction; at shadow angles up to 0.15 rad it differs from
    the knife edge by the term of the screen's own reflection, up to 20 log10(1 - tan(0.15 / 2)) = -0.7 dB, and the
    wedge is not quite a screen. Expected: every link within 1 dB, while the loss itself grows from 11 to 25 dB.
    """
    device_m = np.array([-100.0, 0.0, EDGE_M - 2.0])
    points_m = np.array([(100.0, 0.0, EDGE_M - below_m) for below_m in np.linspace(0.0, 12.0, 9)])
    direct_m = np.linalg.norm(points_m - device_m, axis=1)
    height_m = EDGE_M - (points_m[:, 2] + device_m[2]) / 2  # of the edge above the line between the ends
    v = height_m * np.sqrt(2 / WAVELENGTH_M * (1 / 100 + 1 / 100))
    s, c = fresnel(v)
    loss_db = -to_db(((1 - c - s) ** 2 + (c - s) ** 2) / 4)
    assert loss_db[0] < 11 and loss_db[-1] > 24
    metal = Material("metal", itu="metal")
    solved_db = solver(tmp_path, thin_screen(), metal).solve(device_m, points_m)
    friis_db = to_db((WAVELENGTH_M / (4 * np.pi * direct_m)) ** 2)
    assert solved_db == pytest.approx(friis_db - loss_db, abs=1.0)
    without = solver(tmp_path, thin_screen(), metal, replace(SETTINGS, diffraction="off"))
    assert np.isnan(without.solve(device_m, points_m[-1:])).all()
