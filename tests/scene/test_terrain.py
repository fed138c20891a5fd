"""The ground as a terrain: its triangles, and what the 3D map, placement and lattices make of it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter

from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap, perturbed_map
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.readers.terrain import HeightGrid, approximate
from radiotwin.scene.vegetation import Vegetation, VegetationConfig
from tests.terrains import incline, ridge, terrain_map


def rough(seed, rows, columns, sd_m=8.0):
    heights = gaussian_filter(np.random.default_rng(seed).normal(size=(rows, columns)), 3)
    return HeightGrid(np.arange(columns) * 5.0, np.arange(rows) * 7.0, 300 + sd_m * heights / heights.std())


@pytest.mark.parametrize(("seed", "rows", "columns"), [(0, 40, 61), (1, 2, 2), (2, 2, 50), (3, 90, 30)])
def test_triangles_cover_the_grid_within_the_tolerance(seed, rows, columns):
    grid = rough(seed, rows, columns)
    mesh = approximate(grid, 0.5, 100_000)
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    area_m2 = np.cross(b - a, c - a)[:, 2] / 2
    assert (area_m2 > 0).all()  # all face up, none is flat
    assert area_m2.sum() == pytest.approx((columns - 1) * 5.0 * (rows - 1) * 7.0, rel=1e-12)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    x_m, y_m = np.meshgrid(grid.x_m[1:-1], grid.y_m[1:-1])
    if x_m.size:  # heights from elsewhere: trimesh's rays
        above = np.column_stack([x_m.ravel() + 1e-4, y_m.ravel() + 2e-4, np.full(x_m.size, 1e3)])
        hit, ray, _ = shape.ray.intersects_location(above, np.tile([0, 0, -1.0], (len(above), 1)), multiple_hits=False)
        off_m = np.abs(hit[:, 2] - grid.height_m[1:-1, 1:-1].ravel()[ray])
        assert len(ray) > 0.99 * len(above) and off_m.max() < 0.55
    assert mesh.max_error_m <= 0.5 and mesh.rms_error_m <= mesh.max_error_m


def test_a_plane_is_few_triangles_and_a_budget_holds():
    plane = replace(rough(0, 50, 50), height_m=np.add.outer(np.arange(50) * 0.7, np.arange(50) * 0.2))
    assert len(approximate(plane, 0.01, 1000).faces) < 40
    cut = approximate(rough(0, 60, 60), 0.01, 500)
    assert 400 < len(cut.faces) <= 500 and cut.max_error_m > 0.01


def test_heights_of_the_ground_between_and_beyond_its_corners():
    """Also straight above corners and sides of triangles, where rays may slip through."""
    city = terrain_map(incline(0.2, -0.1), half_m=100.0)
    axis_m = np.arange(-100, 101, 5.0)
    x_m, y_m = np.meshgrid(axis_m, axis_m)
    assert city.ground_height_m(x_m, y_m) == pytest.approx(100 + 0.2 * x_m - 0.1 * y_m, abs=0.01)
    assert city.ground_height_m(500.0, 0.0) == pytest.approx(120, abs=0.01)  # as at the border
    crest = terrain_map(ridge(40.0), half_m=200.0)
    assert crest.ground_height_m(np.array([0.0, 25.0, 50.0, -90.0]), np.zeros(4)) == pytest.approx(
        [50, 30, 10, 10], abs=0.01)


def test_flat_ground_is_at_zero():
    box_city = CityMap([[-9, -9, 0], [9, -9, 0], [9, 9, 0]], [[0, 1, 2]])
    assert box_city.terrain is None
    assert box_city.ground_height_m(np.array([3.0, 1e6]), np.zeros(2)).tolist() == [0, 0]
    assert box_city.below_ground(np.array([[0, 0, -0.1], [0, 0, 0.1]])).tolist() == [True, False]


def test_a_ridge_blocks_lines_below_its_crest():
    """The line from z = 12 m at x = -200 m to z at x = +300 m passes x = 0 at 12 + 0.4 (z - 12); the crest is at 50 m."""
    city = terrain_map(ridge(40.0))
    z_m = np.array([20.0, 60.0, 106.0, 108.0, 150.0])
    ends_m = np.column_stack([np.full(5, 300.0), np.full(5, 7.0), z_m])
    assert city.line_of_sight(np.array([[-200.0, 3.0, 12.0]]), ends_m).tolist() == (12 + 0.4 * (z_m - 12) > 50).tolist()
    # Two ends in the plain: the line at 30 m is in the ridge from x = -25 to x = +25 m
    inside_m = city.metres_inside(np.array([[-200.0, 0, 30]]), np.array([[200.0, 0, 30]]))
    assert inside_m == pytest.approx([50], abs=0.1)


def test_inside_a_building_on_a_slope_and_below_the_ground():
    building = trimesh.creation.box(bounds=[[-10, -10, 90], [10, 10, 130]])
    city = terrain_map(incline(0.3, 0.0), building=building)
    points_m = np.array([[0, 0, 110], [0, 0, 131], [50, 0, 116], [50, 0, 114], [0, 0, 95], [-50, 0, 86]])
    assert city.inside(points_m).tolist() == [True, False, False, True, True, False]
    assert city.below_ground(points_m).tolist() == [False, False, False, True, True, False]


def test_errors_of_a_map_leave_the_terrain_alone():
    building = trimesh.creation.box(bounds=[[-10, -10, 90], [10, 10, 130]])
    city = terrain_map(incline(0.3, 0.0), building=building)
    moved = perturbed_map(city, 1.0, 5.0, 0)
    same = (moved.vertices == city.vertices).all(axis=1)
    ground = np.unique(city.faces[city.terrain])
    assert same[ground].all() and not same[np.unique(city.faces[~city.terrain])].any()
    assert moved.ground_height_m(50.0, 0.0) == pytest.approx(115, abs=0.01)
    tops_m = moved.vertices[np.unique(city.faces[~city.terrain]), 2]
    assert 100 < tops_m.max() < 150 and tops_m.min() == pytest.approx(90)  # scaled from its own foot


def test_a_lattice_above_the_ground():
    lattice = Lattice.over(0, 100, 0, 60, 20, [30, 50])
    x_m, y_m = np.meshgrid(lattice.x_m, lattice.y_m)
    on_slope = replace(lattice, ground_m=incline(0.1, 0.2)(x_m, y_m))
    positions_m = on_slope.positions_m
    above_m = positions_m[:, 2] - incline(0.1, 0.2)(positions_m[:, 0], positions_m[:, 1])
    assert above_m == pytest.approx(np.repeat([30.0, 50.0], x_m.size))
    assert lattice.above == "datum" and on_slope.above == "ground"
    assert on_slope.index_of(positions_m).tolist() == list(range(len(positions_m)))
    part = on_slope.part(slice(1, 2), slice(1, 3), slice(2, 4))
    whole = positions_m.reshape(*on_slope.shape, 3)[1:2, 1:3, 2:4]
    assert part.positions_m == pytest.approx(whole.reshape(-1, 3))
    with pytest.raises(BadInput, match="not on the lattice"):
        on_slope.index_of(lattice.positions_m)


def test_vegetation_stands_on_the_slope():
    """A wood 16 m high over 40 m of an incline: a line at 8 m above it stays in it, one at 20 m does not."""
    wood = Vegetation.of([VegetationConfig(name="w", kind="wood", height_m=16.0,
                                           rings_m=[[(-20, -50), (20, -50), (20, 50), (-20, 50)]])])
    city = terrain_map(incline(0.5, 0.0))
    a_m, b_m = (np.array([[x, 0, 100 + 0.5 * x + above] for above in (8.0, 20.0, -3.0)]) for x in (-100.0, 100.0))
    found_m = wood.metres_through(a_m, b_m, city.ground_height_m)
    assert found_m == pytest.approx([40 * np.hypot(1, 0.5), 0, 0], abs=2.5)
    level = np.array([[-100.0, 0, 108.0]]), np.array([[100.0, 0, 108.0]])  # through x = -16 … 16 m of it
    assert wood.metres_through(*level, city.ground_height_m) == pytest.approx([32], abs=2.5)
