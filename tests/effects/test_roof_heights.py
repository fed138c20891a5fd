"""Roofs that are off, over blocks whose true heights the test knows, with levels of two plain laws."""

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.effects.boxes import buildings
from radiotwin.effects.catalogue.roof_heights import (
    SAMPLES,
    RoofHeights,
    roof_crossings,
    surely_off,
    with_model_error,
)
from radiotwin.effects.params import QUANTILE_90
from radiotwin.effects.places import Roof
from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Fit, Model
from tests.worlds import city_of_boxes

CORNERS_M = [(-80.0, -20.0), (-15.0, -15.0), (50.0, -25.0), (-40.0, 60.0)]  # south-western, of blocks of 30 by 30 m
MAPPED_M = (20.0, 18.0, 22.0, 15.0)
BEHIND_DB = 22.0


def city():
    return city_of_boxes(*([[x, y, 0], [x + 30, y + 30, top]] for (x, y), top in zip(CORNERS_M, MAPPED_M, strict=True)),
                         ground_m=800)


def blocked(a_m, b_m, heights_m):
    """Return whether segments pass through the blocks as they are: points along them, one by one."""
    points_m = a_m + np.linspace(0, 1, 600)[:, None, None] * (b_m - a_m)
    found = np.zeros(len(a_m), dtype=bool)
    for (x, y), top in zip(CORNERS_M, heights_m, strict=True):
        low, high = np.array([x, y, 0.0]), np.array([x + 30, y + 30, top])
        found |= ((points_m >= low) & (points_m <= high)).all(axis=2).any(axis=0)
    return found


@pytest.fixture
def world(make_links):
    """Return links over the map, levels over the true heights; receivers fly, devices stand in the streets."""
    def make(heights_m, seed=0, count=700):
        rng = np.random.default_rng(seed)
        device_m = np.array([[-60.0, -90.0, 2.0], [20.0, -80.0, 2.0], [-5.0, 45.0, 2.0], [90.0, 40.0, 2.0]])
        receiver_m = np.column_stack([rng.uniform(-150, 150, (count, 2)), rng.uniform(30, 70, count)])
        plain = make_links(device_m, receiver_m, city=city())
        a_m, b_m = plain.device_m[plain.device], plain.receiver_m
        level_db = -40 - 22 * np.log10(np.linalg.norm(b_m - a_m, axis=1)) - BEHIND_DB * blocked(a_m, b_m, heights_m)
        return make_links(device_m, receiver_m, city=city(), level_db=level_db + rng.normal(0, 2, len(a_m)))
    return make


def fitted(links):
    fit = Model.build(links, make_bases(None, 0)["twin"].fit(links).channel, 8.0).fit()
    return fit, add_effect(fit, RoofHeights())


def offsets(roofs):
    """Return what each block is off by (4,), NaN where nothing is said, and the standard deviations."""
    found = np.full((2, len(CORNERS_M)), np.nan)
    for roof in roofs:
        number = np.argmin([np.hypot(roof.x_m - x - 15, roof.y_m - y - 15) for x, y in CORNERS_M])
        assert roof.height_m == pytest.approx(MAPPED_M[number])
        found[:, number] = roof.offset_m, roof.offset_sd_m
    return found


@pytest.mark.parametrize("seed", range(3))
def test_roofs_that_are_off_are_found_and_explain_the_links(world, seed):
    true_m = np.array([5.5, -5.5, 5.5, 0.0])
    fit, better = fitted(world(np.add(MAPPED_M, true_m), seed))
    assert fit.objective - better.objective > 50
    off_m, sd_m = offsets(better.effects[-1].params.roofs)
    assert off_m[:3] == pytest.approx(true_m[:3], abs=1.2)
    assert not abs(off_m[3]) > 1.2
    sure = surely_off(better.effects[-1].params.roofs)
    assert {round(roof.height_m) for roof in sure} <= {20, 18, 22} and len(sure) >= 2
    assert sd_m[:3].min() > 1.5  # other worlds have other edges than this one
    named = better.effects[-1].parameters(better.links, None)
    assert list(named) == [f"true_minus_mapped_height_m[{roof.x_m:.0f}, {roof.y_m:.0f}]" for roof in sure]
    off_by_place = {(round(x + 15), round(y + 15)): off_m for (x, y), off_m in zip(CORNERS_M, true_m, strict=True)}
    for roof, parameter in zip(sure, named.values(), strict=True):
        assert parameter.low <= off_by_place[round(roof.x_m), round(roof.y_m)] <= parameter.high


def test_what_all_roofs_have_in_common_is_the_models_and_no_roofs():
    """Ways around corners, that no law over roofs has, make every roof seem low, one more than the other."""
    rng = np.random.default_rng(0)
    outside = 0
    for _ in range(50):
        seem_m = rng.normal(-1.4, 1.0, 10)
        roofs = with_model_error([Roof(number, 0.0, 0.0, 20.0, off_m, 0.3) for number, off_m in enumerate(seem_m)])
        outside += len(surely_off(roofs))
        assert [roof.offset_m for roof in roofs] == seem_m.tolist()  # which predict best
    assert outside <= 0.1 * 500
    *others, high = with_model_error([*(Roof(number, 0.0, 0.0, 20.0, off_m, 0.3) for number, off_m in enumerate(seem_m)),
                                       Roof(10, 0.0, 0.0, 12.0, 9.0, 0.5)])
    assert surely_off([*others, high])[0] is high and high.true_offset_m == pytest.approx(10.4, abs=1.0)
    (alone,) = with_model_error([Roof(0, 0.0, 0.0, 20.0, 2.5, 0.3)])
    assert alone.true_offset_m == 2.5 and not surely_off([alone])


