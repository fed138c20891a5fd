"""Sionna RT's diffraction as it is mended, against the uniform theory of diffraction, written from the papers.

Faces reflect at the smaller of the angles of the two rays; slabs by ITU-R P.2040-4, eq. 43a.
"""

import numpy as np
import pytest
import trimesh

from radiotwin.coverage import CoverageSettings, Transmitter, predict_coverage
from radiotwin.propagation.paths.listing import list_paths
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material
from radiotwin.trace import trace_gains
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains
from tests.coverage.conftest import write_scene
from tests.propagation import wedges

FREQUENCY_HZ = 2.4e9
WAVELENGTH_M = 299_792_458.0 / FREQUENCY_HZ
K = 2 * np.pi / WAVELENGTH_M
PERMITTIVITY, CONDUCTIVITY, THICKNESS_M = 5.24, 0.0462 * 2.4**0.7822, 0.1  # concrete of P.2040-4, Table 3
METAL = Material("metal", itu="metal")
CONCRETE = Material("concrete", relative_permittivity=PERMITTIVITY, conductivity_s_per_m=CONDUCTIVITY, thickness_m=THICKNESS_M)
SETTINGS = SolverSettings(samples_per_src=50_000, batch_receivers=8, max_num_paths_per_src=20_000)
NEAR_M = np.array([0.5, 1.0, 2.0, 5.0, 12.0, 25.0])


def slab(sine, is_soft):
    eta = PERMITTIVITY - 1j * CONDUCTIVITY / (2 * np.pi * FREQUENCY_HZ * 8.8541878128e-12)
    root = np.sqrt(eta - 1 + sine**2)
    once = (sine - root) / (sine + root) if is_soft else (eta * sine - root) / (eta * sine + root)
    through = np.exp(-2j * K * THICKNESS_M * root)
    return once * (1 - through) / (1 - once**2 * through)


def wedge(before_m, after_m, phi_in, phi, n, material, is_soft):
    """Coefficient [m^0.5] of angles from face 0; soft: field along the edge."""
    grazing = np.sin(min(phi, phi_in)), np.sin(n * np.pi - max(phi, phi_in))
    reflected = [(-1 if is_soft else 1) if material is METAL else slab(sine, is_soft) for sine in grazing]
    return wedges.wedge(before_m, after_m, phi_in, phi, n, reflected, WAVELENGTH_M)


def gain(before_m, after_m, coefficient):
    return wedges.gain(before_m, after_m, coefficient, WAVELENGTH_M)


def both_ways(folder, shapes, far_m, near_m, **others):
    write_city(folder, shapes)
    solver = PathGains(folder / "city.xml", FREQUENCY_HZ, SolverSettings(**(SETTINGS.__dict__ | others)))
    return solver.solve(far_m, near_m), np.concatenate([solver.solve(end_m, far_m[None]) for end_m in near_m])


def prism(material, corners, z_m=1000.0, axis="z"):
    """A wedge along an axis with its edge at the origin: no way around its other edges with one diffraction."""
    points = [(*corner, z) for z in (-z_m, z_m) for corner in ((0, 0), *corners)]
    points = np.array(points, dtype=float)
    if axis == "y":
        points = points[:, [0, 2, 1]]
    return CityShape("wedge", trimesh.convex.convex_hull(points), material)


@pytest.mark.llvm
@pytest.mark.parametrize("axis", ["z", "y"])
@pytest.mark.parametrize("material", [METAL, CONCRETE], ids=["metal", "concrete"])
def test_a_right_corner_is_the_closed_form_in_both_directions(tmp_path, material, axis):
    """Vertical antennas: along an upright edge (soft), and across one that lies (hard)."""
    box = prism(material, ((60, 0), (0, 60), (60, 60)) if axis == "z" else ((600, 0), (0, -600), (600, -600)), axis=axis)
    # Faces x > 0 (of the device close by) and x = 0; mirrored in z where the edge lies
    sign = 1.0 if axis == "z" else -1.0
    far = np.array([-30.0, 20.0 * sign])
    near = np.column_stack([np.full(6, 40.0), -NEAR_M * sign])
    expected = []
    for end in near:
        before_m, after_m = np.hypot(*far), np.hypot(*end)
        phi_in = np.arctan2(-far[0], far[1] * sign)  # from the face x = 0
        phi = 1.5 * np.pi - np.arctan2(-end[1] * sign, end[0])
        expected.append(gain(before_m, after_m, wedge(before_m, after_m, phi_in, phi, 1.5, material, axis == "z")))

    def placed(points):
        return np.insert(np.atleast_2d(points), 2 if axis == "z" else 1, 3.0, axis=1)

    towards_db, from_db = both_ways(tmp_path, [box], placed(far)[0], placed(near))
    assert towards_db == pytest.approx(10 * np.log10(expected), abs=0.1)
    assert from_db == pytest.approx(towards_db, abs=0.1)


