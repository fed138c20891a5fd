"""Cities of boxes, turned by any angle."""

import mapbox_earcut
import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap


def _turn(points_m, angle_rad):
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(points_m, dtype=float) @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])


@pytest.fixture(scope="session")
def line_of_slab():
    """Reflection (TE, TM) of a slab as a transmission line that ends in free space; an endless one is a half space.

    Collin, "Field Theory of Guided Waves", 2nd ed., section 3.4: wave impedances of the two polarisations, and the
    input impedance of a line. The constants are those of ITU-R P.2040's table.
    """
    def build(sine, real=5.24, conductivity_s_m=0.0462 * 2.4**0.7822, thickness_m=0.1, frequency_hz=2.4e9):
        angular = 2 * np.pi * frequency_hz
        permittivity = real - 1j * conductivity_s_m / (angular * 8.8541878128e-12)
        root = np.sqrt(permittivity - 1 + sine**2)
        turn = -1j if np.isinf(thickness_m) else np.tan(angular / 299_792_458.0 * thickness_m * root)
        coefficients = []
        for outside, inside in ((1 / sine, 1 / root), (sine, root / permittivity)):  # over that of vacuum
            line = inside * (outside + 1j * inside * turn) / (inside + 1j * outside * turn)
            coefficients.append((line - outside) / (line + outside))
        return coefficients[0], -coefficients[1]  # TM: of the magnetic field
    return build


@pytest.fixture(scope="session")
def turn():
    """Rotates (n, 3) points about the vertical by an angle [rad]."""
    return _turn


@pytest.fixture(scope="session")
def box_mesh():
    """A closed box x_min, y_min, x_max, y_max, height on the ground."""
    def build(x_min, y_min, x_max, y_max, height):
        mesh = trimesh.creation.box(extents=[x_max - x_min, y_max - y_min, height])
        mesh.apply_translation([(x_min + x_max) / 2, (y_min + y_max) / 2, height / 2])
        return mesh
    return build


@pytest.fixture(scope="session")
def prism():
    """A closed prism over an outline of (n, 2) corners, counter-clockwise."""
    def build(outline_m, height_m):
        corners = np.array(outline_m, dtype=float)
        faces = mapbox_earcut.triangulate_float64(corners, np.array([len(corners)], dtype=np.uint32)).reshape(-1, 3)
        return trimesh.creation.extrude_triangulation(corners, faces, height_m)
    return build


@pytest.fixture(scope="session")
def city_of(box_mesh):
    """A map of boxes or meshes, turned by an angle [rad]."""
    def build(*parts, angle_rad=0.0):
        meshes = [part if isinstance(part, trimesh.Trimesh) else box_mesh(*part) for part in parts]
        mesh = trimesh.util.concatenate(meshes)
        return CityMap(_turn(mesh.vertices, angle_rad), mesh.faces)
    return build


@pytest.fixture(scope="session")
def town(city_of):
    """A few buildings around a street, by the angle [rad] they are turned by; two of them touch."""
    def build(angle_rad=0.0):
        return city_of((20, 5, 60, 30, 25), (60, 5, 80, 30, 18), (15, -40, 55, -12, 30), (62, -45, 90, -12, 22),
                       (-45, -20, -15, 25, 20), angle_rad=angle_rad)
    return build
