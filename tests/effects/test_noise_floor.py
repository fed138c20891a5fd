"""The noise floor of one receiver, under a law of distance and under levels that are nearly known (paths)."""


import numpy as np
import pytest

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.scoring import fit_candidate, score_candidate
from radiotwin.closeloop.search.stages import SearchInputs
from radiotwin.effects.catalogue.noise_floor import NoiseFloor
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.model.fitting import add_effect, refine
from radiotwin.twin.model.model import Model

LIMIT_DB, FLOOR_DB, RAISED = -112.0, -97.0, 1
RECEIVERS, LINKS = 3, 500


class KnownLevels(LogDistance):
    """Stands for paths over a map: levels are right but for one constant a class, and no slope is fitted again."""

    def level_columns(self, links):
        return np.column_stack([links.los, ~links.los]).astype(float), np.full(2, 300.0)

    def error_group(self, links):
        return links.los.astype(int)

    def error_groups(self, links):
        return 2


def law_db(links):
    return -22 - 30 * np.log10(links.distance_m)


@pytest.fixture
def around(make_links):
    """Make links of some receivers that fly around one device, and the generator of the draw."""
    def make(receivers, seed, limit_db=LIMIT_DB):
        rng, receiver = np.random.default_rng(seed), np.repeat(np.arange(receivers), LINKS)
        receiver_m = np.column_stack([rng.uniform(0, 1500, (len(receiver), 2)), np.full(len(receiver), 40.0)])
        return make_links([[700.0, 800, 1.5]], receiver_m, limit_db=limit_db, receiver=receiver), rng
    return make


@pytest.fixture
def flown(around):
    """Links of three receivers of which one, by powers that add, reads noise."""
    links, rng = around(RECEIVERS, 0)
    floor = np.where(links.receiver == RAISED, 10 ** (FLOOR_DB / 10), 0.0)
    level_db = 10 * np.log10(10 ** ((law_db(links) + rng.normal(0, 2.5, len(links))) / 10) + floor)
    level_db += rng.normal(0, 0.5, len(links))
    links.level_db[:] = np.where(level_db < LIMIT_DB, np.nan, level_db)
    return links


@pytest.mark.parametrize("kind", [LogDistance, KnownLevels])
def test_only_the_receiver_that_has_one_gets_a_floor(flown, kind):
    assert np.isnan(flown.level_db[flown.receiver != RAISED]).mean() > 0.05
    model = Model.build(flown, kind(LogDistanceLine(-20.0, 3.0, 3.0)), 5.0)
    before = model.fit()
    found = add_effect(before, NoiseFloor())
    floors_db = found.effects[-1].params.receivers
    assert floors_db[RAISED] == pytest.approx(FLOOR_DB, abs=1.0)
    assert all(floor_db < LIMIT_DB for receiver, floor_db in floors_db.items() if receiver != RAISED)
    assert before.objective - found.objective > 50


def test_weak_links_that_scatter_widely_read_no_floor(around):
    """As where walls scatter: half of the shadow that the base expects is not there, and readings go on falling."""
    links, rng = around(2, 2, -np.inf)
    expected_db, receiver = law_db(links), links.receiver
    level_db = np.maximum(expected_db, -90 + rng.normal(0, 12, len(links))) + rng.normal(0, 2.0, len(links))
    links.level_db[:] = np.where(receiver == 1, level_db, expected_db + rng.normal(0, 2.0, len(links)))
    model = Model.build(links, KnownLevels(LogDistanceLine(-20.0, 3.0, 3.0)), 5.0)
    found = add_effect(model.fit(), NoiseFloor()).effects[-1]
    for own, floor_db in found.params.receivers.items():
        assert (links.level_db[receiver == own] < floor_db - 6.1).mean() <= 0.011
    assert "it is no floor" in NoiseFloor().with_params(NoiseFloor.Params(receivers={1: -80.0}, highest={1: -80.0})).implausible(np.zeros(0))
    assert NoiseFloor().with_params(NoiseFloor.Params(receivers={1: -80.0})).implausible(np.zeros(0)) is None


@pytest.mark.parametrize("alone", [False, True])
def test_the_usual_floor_is_not_that_of_receivers_that_have_none(make_links, alone):
    links = make_links([[0.0, 0, 1.5]], np.ones((5, 3)), receiver=np.arange(5))
    params = NoiseFloor.Params(receivers={0: -90.0, 1: -91.0, 2: -92.0}, alone=alone)
    for each in (params, NoiseFloor().with_params(params).variation().effect(np.array([-90.0, -91.0, -92.0])).params):
        floors_db = 10 * np.log10(np.maximum(NoiseFloor().with_params(each).inputs(links), 1e-30))
        np.testing.assert_allclose(floors_db, [-90, -91, -92, *[-300 if alone else -91] * 2])


def test_receivers_that_gain_nothing_by_a_floor_are_left_without(around):
    """Three of six read noise."""
    links, rng = around(6, 1)
    receiver = links.receiver
    floor = np.where(receiver < 3, 10 ** (FLOOR_DB / 10), 0.0)
    level_db = 10 * np.log10(10 ** ((law_db(links) + rng.normal(0, 2.5, len(links))) / 10) + floor)
    links.level_db[:] = np.where(level_db < LIMIT_DB, np.nan, level_db)
    model = Model.build(links, KnownLevels(LogDistanceLine(-20.0, 3.0, 3.0)), 5.0)
    fit = add_effect(model.fit(), NoiseFloor())
    found, inputs = fit.effects[-1], fit.model.terms[-1].inputs
    assert set(found.params.receivers) == {0, 1, 2} and found.params.alone
    assert all(floor_db == pytest.approx(FLOOR_DB, abs=1.0) for floor_db in found.params.receivers.values())
    assert not inputs[receiver >= 3].any() and inputs[receiver < 3].all()


def test_links_with_line_of_sight_which_are_strong_need_not_show_it(flown):
    """As over a map: links with line of sight are far above the floor, and tell nothing of it."""
    los = flown.distance_m < 400
    links = flown.with_columns(known_los=los, level_db=flown.level_db + 25.0 * los)
    index = np.arange(len(links)) // 25 % 5
    channel = KnownLevels(LogDistanceLine(-20.0, 3.0, 3.0))
    whole, *folds = (Model.build(links.with_los(los), channel, 5.0, channel_db=channel.predict(links.geometry)[0]
                                     + 25.0 * los, train=index != number).fit() for number in range(-1, 5))
    model = CrossFit(whole, tuple(folds), index, None)
    inputs = SearchInputs(links, None, None, ())
    candidate = fit_candidate(model, NoiseFloor(), inputs.criteria)
    score, extended = score_candidate(model, candidate, inputs)
    assert score.reason == "" and extended is not None


def test_a_floor_that_begins_as_high_as_it_may_be_is_still_searched_below(flown):
    """Where the highest of the floors that are tried is the highest allowed, only lower ones are left."""
    model = Model.build(flown, KnownLevels(LogDistanceLine(-40.0, 2.5, 4.0)), 5.0)
    highest_db = FLOOR_DB + 4.0
    params = NoiseFloor.Params(receivers={RAISED: highest_db}, highest={RAISED: highest_db}, alone=True)
    with_floor = model.with_effects([NoiseFloor().with_params(params)])
    refined = refine(with_floor.fit())
    assert refined.effects[-1].params.receivers[RAISED] == pytest.approx(FLOOR_DB, abs=0.7)
