"""Where a building that the map does not show is proposed."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.boxes import Box, stands_on
from radiotwin.effects.catalogue.foliage import Foliage
from radiotwin.effects.catalogue.missing_obstacle import SHAPES, MissingObstacle
from radiotwin.propagation.laws.followed_paths import path_gains
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.scene.vegetation import Vegetation, VegetationConfig
from radiotwin.twin.model.fitting import along_paths, refine
from radiotwin.twin.model.model import Model
from tests.effects.conftest import with_params
from tests.worlds import city_of_boxes

HOUSE_M = [[200, 0, 0], [230, 30, 12]]
FAR_HOUSE_M = [[400, 400, 0], [410, 410, 10]]  # a map, but for one building that hides nothing
ROW_M = [[-60, 60, 0], [180, 70, 25]]
FIELD_M = np.array([(x_m, y_m, 5.0) for x_m in range(90, 200, 6) for y_m in range(-60, 60, 6)], float)  # receivers


def with_box(box, levels="quick", **params):
    return with_params(MissingObstacle, levels, box=box, **params)


def gain_nats(residual, params):
    offset_db = MissingObstacle().with_params(params).term(residual.links, residual.level_at).offset_db
    return residual.gain_nats(np.arange(len(residual.links)), offset_db).sum()


def nothing_elsewhere(links, exact=False):
    return np.zeros(len(links))


def test_where_no_link_has_line_of_sight_nothing_can_be_missing(make_links, view):
    receiver_m = np.column_stack([np.linspace(100, 200, 40), np.linspace(-50, 50, 40), np.full(40, 20.0)])
    links = make_links([[0.0, 0, 1.5]], receiver_m, city=city_of_boxes([[40, -500, 0], [50, 500, 100]]))
    assert MissingObstacle().propose(view(links, np.full(40, 30.0), 1.0)) == []


def test_a_map_with_a_box_in_it_keeps_its_woods():
    wood = VegetationConfig(name="w", kind="wood", height_m=15.0, rings_m=[[(0.0, 0.0), (90.0, 0.0), (90.0, 90.0)]])
    corrected = with_box(Box(100.0, 150.0, 20.0, 10.0, 30.0, 0.0)).corrected_map(
        city_of_boxes(HOUSE_M, vegetation=Vegetation.of([wood])))
    assert corrected.height_at(100.0, 150.0) == pytest.approx(30.0)
    assert corrected.vegetation.height_m.tolist() == [15.0]


@pytest.mark.parametrize(("sides_m", "turn_deg"), [((36.0, 8.0), 30.0), ((36.0, 8.0), 120.0), ((10.0, 10.0), 45.0)])
def test_a_narrow_building_is_proposed_with_its_shape_and_turn(make_links, view, sides_m, turn_deg):
    """16 dB are lost on the ways through a rectangle 16 m high; what is proposed explains half of the residual."""
    centre_m = np.array([70.0, 20.0])
    receiver_m = np.array([(x_m, y_m, 5.0) for x_m in range(90, 260, 6) for y_m in range(-120, 180, 6)])
    links = make_links([[0.0, 0, 2.0], [0.0, 90, 2.0], [60.0, -80, 2.0]], receiver_m.astype(float))
    share = np.linspace(0, 1, 400)[:, None, None]
    on_way_m = (links.device_m[links.device] + share * (links.receiver_m - links.device_m[links.device]))[..., :2] - centre_m
    along = np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
    across = np.array([-along[1], along[0]])
    inside = (np.abs(on_way_m @ along) < sides_m[0] / 2) & (np.abs(on_way_m @ across) < sides_m[1] / 2)
    lost_db = np.where(inside.any(axis=0), 16.0, 0.0)
    assert 40 < (lost_db > 0).sum() < len(links) / 3
    noise_db = np.random.default_rng(0).normal(0, 1.5, len(links))
    residual = view(links.with_columns(level_db=noise_db - lost_db), np.zeros(len(links)), 1.5, nothing_elsewhere)
    gains = [gain_nats(residual, params) for params in MissingObstacle().propose(residual)]
    assert max(gains) > 0.5 * residual.gain_nats(np.arange(len(links)), -lost_db).sum()


def test_in_a_shadow_is_the_power_of_other_paths(make_links):
    """The same high box hides two receivers; one of them has a reflection half as strong as the direct path."""
    links = make_links([[0.0, 0, 5]], np.array([[60.0, 0, 5], [0.0, 60, 5]]), city=city_of_boxes(FAR_HOUSE_M))

    def level_at(of, exact=False):
        left_db = np.where(of.receiver_m[:, 0] > 30, -3.0, -40.0)
        return np.where(of.los, 0.0, left_db)

    around = [Box(30.0, 0.0, 10.0, 60.0, 200.0, 0.0), Box(0.0, 30.0, 60.0, 10.0, 200.0, 0.0)]
    lost_db = [with_box(box).term(links, level_at).offset_db for box in around]
    assert lost_db[0][0] == pytest.approx(-3.0, abs=0.3) and lost_db[0][1] == 0
    assert lost_db[1][1] < -20 and lost_db[1][0] == 0


def test_a_search_begins_at_the_best_of_both_models_of_a_shadow(make_links, view):
    """The class without line of sight says 25 dB, the other paths 6 dB: both are proposed, and are two kinds."""
    links = make_links([[0.0, 0, 5.0], [0.0, 90, 5.0]], FIELD_M, city=city_of_boxes(FAR_HOUSE_M))

    def level_at(of, exact=False):
        return np.where(of.los, 0.0, -6.0 if exact else -25.0)

    hidden, effect = with_box(Box(60.0, 10.0, 24.0, 24.0, 30.0, 0.0), by_class=True), MissingObstacle()
    lost_db = hidden.term(links, level_at).offset_db
    assert lost_db.min() < -15 and (lost_db < -5).sum() > 30
    noise_db = np.random.default_rng(0).normal(0, 1.5, len(links))
    residual = view(links.with_columns(level_db=noise_db + lost_db), np.zeros(len(links)), 1.5, level_at)
    proposed = effect.propose(residual)
    assert {effect.with_params(params).kind() for params in proposed} == {False, True}
    gains = {kind: max(gain_nats(residual, params) for params in proposed
                       if effect.with_params(params).kind() == kind) for kind in (False, True)}
    assert gains[True] > 1.5 * gains[False] > 0
    assert not hidden.exactly().params.by_class


@pytest.mark.parametrize(("box", "refused"), [
    (Box(215.0, 15.0, 20.0, 20.0, 25.0, 0.0), True),  # within a house of 30 by 30 m, and higher
    (Box(215.0, 33.0, 28.0, 6.0, 12.0, 0.0), True),  # along its northern wall
    (Box(215.0, 75.0, 28.0, 6.0, 12.0, 0.0), False),
    (Box(215.0, 40.0, 14.0, 12.0, 12.0, 0.0), False)])  # a neighbour, 4 m from it
def test_a_box_in_a_building_of_the_map_or_along_its_wall_is_no_missing_building(make_links, box, refused):
    links = make_links([[0.0, 0, 2.0]], [[100.0, 0, 20.0]], city=city_of_boxes(HOUSE_M))
    assert ("walls or roofs are off" in (with_box(box).contradicted(links) or "")) == refused
    assert with_box(box).contradicted(make_links([[0.0, 0, 2.0]], [[100.0, 0, 20.0]])) is None, "without a map"


@pytest.mark.parametrize(("effect", "second_m", "known", "why"), [
    (MissingObstacle, [5.0, -15.0, 2.0], {0, 1, 2}, ""), (Foliage, [5.0, -15.0, 2.0], {0, 1, 2}, ""),
    (MissingObstacle, [5.0, -15.0, 2.0], {2}, "may be elsewhere"), (Foliage, [5.0, -15.0, 2.0], {2}, "may be elsewhere"),
    (MissingObstacle, [5.0, -15.0, 2.0], {0}, ""), (Foliage, [5.0, -15.0, 2.0], {0}, ""),
    (MissingObstacle, [0.0, 1.0, 12.0], {0, 1, 2}, "seen from one place"),  # on the same mast
    (MissingObstacle, [0.0, 90.0, 2.0], {0, 1, 2}, "seen from one place")])  # has nothing to do with the box
def test_what_stands_before_uncertain_devices_or_one_place_only_is_refused(make_links, effect, second_m, known, why):
    """The first device is behind the box, the third has nothing to do with it."""
    receiver_m = np.column_stack([np.linspace(90, 110, 20), np.zeros(20), np.full(20, 20.0)])
    links = make_links([[0.0, 0, 2.0], second_m, [0.0, 80.0, 2.0]], receiver_m).with_ends(anchors=frozenset(known))
    found = with_params(effect, box=Box(20.0, -5.0, 10.0, 20.0, 16.0, 0.0)).contradicted(links) or ""
    assert why in found and bool(found) == bool(why)


def test_a_search_may_stay_where_it_begins():
    """What begins outside the bounds is clipped in every trial, and nothing else is ever found."""
    for (length_m, width_m), turn_deg in SHAPES:
        variation = with_box(Box(0.0, 0.0, length_m, width_m, 20.0, turn_deg)).variation()
        assert ((variation.low <= variation.values) & (variation.values <= variation.high)).all()


@pytest.mark.seconds
def test_past_known_paths_is_what_the_box_does_not_block(make_links):
    """A high box hides two receivers; of one most power is diffuse, nine times that of its straight line."""
    receiver_m = np.array([[60.0, 0, 5], [60.0, 8, 5], [0.0, 60, 5]])
    links = make_links([[0.0, 0, 5]], receiver_m, city=city_of_boxes(FAR_HOUSE_M))

    def level_at(of, exact=False):
        assert exact
        wavelength_m = 299792458 / of.frequency_hz
        line = (wavelength_m / (4 * np.pi * np.linalg.norm(of.receiver_m - [0.0, 0, 5], axis=1)))**2
        return 10 * np.log10(np.where(of.receiver_m[:, 1] == 8, 10.0, 1.3) * line)

    lost_db = with_box(Box(30.0, 0.0, 10.0, 60.0, 200.0, 0.0), "known_paths").term(links, level_at).offset_db
    assert lost_db[0] < -5  # a third of the power of the straight line, in part by way of the ground, is left at most
    assert 10 * np.log10(8 / 10) - 0.1 < lost_db[1] < 10 * np.log10(9 / 10) + 0.1
    assert lost_db[2] == pytest.approx(0, abs=1e-3)


@pytest.mark.seconds
@pytest.mark.parametrize("seed", [0, 1])
def test_along_paths_a_box_is_found_that_quick_levels_turned(make_links, seed):
    """From 17° and some metres off a search finds most of what the true box explains."""
    true, rng, city = Box(60.0, 10.0, 22.0, 14.0, 30.0, 35.0), np.random.default_rng(seed), city_of_boxes(ROW_M)
    receiver_m = np.column_stack([rng.uniform(70, 200, 500), rng.uniform(-90, 55, 500), rng.uniform(5, 35, 500)])
    links = make_links([[0.0, 0, 2.0], [20.0, -60, 2.0], [110.0, -70, 2.0]], receiver_m, city=city)
    there = links.with_city(with_box(true).corrected_map(city))
    level_db = 10 * np.log10(path_gains(there.geometry) + 1e-13) + rng.normal(0, 1.0, len(links))
    channel = ImagePaths().fit(links.geometry, level_db, None)
    model = Model.build(links.with_columns(level_db=level_db), channel, 5.0)

    def fitted(box):
        return model.with_effects([with_box(box, "exact")]).fit()

    without, start = model.fit(), fitted(Box(62.0, 7.0, 18.0, 18.0, 26.0, 52.0))
    found = along_paths(start, without)
    gain, most = without.objective - found.objective, without.objective - fitted(true).objective
    assert found.effects[-1].is_exact
    assert gain > 0.8 * most > 0.8 * 1000 and without.objective - start.objective < 0.65 * most


def test_a_box_that_no_link_comes_near_stays_where_it_is(make_links):
    receiver_m = np.array([(x_m, y_m, 20.0) for x_m in range(50, 150, 10) for y_m in range(-60, 60, 10)], float)
    links = make_links([[0.0, 0, 2.0]], receiver_m, city=city_of_boxes(ROW_M),
                       level_db=np.linspace(-80, -70, len(receiver_m)))
    model = Model.build(links, ImagePaths().fit(links.geometry, links.level_db, None), 5.0)
    there = model.with_effects([with_box(Box(-300.0, 0.0, 20.0, 20.0, 30.0, 0.0), "known_paths")]).fit()
    assert refine(there) is there


def test_where_a_building_was_found_no_other_is_proposed(make_links, view):
    links = make_links([[0.0, 0, 2.0], [0.0, 40, 2.0]], FIELD_M)
    start_m = links.device_m[links.device]
    share = (60.0 - start_m[:, 0]) / (links.receiver_m[:, 0] - start_m[:, 0])
    passes_m = start_m[:, 1] + share * (links.receiver_m[:, 1] - start_m[:, 1])
    lost_db = np.where(np.abs(passes_m) < 10, 16.0, 0.0)
    residual = view(links.with_columns(level_db=-lost_db), np.zeros(len(links)), 1.5, nothing_elsewhere)
    before = MissingObstacle().propose(residual)
    box = before[0].box
    assert np.hypot(box.x_m - 60, box.y_m) < 25
    found = replace(residual, found=(MissingObstacle().with_params(before[0]),))
    x_m, y_m = np.meshgrid(np.linspace(-100, 300, 801), np.linspace(-200, 200, 801))
    for params in MissingObstacle().propose(found):
        again = stands_on(params.box, x_m, y_m)
        assert (stands_on(box, x_m, y_m) & again).sum() <= 0.3 * again.sum()
