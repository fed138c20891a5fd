"""Boxes in the way of links, against hand-made cases and points along each link; buildings of a map."""

import tracemalloc

import numpy as np
import pytest

from radiotwin.effects import boxes
from radiotwin.effects.boxes import (
    CELL_M,
    HEIGHT_SD_M,
    HEIGHTS_M,
    Box,
    back_project,
    building_extents_m,
    building_height_sds_m,
    buildings,
    cross,
    knife_edge_db,
    two_edges_db,
)
from tests.worlds import city_of_boxes


def inside(box, points_m):
    """Whether points lie in a box, by turning them into its frame."""
    offset = (points_m[..., 0] - box.x_m + 1j * (points_m[..., 1] - box.y_m)) * np.exp(-1j * np.radians(box.turn_deg))
    return ((np.abs(offset.real) <= box.length_m / 2) & (np.abs(offset.imag) <= box.width_m / 2)
            & (points_m[..., 2] <= box.height_m))


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, -75.0])
def test_metres_inside_are_those_of_points_along_the_link(turn_deg):
    rng = np.random.default_rng(0)
    box = Box(10.0, -5.0, 40.0, 22.0, 25.0, turn_deg)
    a_m = np.column_stack([rng.uniform(-80, 80, (200, 2)), np.full(200, 1.5)])
    b_m = np.column_stack([rng.uniform(-80, 80, (200, 2)), rng.uniform(5, 70, 200)])
    share = (np.arange(2000) + 0.5) / 2000
    is_inside = inside(box, a_m[:, None] + share[:, None] * (b_m - a_m)[:, None])
    expected_m = is_inside.mean(axis=1) * np.linalg.norm(b_m - a_m, axis=1)
    np.testing.assert_allclose(cross(box, a_m, b_m).inside_m, expected_m, atol=0.3)


def test_a_link_through_the_middle_sees_the_box_as_drawn():
    box = Box(0.0, 0.0, 20.0, 10.0, 30.0, 0.0)
    a_m, b_m = np.array([[-50.0, 1.0, 2.0], [-50.0, 40.0, 2.0]]), np.array([[50.0, 1.0, 42.0], [50.0, 40.0, 42.0]])
    crossing = cross(box, a_m, b_m)
    # Along x at y = 1: 18 m high where it enters, 26 m where it leaves, 4 m to the wall on the left, 6 m on the right.
    assert (crossing.enter_over_m[0], crossing.leave_over_m[0]) == pytest.approx((12.0, 4.0))
    assert [value[0] for value in crossing[5:]] == pytest.approx([40.0, 20.0, 40.0])
    assert (crossing.left_m[0], crossing.right_m[0]) == pytest.approx((4.0, 6.0))
    assert np.isnan(crossing.left_m[1]) and crossing.inside_m[1] == 0


def test_level_and_upright_links_are_no_exception():
    box = Box(0.0, 0.0, 20.0, 20.0, 30.0, 0.0)
    a_m = np.array([[-50.0, 0, 10], [-50.0, 0, 35], [0.0, 0, 1.5], [0.0, -50, 10]])
    b_m = np.array([[50.0, 0, 10], [50.0, 0, 35], [0.0, 0, 50], [0.0, 50, 10]])
    np.testing.assert_allclose(cross(box, a_m, b_m).inside_m, [20, 0, 28.5, 20], atol=1e-9)


@pytest.mark.parametrize("nu, loss_db", [(0.0, 6.02), (1.0, 13.87), (2.4, 20.6), (-1.0, 0.0)])
def test_a_knife_edge_loses_what_the_fresnel_integral_says(nu, loss_db):
    """Values of the exact integral; the recommendation's formula is said to be good to a tenth of a decibel."""
    wavelength_m, near_m, far_m = 0.125, 100.0, 200.0
    height_m = nu / np.sqrt(2 * (near_m + far_m) / (wavelength_m * near_m * far_m))
    assert knife_edge_db(np.array([height_m]), near_m, far_m, wavelength_m)[0] == pytest.approx(loss_db, abs=0.3)


def test_two_edges_lose_what_one_does_where_the_other_is_out_of_the_way_and_more_where_both_are_not():
    one_db = knife_edge_db(np.array([8.0]), 100.0, 200.0, 0.125)
    two_db = [two_edges_db(np.array([8.0]), np.array([second_m]), 100.0, 20.0, 180.0, 0.125)[0]
              for second_m in (-40.0, 0.0, 7.5, 8.0)]
    assert two_db[0] == pytest.approx(one_db[0])
    assert np.all(np.diff(two_db) >= 0) and one_db[0] + 2 < two_db[-1] < 2 * one_db[0]
    turned_db = two_edges_db(np.array([7.5]), np.array([8.0]), 180.0, 20.0, 100.0, 0.125)
    assert turned_db[0] == pytest.approx(two_db[2])


