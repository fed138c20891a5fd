"""Where links cross roofs, against a block whose walls are known."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.roof_heights import SAMPLES, roof_crossings
from tests.worlds import city_of_boxes


def city():
    """A block of 20 by 40 m, 30 m high, around the origin, and one of 10 by 10 m, 12 m high, 60 m to its east."""
    return city_of_boxes([[-10, -20, 0], [10, 20, 30]], [[55, -5, 0], [65, 5, 12]], ground_m=600)


def test_a_way_over_two_roofs_crosses_both_at_their_walls():
    a_m, b_m = np.array([[-100.0, 0.0, 10.0]]), np.array([[100.0, 0.0, 50.0]])  # rises by 0.2
    ways = roof_crossings(city(), a_m, b_m)
    assert ways.link.tolist() == [0, 0] and len(set(ways.building)) == 2
    spacing_m = 20.0 / SAMPLES
    block, other = (0, 1) if ways.before_m[0] < ways.before_m[1] else (1, 0)
    assert ways.before_m[[block, other]] == pytest.approx([90.0, 155.0], abs=spacing_m)
    assert ways.between_m[[block, other]] == pytest.approx([20.0, 10.0], abs=2 * spacing_m)
    assert ways.before_m + ways.between_m + ways.behind_m == pytest.approx([200.0, 200.0])
    assert ways.enter_over_m[block] == pytest.approx(30.0 - 28.0, abs=0.2 * spacing_m)
    assert ways.leave_over_m[block] == pytest.approx(30.0 - 32.0, abs=0.2 * spacing_m)
    assert ways.enter_over_m[other] == pytest.approx(12.0 - 41.0, abs=0.2 * spacing_m)


def test_ways_beside_a_building_and_ends_on_its_roof_do_not_cross_it():
    beside = np.array([[-100.0, 50.0, 10.0]]), np.array([[40.0, 50.0, 50.0]])
    mast = np.array([[5.0, 0.0, 33.0]]), np.array([[40.0, 80.0, 50.0]])
    for a_m, b_m in (beside, mast):
        assert len(roof_crossings(city(), a_m, b_m).link) == 0


def test_the_loss_is_six_decibels_at_the_edge_and_more_behind_a_higher_roof():
    a_m, b_m = np.array([[-100.0, 0.0, 30.0]]), np.array([[40.0, 0.0, 30.0]])
    ways = roof_crossings(city(), a_m, b_m)
    at_edge, higher, lower = (ways.loss_db(raised_m, 0.1)[0] for raised_m in (0.0, 5.0, -20.0))
    assert 6.0 <= at_edge < 12.5  # one edge 6 dB, two in a row at most twice that
    assert higher > at_edge + 10 and lower == 0.0
