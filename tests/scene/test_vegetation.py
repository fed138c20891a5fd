"""Declared vegetation: what is allowed, and how much of a way is in it."""

import numpy as np
import pytest
from pydantic import ValidationError

from radiotwin.errors import BadInput
from radiotwin.scene.vegetation import Vegetation, VegetationConfig

SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]


def wood(ring=SQUARE, height_m=20.0, kind="wood", holes=()):
    return VegetationConfig(name="way/1", kind=kind, height_m=height_m, rings_m=[ring, *holes])


def through(declared, *ways):
    a_m, b_m = np.array(ways, dtype=float).transpose(1, 0, 2)
    return Vegetation.of(declared).metres_through(a_m, b_m)


def test_ways_through_a_square_wood_by_hand():
    found = through([wood()], [(-50, 50, 10), (150, 50, 10)],  # level, right across
                    [(-50, 50, 25), (150, 50, 25)],  # above the tops
                    [(50, 50, 1), (50, 50, 60)],  # straight up
                    [(-100, 50, 40), (100, 50, 0)],  # down from above: under the tops from x = 0 on
                    [(-100, 50, 60), (60, 50, -20)],  # below ground from x = 20 on: nothing grows there
                    [(200, 200, 5), (300, 300, 5)])  # elsewhere
    expected = [100, 0, 19, np.hypot(100, 20), 20 * np.hypot(1, 0.5), 0]
    np.testing.assert_allclose(found, expected, atol=1e-6)


HOLE = [(40.0, 40.0), (60.0, 40.0), (60.0, 60.0), (40.0, 60.0)]
BOW = [(0.0, 0.0), (100.0, 100.0), (100.0, 0.0), (0.0, 100.0)]


@pytest.mark.parametrize(("declared", "way", "metres"), [
    (wood(holes=[HOLE]), [(-50, 50, 10), (150, 50, 10)], 80), (wood(BOW), [(25, -50, 5), (25, 150, 5)], 50)])
def test_clearings_and_outlines_that_cross_themselves(declared, way, metres):
    np.testing.assert_allclose(through([declared], way), metres)


def test_of_two_that_overlap_the_higher_one_counts_and_none_twice():
    park = wood([(50.0, 0.0), (150.0, 0.0), (150.0, 100.0), (50.0, 100.0)], 10.0, "park")
    both = [park, wood()]
    np.testing.assert_allclose(through(both, [(-50, 50, 5), (250, 50, 5)], [(-50, 50, 15), (250, 50, 15)]), [150, 100])
    across = np.array([[-50.0, 50, 5]]), np.array([[250.0, 50, 5]])
    assert Vegetation.of(both).of_kind("park").metres_through(*across) == pytest.approx([50])


def test_many_ways_agree_with_points_along_them():
    rng = np.random.default_rng(0)
    ring = [(0.0, 0.0), (80.0, 10.0), (120.0, 90.0), (60.0, 60.0), (10.0, 100.0)]
    a_m, b_m = (rng.uniform([-50, -50, 0], [150, 150, 40], (300, 3)) for _ in range(2))
    found = Vegetation.of([wood(ring, 15.0)]).metres_through(a_m, b_m)
    from matplotlib.path import Path
    share = (np.arange(4000) + 0.5) / 4000
    for row in range(0, 300, 10):
        points = a_m[row] + share[:, None] * (b_m - a_m)[row]
        inside = Path(ring).contains_points(points[:, :2]) & (points[:, 2] < 15)
        assert found[row] == pytest.approx(inside.mean() * np.linalg.norm(b_m[row] - a_m[row]), abs=0.3)


@pytest.mark.parametrize("wrong", [{"kind": "hedge"}, {"height_m": 0.0}, {"height_m": 500.0},
                                   {"ring": SQUARE[:2]}, {"ring": [(0.0, 0.0), (1e9, 0.0), (0.0, 1.0)]}])
def test_what_no_vegetation_has_is_refused(wrong):
    with pytest.raises(ValidationError):
        wood(**wrong)


def comb(teeth, upright):
    """An outline with many teeth, which crosses that of a comb across it at each of them."""
    x = np.arange(teeth) * 0.1
    points = [(value, 0.0 if i % 2 else 100.0) for i, value in enumerate(x)] + [(x[-1], -5.0), (0.0, -5.0)]
    return points if upright else [(y, value) for value, y in points]


@pytest.mark.parametrize("declared", [[wood(comb(5000, True)), wood(comb(5000, False))], [wood(comb(60_000, True))]],
                         ids=["combs", "corners"])
def test_what_would_fill_the_memory_is_refused_before(declared):
    with pytest.raises(BadInput, match="the vegetation"):
        Vegetation.of(declared)


def test_woods_that_share_a_border_are_not_refused():
    strips = [wood([(10.0 * i, 0.0), (10.0 * i + 10, 0.0), (10.0 * i + 10, 500.0), (10.0 * i, 500.0)]) for i in range(300)]
    assert through(strips, [(-50, 50, 5), (5000, 50, 5)]) == pytest.approx([3000])
