"""The 3D map against exact geometry of boxes."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.presets import preset_boxes
from tests.scene.conftest import city_of
from tests.terrains import incline, terrain_map


def clip_interval(a_m, b_m, box):
    """Exact slab test: the part of each segment, as fractions (enter, leave), within one box standing on z = 0."""
    low, high = np.array([box[0], box[1], 0.0]), np.array([box[2], box[3], box[4]])
    direction = b_m - a_m
    with np.errstate(divide="ignore", invalid="ignore"):
        t0, t1 = (low - a_m) / direction, (high - a_m) / direction
    outside = (direction == 0) & ((a_m < low) | (a_m > high))
    near = np.where(direction == 0, -np.inf, np.minimum(t0, t1))
    far = np.where(direction == 0, np.inf, np.maximum(t0, t1))
    enter, leave = near.max(axis=1).clip(0), far.min(axis=1).clip(max=1)
    leave[outside.any(axis=1)] = -1
    return enter, leave


@pytest.fixture(scope="module")
def random_links():
    rng = np.random.default_rng(0)
    n = 20_000
    a_m = np.column_stack([rng.uniform(0, 600, n), rng.uniform(0, 800, n), rng.uniform(0.5, 10, n)])
    b_m = np.column_stack([rng.uniform(0, 600, n), rng.uniform(0, 800, n), rng.uniform(20, 65, n)])
    return a_m, b_m


def test_line_of_sight_equals_exact_boxes(random_links):
    """Every link of a dense city, but those that graze an edge by less than single precision can tell."""
    boxes = preset_boxes("rbm")
    a_m, b_m = random_links
    length = np.linalg.norm(b_m - a_m, axis=1)
    metres = np.array([(leave - enter) * length for enter, leave in (clip_interval(a_m, b_m, box) for box in boxes)])
    clear, blocked = (metres < -0.01).all(axis=0), (metres > 0.01).any(axis=0)
    city = city_of(boxes)
    los, outside = city.line_of_sight(a_m, b_m), ~city.inside(a_m)
    clear, blocked = clear & outside, blocked & outside  # from inside a solid there may be no wall in between
    assert clear.sum() > 1000 and blocked.sum() > 1000
    assert (clear | blocked | ~outside).mean() > 0.99
    assert los[clear].all() and not los[blocked].any()


def test_metres_inside_equal_the_union_of_exact_intervals(random_links):
    boxes = preset_boxes("small")
    a_m, b_m = (points[:3000] * [0.5, 0.375, 1.0] for points in random_links)
    length = np.linalg.norm(b_m - a_m, axis=1)
    intervals = np.array([clip_interval(a_m, b_m, box) for box in boxes])  # (boxes, 2, n)
    expected = np.zeros(len(a_m))
    for i in range(len(a_m)):
        end = 0.0
        for enter, leave in sorted(map(tuple, intervals[:, :, i])):
            expected[i] += max(0.0, leave - max(enter, end))
            end = max(end, leave)
    metres = city_of(boxes).metres_inside(a_m, b_m)
    assert (expected > 0).mean() > 0.3
    np.testing.assert_allclose(metres, expected * length, atol=0.1)


def test_inside_and_height_equal_exact_boxes():
    boxes = preset_boxes("small")
    rng = np.random.default_rng(1)
    points_m = rng.uniform((0, 0, 0.1), (300, 300, 60), (20_000, 3))
    within = ((points_m[:, None, :2] > boxes[None, :, :2]) & (points_m[:, None, :2] < boxes[None, :, 2:4])).all(axis=2)
    height_m = np.where(within, boxes[None, :, 4], 0.0).max(axis=1)
    far_from_roof = np.abs(points_m[:, 2] - height_m) > 0.02
    city = city_of(boxes)
    np.testing.assert_allclose(city.height_at(points_m[:, 0], points_m[:, 1]), height_m, atol=0.01)
    np.testing.assert_array_equal(city.inside(points_m)[far_from_roof], (points_m[:, 2] < height_m)[far_from_roof])


def test_an_antenna_on_a_wall_or_below_the_terrain_is_not_inside_a_building():
    box = trimesh.creation.box(bounds=[[-10, -10, 0], [10, 10, 20]])
    box.apply_translation([0, 0, 100])
    city = terrain_map(incline(0.0, 0.0), building=box)
    walls = [(10, 3, 105), (-10, 3, 105), (3, 10, 105), (3, -10, 105), (10, 10, 105), (3, 4, 120)]
    assert set(city.misplaced(walls)) == {"on a surface"}
    others = {(50, 0, 90): "below the ground", (0, 0, 105): "inside a building", (50, 0, 101): "", (0, 0, 120.02): ""}
    assert city.misplaced(list(others)).tolist() == list(others.values())


def test_a_shell_without_a_bottom_is_a_building():
    """Most city models have no floors: a point under the roof is inside all the same."""
    box = trimesh.creation.box(bounds=[[0, 0, 0], [10, 10, 10]])
    open_below = box.submesh([np.flatnonzero(box.face_normals[:, 2] > -0.5)], append=True)
    city = CityMap(open_below.vertices, open_below.faces)
    np.testing.assert_array_equal(city.inside([[5, 5, 5], [5, 5, 11], [15, 5, 5]]), [True, False, False])
    np.testing.assert_allclose(city.metres_inside([[-5, 5, 5.0]], [[15, 5, 5.0]]), [10], atol=0.05)


def test_the_answer_does_not_depend_on_the_chunk(random_links, monkeypatch):
    city = city_of(preset_boxes("small"))
    a_m, b_m = (points[:1000] for points in random_links)
    whole = city.line_of_sight(a_m, b_m), city.metres_inside(a_m, b_m)
    monkeypatch.setattr("radiotwin.scene.citymap.CHUNK", 7)
    np.testing.assert_array_equal(city.line_of_sight(a_m, b_m), whole[0])
    np.testing.assert_array_equal(city.metres_inside(a_m, b_m), whole[1])


def test_copies_of_a_building_change_nothing(random_links):
    """Two boxes, and each twenty times in the same place, in any order: the same sight, heights and insides."""
    boxes = [(100, 100, 200, 220, 30), (300, 400, 380, 500, 45)]
    city, copies = city_of(boxes), city_of([*boxes, *boxes[::-1] * 10])
    a_m, b_m = (end[:3000] for end in random_links)
    np.testing.assert_array_equal(copies.line_of_sight(a_m, b_m), city.line_of_sight(a_m, b_m))
    np.testing.assert_array_equal(copies.height_at(a_m[:, 0], a_m[:, 1]), city.height_at(a_m[:, 0], a_m[:, 1]))
    np.testing.assert_array_equal(copies.inside(a_m), city.inside(a_m))
    first = copies.first_hits(a_m, b_m)[1]
    assert set(first.tolist()) <= {-1, *range(24)} and (first >= 0).any()
