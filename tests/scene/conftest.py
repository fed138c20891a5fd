"""Small cities; files by hand as ASCII PLY and XML, so that no writer of the package is trusted by its own tests."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.presets import building_meshes

CUBE_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
CUBE_QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]  # outwards


def triangles(quads):
    return [part for a, b, c, d in quads for part in ([a, b, c], [a, c, d])]


def box_mesh(x, y, z=(0.0, 10.0)):
    """Corners and 12 outward triangles of the box x[0]..x[1], y[0]..y[1], z[0]..z[1]."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    return low + CUBE_CORNERS * (high - low), triangles(CUBE_QUADS)


def plane_mesh(half=100.0, z=0.0):
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, [[0, 1, 2], [0, 2, 3]]


def city_of(boxes, **more):
    """The 3D map of boxes (x_min, y_min, x_max, y_max, height) on z = 0, those that touch united."""
    mesh = trimesh.util.concatenate(building_meshes(np.array(boxes, dtype=float)))
    return CityMap(mesh.vertices, mesh.faces, **more)


def ascii_ply(vertices, faces) -> str:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in vertex) for vertex in vertices]
    lines += [" ".join(str(value) for value in (len(face), *face)) for face in faces]
    return "\n".join(lines) + "\n"


CONCRETE = '<bsdf type="itu-radio-material" id="concrete"><string name="type" value="concrete"/></bsdf>'


class CityFile:
    """A scene file in a folder; `add` writes a mesh and its shape."""

    box = staticmethod(box_mesh)
    plane = staticmethod(plane_mesh)
    ply = staticmethod(ascii_ply)

    def __init__(self, folder: Path):
        self.folder = folder
        self.path = folder / "town.xml"
        self.materials = [CONCRETE]
        self.shapes = []

    def add(self, name, mesh, material="concrete", text=None):
        (self.folder / f"mesh{len(self.shapes)}.ply").write_text(text or ascii_ply(*mesh))
        self.add_xml(
            f'<shape type="ply" id="{name}"><string name="filename" value="mesh{len(self.shapes)}.ply"/>'
            f'<ref id="{material}" name="bsdf"/></shape>'
        )
        return self

    def add_xml(self, shape):
        self.shapes.append(shape)
        return self

    def write(self):
        body = "\n".join([*self.materials, *self.shapes])
        self.path.write_text(f'<scene version="2.1.0">\n{body}\n</scene>\n')
        return self.path


@pytest.fixture
def scene_folder(small_scene, tmp_path):
    """A copy of the folder of `preset:small`, to be changed."""
    return Path(shutil.copytree(small_scene.folder, tmp_path / "scene", ignore=shutil.ignore_patterns("cache")))


@pytest.fixture
def empty_city(tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    return CityFile(folder)


@pytest.fixture
def town(empty_city):
    """A plane of 200 m with nine buildings of 20 × 20 m, 8 to 24 m high."""
    empty_city.add("ground", plane_mesh())
    for number in range(9):
        x, y = 60.0 * (number % 3) - 70, 60.0 * (number // 3) - 70
        empty_city.add(f"house{number}", box_mesh((x, x + 20), (y, y + 20), (0, 8.0 + 2 * number)))
    return empty_city
