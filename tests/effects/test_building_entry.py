"""Loss on the way into buildings: the published distribution, and links with one end inside."""


import numpy as np
import pytest
from scipy.stats import norm

from radiotwin.effects.catalogue.building_entry import BuildingEntry, entry_loss_db
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Model
from tests.worlds import city_of_boxes


@pytest.mark.parametrize("ghz, elevation_deg, building, values", [
    # Reference values of ITU-R Study Group 3 (workbook 'Clutter and BEL', as in github.com/eeveetza/p2109,
    # validate_p2109.m) at 10 %, nearly the median (50.11872 %), and 93.32543 %
    (28, 0, "traditional", (6.891, 20.218, 38.785)), (28, 0, "thermally_efficient", (19.484, 41.732, 70.117)),
    (2, 45, "traditional", (11.251, 23.556, 38.710)), (2, 45, "thermally_efficient", (20.566, 37.995, 59.617))])
def test_the_loss_has_the_reference_values(ghz, elevation_deg, building, values):
    found = [entry_loss_db(ghz * 1e9, elevation_deg, building, percent / 100)
             for percent in (10.0, 50.11872, 93.32543)]
    assert found == pytest.approx(values, abs=0.01)


@pytest.fixture
def indoors(make_links):
    """A device in the street; 40 receivers inside a block, 40 outside it."""
    rng = np.random.default_rng(0)
    inside_m = np.column_stack([rng.uniform(75, 125, 40), rng.uniform(-25, 25, 40), rng.uniform(2, 28, 40)])
    outside_m = np.column_stack([rng.uniform(-50, 50, (40, 2)), np.full(40, 40.0)])
    return make_links([[0.0, 0, 1.5]], np.vstack([inside_m, outside_m]), city=city_of_boxes([[70, -30, 0], [130, 30, 30]]))


def test_only_links_that_enter_lose(indoors, view):
    effect = BuildingEntry()
    assert effect.unavailable(indoors) is None
    traditional, efficient = effect.propose(view(indoors, np.zeros(80), 1.0))
    term = effect.with_params(traditional).term(indoors, None)
    expected_db = entry_loss_db(2.4e9, indoors.elevation_deg, "traditional")
    chance = -term.columns[:, 0]
    assert (chance[:40] > 0.8).all() and (chance[:40] == 1.0).mean() > 0.3 and (chance[40:] == 0.0).all()
    np.testing.assert_allclose(term.offset_db, -chance * expected_db)
    assert 8 < term.prior_sd_db[0] < 12  # sigma_1 of traditional buildings is 9.6 + 2 log f
    assert (effect.with_params(efficient).term(indoors, None).offset_db[:40] < term.offset_db[:40] - 10).all()


def test_near_a_wall_it_is_a_matter_of_chance(indoors, make_links, view):
    """The normal distribution of the position behind the wall of the block, far from its corners."""
    depth_m = np.repeat([-6.0, -2.0, 0.1, 2.0, 6.0, 20.0], 10)
    receiver_m = np.column_stack([130.0 - depth_m, np.zeros(60), np.full(60, 1.5)])
    links = make_links([[0.0, 0, 1.5]], receiver_m, city=indoors.city)
    effect = BuildingEntry()
    chance = -effect.with_params(effect.propose(view(links, np.zeros(60), 1.0))[0]).term(links, None).columns[:, 0]
    np.testing.assert_allclose(chance, norm.cdf(depth_m, scale=4.0), atol=0.05)
    exact = links.with_columns(receiver=np.full(60, -1))  # points of a map
    np.testing.assert_array_equal(effect.with_params(effect.propose(view(links, np.zeros(60), 1.0))[0]).term(exact, None).columns[:, 0],
                                  -(depth_m > 0).astype(float))
    seen = make_links([[0.0, 40.0, 1.5]], [[60.0, 40.0, 1.5], [69.0, 33.0, 1.5]], city=indoors.city)
    assert seen.los.all() and (effect.with_params(effect.propose(view(seen, np.zeros(2), 1.0))[0]).term(seen, None).columns == 0).all()


def test_loss_and_scatter_are_found(make_links):
    """600 links of a phone: half of them in a block, with 12 dB ± 6 dB, all with 3 dB of noise; the law is told."""
    block = city_of_boxes([[100, -100, 0], [160, 100, 30]])
    rng, found = np.random.default_rng(0), []
    for _ in range(3):
        x_m = np.append(rng.uniform(112, 148, 300), rng.uniform(10, 90, 300))
        receiver_m = np.column_stack([x_m, rng.uniform(-80, 80, 600), np.full(600, 1.5)])
        level_db = -40 - 24 * np.log10(np.linalg.norm(receiver_m - [0, 0, 1.5], axis=1)) + rng.normal(0, 3, 600)
        level_db[:300] -= rng.normal(12, 6, 300)
        links = make_links([[0.0, 0, 1.5]], receiver_m, city=block, level_db=level_db)
        law = LogDistance().fit(links.select(np.arange(600) >= 300).geometry, level_db[300:], None)
        added = add_effect(Model.build(links, law, 8.0).fit(), BuildingEntry())
        params = added.effects[-1].params
        found.append((BuildingEntry._loss_db(params, added.coefficients_of(-1)),
                      params.scatter_sd_db))
    loss_db, scatter_db = np.mean(found, axis=0)
    assert loss_db == pytest.approx(12.0, abs=2.5) and scatter_db == pytest.approx(6.0, abs=2.0)


@pytest.mark.parametrize("more_db, message", [(0.0, None), (-30.0, "amplify"), (-15.0, "lose 0.2 dB only"), (60.0, "99 %")])
def test_what_no_building_does_is_implausible(more_db, message):
    params = BuildingEntry.Params(building="traditional", frequency_hz=2.4e9)
    reason = BuildingEntry().with_params(params).implausible(np.array([more_db]))
    assert reason is None if message is None else message in reason