@pytest.mark.llvm
def test_behind_an_edge_with_an_obtuse_inside_a_receiver_close_to_the_face_is_reached(tmp_path):
    """An inside of 120 degrees: as released, the way from the edge to the receiver is tested from within the wall."""
    corner = np.deg2rad(120)
    shape = prism(METAL, ((600, 0), (600 * np.cos(corner), 600 * np.sin(corner))))
    n = (2 * np.pi - corner) / np.pi
    far, near = np.array([-30.0, 30.0]), np.column_stack([np.full(6, 40.0), -NEAR_M])
    phi_in = np.arctan2(far[1], far[0]) - corner
    before_m = np.hypot(*far)
    expected = [gain(before_m, after_m, wedge(before_m, after_m, phi_in, n * np.pi - np.arctan2(-end[1], end[0]), n,
                                              METAL, True))
                for end in near for after_m in [np.hypot(*end)]]
    towards_db, from_db = both_ways(tmp_path, [shape], np.append(far, 3.0), np.column_stack([near, np.full(6, 3.0)]))
    assert towards_db == pytest.approx(10 * np.log10(expected), abs=0.1)
    assert from_db == pytest.approx(towards_db, abs=0.1)


@pytest.mark.llvm
def test_a_reflection_after_the_edge_counts_its_way_once(tmp_path):
    """A metal screen behind the corner: the receiver's image is reached over the same edge, and no other path is."""
    box = prism(METAL, ((60, 0), (0, 60), (60, 60)))
    sides = [(x, -30.0, z) for x, z in ((19, -900), (60, -900), (60, 900), (19, 900))]
    screen = CityShape("screen", trimesh.Trimesh(sides, [(0, 1, 2), (0, 2, 3)], process=False), METAL)
    far_m, near_m = np.array([-30.0, 20.0, 3.0]), np.array([[40.0, -5.0, 3.0]])
    before_m, phi_in = np.hypot(30, 20), np.arctan2(30, 20)
    expected = sum(gain(before_m, np.hypot(40, y), wedge(before_m, np.hypot(40, y), phi_in, 1.5 * np.pi - np.arctan2(y, 40),
                                                         1.5, METAL, True)) for y in (5.0, 55.0))
    towards_db, from_db = both_ways(tmp_path, [box, screen], far_m, near_m)
    assert towards_db == pytest.approx(10 * np.log10(expected), abs=0.1)
    assert from_db == pytest.approx(towards_db, abs=0.1)


@pytest.mark.llvm
def test_a_mast_on_a_roof_has_one_gain_whatever_computes_it(tmp_path):
    """0.02 to 3 m above its roof, receiver in the street: over the edge, and over the edge and off the ground."""
    roof_m, edge_m, far_m, z_m = 20.0, 20.0, np.array([40.0, 80.0]), 1.5
    house = trimesh.creation.box(bounds=[[-edge_m, -400, 0], [edge_m, 400, roof_m]])
    masts = [(f"mast{height_m:g}", 0.0, 0.0, roof_m + height_m) for height_m in (0.02, 0.3, 3.0)]
    scene = write_scene(tmp_path / "scene", [house], masts, frequency_hz=FREQUENCY_HZ, sensitivity_dbm=-140.0)
    points_m = np.column_stack([edge_m + far_m, np.zeros(2), np.full(2, z_m)])
    expected = np.zeros((3, 2))
    for row, (*_, top_m) in enumerate(masts):
        before_m, phi_in = np.hypot(edge_m, top_m - roof_m), np.arctan2(top_m - roof_m, edge_m)
        for column, away_m in enumerate(far_m):
            for down_m in (roof_m - z_m, roof_m + z_m):  # the receiver, and its image
                after_m, phi = np.hypot(away_m, down_m), np.pi + np.arctan2(down_m, away_m)
                power = gain(before_m, after_m, wedge(before_m, after_m, phi_in, phi, 1.5, CONCRETE, False))
                expected[row, column] += power if down_m < roof_m else power * abs(slab(down_m / after_m, False)) ** 2
    expected_db = 10 * np.log10(expected)
    assert np.ptp(expected_db[:, 0]) > 10  # the roof takes as much from a mast close to it
    traced_db = trace_gains(scene, scene.device_m, points_m, SETTINGS)
    listed = list_paths(scene, points_m)
    power = np.bincount(listed["link_of_path"], 10 ** (listed["path_gain_db"].to_numpy() / 10), 6).reshape(3, 2)
    covered_dbm = [float(predict_coverage(
        "paths", scene, [Transmitter("mast", device_m, tx_power_dbm=0.0)],
        CoverageSettings(step_m=10.0, height_m=z_m, extent_m=(x_m - 5, x_m + 5, -5.0, 5.0))
    ).dataset["received_power_dbm"].item()) for device_m in scene.device_m for x_m in points_m[:, 0]]
    assert traced_db == pytest.approx(expected_db, abs=0.1)
    assert 10 * np.log10(power) == pytest.approx(expected_db, abs=0.1)
    assert np.reshape(covered_dbm, (3, 2)) == pytest.approx(expected_db, abs=0.1)


@pytest.mark.llvm
def test_as_released_is_one_setting_away(tmp_path):
    """Seen with Sionna RT 2.2.0: -107 dB from the wall for -139 dB."""
    box = prism(METAL, ((60, 0), (0, 60), (60, 60)))
    near_m = np.array([[40.0, -0.5, 3.0]])
    _, from_db = both_ways(tmp_path, [box], np.array([-30.0, 20.0, 3.0]), near_m, diffraction="sionna")
    assert from_db == pytest.approx(-106.5, abs=0.7)
