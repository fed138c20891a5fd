import numpy as np
import pytest

from radiotwin.scene.surfaces import Surfaces

QUADS = {"bottom": [0, 3, 2, 1], "top": [4, 5, 6, 7], "south": [0, 1, 5, 4], "east": [1, 2, 6, 5], "north": [2, 3, 7, 6],
         "west": [3, 0, 4, 7]}


def box(x=(0, 10), y=(0, 10), z=(0, 10), sides=tuple(QUADS), inside_out=False):
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    corners = np.array([(a, b, c) for c in (z0, z1) for a, b in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], dtype=float)
    faces = np.array([part for side in sides for a, b, c, d in [QUADS[side]] for part in ((a, b, c), (a, c, d))])
    return corners, faces[:, ::-1] if inside_out else faces


WALLS = ("south", "east", "north", "west")
PLANE = (np.array([[-100, -100, 0], [100, -100, 0], [100, 100, 0], [-100, 100, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("sides", [tuple(QUADS), ("top", *WALLS), WALLS, ("top",)])
def test_only_inside_out_boxes_are_turned(sides):
    surfaces = Surfaces([box(sides=sides), box(x=(50, 60), sides=sides, inside_out=True)])
    inward = surfaces.inward()
    assert not inward[surfaces.shape == 0].any()
    assert inward[surfaces.shape == 1].all()
    assert not surfaces.turned(inward).inward().any()


def test_courtyard_walls_face_the_courtyard():
    outer, inner = (box(x=(0, 30), y=(0, 30), sides=WALLS), box(x=(10, 20), y=(10, 20), sides=WALLS, inside_out=True))
    block = np.concatenate([outer[0], inner[0]]), np.concatenate([outer[1], inner[1] + 8])
    assert not Surfaces([block]).inward().any()
    assert Surfaces([(block[0], block[1][:, ::-1])]).inward().all()


def test_neighbours_of_opposite_sense():
    corners, faces = box()
    faces[3] = faces[3][::-1]
    assert Surfaces([box(), (corners, faces)]).inconsistent_shapes().tolist() == [1]


def test_streets_on_flat_ground_are_ground():
    street = PLANE[0] * [0.05, 1, 1] + [0, 0, 0.1], PLANE[1]
    surfaces = Surfaces([PLANE, street, box(z=(0, 15))])
    np.testing.assert_array_equal(surfaces.ground_faces(), surfaces.shape < 2)
    assert not Surfaces([box(), box(x=(12, 22)), box(y=(12, 22))]).ground_faces().any()


def test_ground_within_one_mesh_with_the_buildings():
    """A city cut out of one sheet: the ground shares its vertices with the walls."""
    corners, faces = box(x=(-10, 10), y=(-10, 10), z=(0, 20), sides=("top", *WALLS))
    rim = np.array([[-60, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0.0]])
    ring = np.array([part for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)) for part in ((8 + a, 8 + b, b), (8 + a, b, a))])
    surfaces = Surfaces([(np.concatenate([corners, rim]), np.concatenate([faces, ring]))])
    np.testing.assert_array_equal(surfaces.ground_faces(), np.arange(len(surfaces.faces)) >= len(faces))


def test_level_is_the_height_of_most_of_the_area():
    high = PLANE[0] * 0.1 + [0, 0, 3], PLANE[1]
    assert Surfaces([high, PLANE]).level_m(np.ones(4, dtype=bool)) == 0.0