@pytest.mark.parametrize("between_m", [0.1, 1.0, 20.0])
def test_two_edges_below_the_way_lose_no_more_than_each_by_itself(between_m):
    """Metres below it they lose nothing, and where the way touches both, those close together are one edge."""
    def two_db(over_m):
        return two_edges_db(np.array([over_m]), np.array([over_m]), 50.0, between_m, 80.0, 0.1)[0]

    assert two_db(-6.0) == pytest.approx(0.0, abs=0.01)
    losses_db = [two_db(over_m) for over_m in np.linspace(-6, 6, 601)]
    assert (np.diff(losses_db) >= -0.01).all() and np.diff(losses_db).max() < 0.3  # no step at 0
    one_db = knife_edge_db(np.zeros(1), 50.0, 80.0, 0.1)[0]
    assert one_db <= two_db(0.0) < 2 * one_db
    if between_m <= 1:
        assert two_db(0.0) == pytest.approx(one_db, abs=0.7)


def test_long_links_are_projected_few_at_a_time_to_the_same_sums(monkeypatch):
    rng = np.random.default_rng(1)
    a_m = np.column_stack([rng.uniform(0, 200, (1000, 2)), np.full(1000, 1.5)])
    turn = rng.uniform(0, 2 * np.pi, 1000)
    b_m = a_m + np.column_stack([500 * np.cos(turn), 500 * np.sin(turn), np.full(1000, 60.0)])
    gain, found = rng.normal(size=1000), []
    for most in (boxes.MAX_POINTS, 5000):
        monkeypatch.setattr(boxes, "MAX_POINTS", most)
        tracemalloc.start()
        total = back_project(a_m, b_m, gain)[1]
        found.append((total, tracemalloc.get_traced_memory()[1]))
        tracemalloc.stop()
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-9)
    assert found[1][1] < 0.3 * found[0][1]


def test_back_projection_finds_the_cell_and_how_high_it_must_be():
    rng = np.random.default_rng(1)
    tower = Box(206.25, 131.25, 14.0, 14.0, 50.0, 0.0)
    a_m = np.column_stack([rng.uniform(0, 400, (3000, 2)), np.full(3000, 1.5)])
    b_m = np.column_stack([rng.uniform(0, 400, (3000, 2)), np.full(3000, 70.0)])
    hidden = cross(tower, a_m, b_m).inside_m > 0
    assert hidden.sum() > 30
    centres, total = back_project(a_m, b_m, np.where(hidden, 5.0, -5.0))
    place, height = np.unravel_index(total.argmax(), total.shape)
    assert np.abs(centres[place] - (tower.x_m, tower.y_m)).max() <= 1.5 * CELL_M
    assert 30 <= HEIGHTS_M[height] <= 70


@pytest.mark.parametrize("turn_deg", [-90.0, -60.0, 0.0, 44.0, 50.0, 90.0, 134.0])
def test_a_straightened_box_is_the_same_with_a_smaller_turn(turn_deg):
    box = Box(3.0, -4.0, 20.0, 10.0, 5.0, turn_deg)
    straight = box.straightened()
    assert abs(straight.turn_deg) <= 45 and straight.straightened() == straight
    corners = [np.array(sorted(each.outline_m[:4].round(6).tolist())) for each in (straight, box)]
    np.testing.assert_allclose(*corners, atol=1e-5)
    assert straight.height_m == box.height_m


BOUNDS_M = [[[0, 0, 0], [20, 10, 12]], [[40, 0, 0], [50, 30, 25]]]


def test_each_block_is_a_building_with_its_extents():
    city = city_of_boxes(*BOUNDS_M)
    label, centres_m = buildings(city)
    assert sorted(np.bincount(label)) == [12, 12]
    assert sorted(map(tuple, centres_m.tolist())) == [(10.0, 5.0, 12.0), (45.0, 15.0, 25.0)]
    low_m, high_m = building_extents_m(city, label)
    order = np.argsort(centres_m[:, 0])
    np.testing.assert_allclose(np.stack([low_m, high_m], axis=1)[order], BOUNDS_M)


def test_a_height_is_known_as_well_as_its_map_says():
    told = city_of_boxes(*BOUNDS_M, height_sd_m=np.repeat([6.5, np.nan], 12))
    first = np.argsort(buildings(told)[1][:, 0])
    assert building_height_sds_m(told)[first].tolist() == [6.5, HEIGHT_SD_M]
    for height_sd_m in (np.full(24, 0.5), None):
        assert building_height_sds_m(city_of_boxes(*BOUNDS_M, height_sd_m=height_sd_m)).tolist() == [HEIGHT_SD_M] * 2