@pytest.mark.parametrize(("sd_m", "least_m", "most_m"), [(6.0, 9.0, 13.0), (3.0, 0.0, 8.1)])
def test_a_roof_is_as_far_off_as_its_map_may_be(world, sd_m, least_m, most_m):
    links = world(np.add(MAPPED_M, [11.0, 0.0, 0.0, 0.0]), 3)
    told = links.with_city(CityMap(links.city.vertices, links.city.faces,
                                   height_sd_m=np.full(len(links.city.faces), sd_m)))
    fit, _ = fitted(links)
    view = Fit(fit.coefficients, fit.scale_db, fit.objective, Model.build(told, fit.channel, 8.0)).view
    (params,) = RoofHeights().propose(view)
    (roof,) = (roof for roof in params.roofs if roof.height_m == pytest.approx(20.0))
    assert least_m <= roof.offset_m <= most_m
    reach_m = QUANTILE_90 * roof.offset_sd_m  # of a roof higher than any that was tried little is known
    assert roof.true_offset_m - reach_m < 11.0 < roof.true_offset_m + reach_m


def test_a_map_that_is_right_stays(world):
    links = world(MAPPED_M, 1)
    fit, _ = fitted(links)
    for params in RoofHeights().propose(fit.view):
        assert not [roof for roof in surely_off(params.roofs) if abs(roof.offset_m) > 1.0]


def test_of_a_block_that_is_gone_nothing_is_said(world):
    twin = make_bases(None, 0)["twin"].fit(world(MAPPED_M, 2))
    model = Model.build(world((0.0, *MAPPED_M[1:]), 2), twin.channel, 8.0)
    for params in RoofHeights().propose(model.fit().view):
        assert np.isnan(offsets(params.roofs)[0][0])


def test_only_links_over_a_roof_change_and_by_no_more_than_both_classes_differ(world):
    links = world(MAPPED_M)
    fit, _ = fitted(links)
    first = int(np.argmin(np.hypot(*(buildings(city())[1][:, :2] - np.add(CORNERS_M[0], 15.0)).T)))
    params = RoofHeights.Params(roofs=(Roof(first, -65.0, -5.0, 20.0, 5.0, 1.0),))
    change_db = RoofHeights().with_params(params).term(links, fit.model.level_at).offset_db
    a_m, b_m = links.device_m[links.device], links.receiver_m
    newly = blocked(a_m, b_m, (25.0, *MAPPED_M[1:])) & ~blocked(a_m, b_m, MAPPED_M)
    far = (np.maximum(a_m[:, 0], b_m[:, 0]) < -82) | (np.minimum(a_m[:, 0], b_m[:, 0]) > -48)
    assert newly.sum() > 10 and far.sum() > 100
    assert (change_db[newly] < -3).mean() > 0.9 and change_db[newly].min() > -1.2 * BEHIND_DB
    assert (change_db[far] == 0).all() and change_db.max() <= 0.5


def test_a_building_that_the_map_does_not_have_is_one_message(world):
    links = world(MAPPED_M)
    found = RoofHeights().with_params(RoofHeights.Params(roofs=(Roof(99, 0.0, 0.0, 10.0, 2.0, 1.0),)))
    with pytest.raises(BadInput, match="building 99, but the map has"):
        found.term(links, None)


def two_blocks():
    """A block of 20 by 40 m, 30 m high, around the origin, and one of 10 by 10 m, 12 m high, 60 m to its east."""
    return city_of_boxes([[-10, -20, 0], [10, 20, 30]], [[55, -5, 0], [65, 5, 12]], ground_m=600)


def test_a_way_over_two_roofs_crosses_both_at_their_walls():
    a_m, b_m = np.array([[-100.0, 0.0, 10.0]]), np.array([[100.0, 0.0, 50.0]])  # rises by 0.2
    ways = roof_crossings(two_blocks(), a_m, b_m)
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
        assert len(roof_crossings(two_blocks(), a_m, b_m).link) == 0


def test_the_loss_is_six_decibels_at_the_edge_and_more_behind_a_higher_roof():
    a_m, b_m = np.array([[-100.0, 0.0, 30.0]]), np.array([[40.0, 0.0, 30.0]])
    ways = roof_crossings(two_blocks(), a_m, b_m)
    at_edge, higher, lower = (ways.loss_db(raised_m, 0.1)[0] for raised_m in (0.0, 5.0, -20.0))
    assert 6.0 <= at_edge < 12.5  # one edge 6 dB, two in a row at most twice that
    assert higher > at_edge + 10 and lower == 0.0
