"""Roofs that are off, over blocks whose true heights the test knows, with levels of two plain laws."""

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.effects.boxes import buildings
from radiotwin.effects.catalogue.roof_heights import RoofHeights, surely_off, with_model_error
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


def test_of_a_roof_higher_than_any_that_was_tried_little_is_known(world):
    links = world(np.add(MAPPED_M, [11.0, 0.0, 0.0, 0.0]), 3)
    fit, _ = fitted(links)
    (params,) = RoofHeights().propose(fit.view)
    (roof,) = (roof for roof in params.roofs if roof.height_m == pytest.approx(20.0))
    low_m, high_m = (roof.true_offset_m + each * QUANTILE_90 * roof.offset_sd_m for each in (-1, 1))
    assert roof.offset_m < 8.1 and low_m < 11.0 < high_m


@pytest.mark.parametrize(("sd_m", "least_m", "most_m"), [(6.0, 9.0, 13.0), (3.0, 0.0, 8.1)])
def test_a_roof_is_as_far_off_as_its_map_may_be(world, sd_m, least_m, most_m):
    links = world(np.add(MAPPED_M, [11.0, 0.0, 0.0, 0.0]), 3)
    told = links.with_city(CityMap(links.city.vertices, links.city.faces,
                                   height_sd_m=np.full(len(links.city.faces), sd_m)))
    fit, _ = fitted(links)
    view = Fit(fit.coefficients, fit.scale_db, fit.objective, Model.build(told, fit.channel, 8.0)).view
    off_m = [offsets(params.roofs)[0][0] for params in RoofHeights().propose(view)]
    assert least_m <= (np.nan_to_num(off_m[0]) if off_m else 0.0) <= most_m


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



def test_it_needs_a_map_a_frequency_and_the_map_that_it_was_found_on(world, make_links):
    links = world(MAPPED_M)
    assert RoofHeights().unavailable(links) is None
    alone = make_links(np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0).uniform(20, 90, (50, 3)))
    assert "no 3D map" in RoofHeights().unavailable(alone)
    fit, _ = fitted(links)
    params = RoofHeights.Params(roofs=(Roof(99, 0.0, 0.0, 10.0, 2.0, 1.0),))
    with pytest.raises(BadInput, match="building 99, but the map has"):
        RoofHeights().with_params(params).term(links, fit.model.level_at)
