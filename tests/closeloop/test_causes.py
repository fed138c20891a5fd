"""Candidates are scored on held-out links, and refused where those do not support them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.search import causes
from radiotwin.closeloop.search.causes import Tried, add_causes, forward_selection
from radiotwin.closeloop.search.scoring import score_model
from radiotwin.closeloop.search.stages import SearchInputs, SearchState, search
from radiotwin.closeloop.search.trials import Trial, TrialLog
from radiotwin.closeloop.verdict import intervals, posterior
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.posterior import Step
from radiotwin.effects import registry
from radiotwin.links import prepare_links
from radiotwin.links.limits import with_usual_limits
from tests.closeloop.looking import based

INPUTS = SearchInputs(None, None, None, ())
LIMIT_DB = -97.0


def searched(measured, *effects, **others):
    """Search lasting causes."""
    model, inputs = based(measured, *effects, **others)
    return search(SearchState(model), [add_causes], inputs)


def test_an_offset_that_no_fold_has_links_enough_for_is_not_kept(open_ground):
    """Two devices, one of them 10 dB too strong, with 30 links each: as many as are needed, and fewer in each fold."""
    world = open_ground.fly(0)
    world.gain_db[world.device == 1] += 10.0
    few = (world.receiver == 0) & (world.device < 2) & (world.slot % 11 == 5)
    assert np.bincount(world.device[few]).tolist() == [30, 30]
    loop = close_loop(open_ground.measured(world).select(few), base="log-distance")
    *offsets, offset = [score for score in loop.found.log.trials if score.name == "device_gain_offset"]
    assert not any(each.kept for each in offsets)
    assert not offset.kept and "gains too little on held-out links" in offset.reason


def test_a_candidate_that_no_held_out_link_can_judge_is_refused(open_ground):
    model, _ = based(open_ground.measured(open_ground.fly(0)))
    extended = model.with_fits(model.whole, model.folds)
    extended.held_out_nll = np.full(len(model.links), np.nan)
    score = score_model(model, extended, Trial("device_gain_offset"), INPUTS.criteria)
    assert "no held-out link" in score.reason


def with_a_loud_receiver(open_ground, *effects):
    """Search lasting causes where one receiver reads 6 dB too much."""
    world = open_ground.fly(3)
    world.gain_db[world.receiver == 1] += 6.0
    return searched(open_ground.measured(world), *effects)


def test_weaker_candidates_are_scored_if_the_best_one_is_improbable(open_ground, monkeypatch):
    """A receiver that is 6 dB off gains so much that nothing else is scored, unless it is improbable."""
    effects = registry.ReceiverGainOffset(), registry.DetectionLimit(), registry.ExcessAttenuation(), registry.ReceiverDrift()
    found = with_a_loud_receiver(open_ground, *effects)
    assert [each.name for each in found.model.whole.effects][:1] == ["receiver_gain_offset"]
    outdone = {score.name for score in found.log.trials if score.step == 0 and "gains more on" in score.reason}
    believed = posterior.probability_of
    monkeypatch.setattr(posterior, "probability_of", lambda name, values: (
        0.1 if name == "receiver_gain_offset" else believed(name, values)))
    first = [score for score in with_a_loud_receiver(open_ground, *effects).log.trials if score.step == 0]
    assert outdone and outdone <= {score.name for score in first if score.gain_by_fold.size}
    assert len(first) == len([score for score in found.log.trials if score.step == 0])  # none twice


MODEL = SimpleNamespace(whole=SimpleNamespace(effects=[]))


def passed(name, nats, step=0, repeatable=False):
    """A candidate that gains on held-out links, of a model that nothing is asked of."""
    trial = Trial(name, step=step, passed=True, gain_by_fold=np.array([nats]), rmse_db=4.0)
    return Tried(SimpleNamespace(name=name, repeatable=repeatable), trial, MODEL)


def test_an_effect_whose_size_may_be_zero_is_not_named(open_ground, monkeypatch):
    measured = intervals.effect_size_db

    def uncertain(model, number):
        size_db = measured(model, number)
        assert size_db.low > 0
        return replace(size_db, low=size_db.value - 20.0, high=size_db.value + 20.0)

    monkeypatch.setattr(intervals, "effect_size_db", uncertain)
    found = with_a_loud_receiver(open_ground, registry.ReceiverGainOffset(), registry.DeviceGainOffset())
    assert not found.model.whole.effects
    (score, *_) = [each for each in found.log.trials if each.name == "receiver_gain_offset"]
    assert not score.kept and "may show nothing of it: 3.0 dB (-17.0 to 23.0)" in score.reason


@pytest.fixture
def keep_best(monkeypatch):
    """Function that keeps the best of some candidates; `several` is what is found of one kind."""
    def run(state, tried, several=()):
        for name, stand_in in (("_refit_exactly", lambda model: model),
                               ("_devices_on_one_mast", lambda _: 0), ("_add_repeats", lambda *_: several)):
            monkeypatch.setattr(causes, name, stand_in)
        return causes._keep_best(state, tried, None, INPUTS).log
    return run


def test_what_was_kept_stays_kept_where_the_number_of_a_step_comes_twice(keep_best):
    """A fault was taken back, so that the step of the effect after it is that of the next one, too."""
    fault = Trial("episode", reason="what was found later explains it")
    kept = Trial("foliage", kept=True, step=1, passed=True)
    model = SimpleNamespace(whole=SimpleNamespace(effects=[None]))
    log = keep_best(SearchState(model, TrialLog().record(fault, kept)), [passed("unexplained_trend", 30.0, 1)])
    assert [(each.name, each.kept, each.reason) for each in log.trials] == [
        ("episode", False, fault.reason), ("foliage", True, ""), ("unexplained_trend", True, "")]


@pytest.mark.parametrize(("second", "rivals"), [(None, ["missing_obstacle"]), (8.0, ["device_gain_offset"]), (60.0, [])])
def test_several_of_a_kind_are_told_from_another_effect_by_what_they_gain_together(keep_best, second, rivals):
    offset, tower = passed("device_gain_offset", 64.0), passed("missing_obstacle", 60.0, repeatable=True)
    two = [tower, passed("missing_obstacle", second, 1)] if second else []
    log = keep_best(SearchState(MODEL), [offset, tower], two)
    assert [list(each.rivals) for each in log.kept] == [rivals] + [[]] * bool(second)
    assert [each.name for each in log.kept] == (["missing_obstacle"] * 2 if second else ["device_gain_offset"])


@pytest.mark.parametrize(("nats", "chance", "kept"), [(61.0, 0.9, ["foliage", "foliage"]), (61.0, 0.6, ["device_gain_offset"]),
                                                      (30.0, 0.9, ["device_gain_offset"])])
def test_groves_of_which_one_is_improbable_beside_an_offset_are_named_where_all_are_likelier(
        keep_best, monkeypatch, nats, chance, kept):
    """An offset of each of six devices gains 64 nats, and each of two groves `nats`."""
    offset, grove = passed("device_gain_offset", 64.0), passed("foliage", nats, repeatable=True)
    offset, grove = (replace(each, trial=replace(each.trial, probability=probability, reason=reason))
                     for each, probability, reason in ((offset, 0.7, ""), (grove, 0.2, "it is not probable enough")))
    two = [grove, replace(grove, trial=replace(grove.trial, step=1, reason=""))]
    asked = []
    monkeypatch.setattr(causes, "probability_of_all", lambda *what: asked.append(what) or chance)
    log = keep_best(SearchState(MODEL, steps=(Step(0, {}, 3.0, 1.0, {}),)), [offset, grove], two)
    assert [each.name for each in log.kept] == kept
    assert all(each.probability == (chance if each.name == "foliage" else 0.7) and not each.reason for each in log.kept)
    if nats < 32:  # even two of them gain less
        assert not asked
    else:
        ((trials, other, model, ratio),) = asked
        assert len(trials) == 2 and other == 64.0 and model is MODEL and ratio == 3.0


def test_without_a_candidate_there_is_no_step():
    """What is left may depend on variables that have no order, such as flights, of which no curve can be tried."""
    state = SearchState(MODEL, TrialLog().record(Trial("foliage", kept=True, rivals=("interference",))))
    assert forward_selection(state, [], INPUTS) is state


@pytest.fixture
def selected(open_ground):
    """Function that declares anchors away from where they are, and selects with a probability that is needed."""
    def run(moved_m, min_probability):
        world = open_ground.fly(2)
        for device, east_m in moved_m.items():
            world.device_m[device, 0] += east_m
        return searched(open_ground.measured(world), registry.DevicePositionError(), registry.ReceiverGainOffset(),
                        criteria=SelectionCriteria(min_probability=min_probability))
    return run


def best_alone(result):
    return max(trial.probability for trial in result.log.trials if trial.probability == trial.probability)


def test_two_anchors_of_which_none_is_probable_alone_are_named_together(selected):
    moved_m = {1: 45.0, 3: -45.0}
    needed = best_alone(selected(moved_m, 1.0)) + 0.005
    result = selected(moved_m, needed)
    assert {each.params.device for each in result.model.whole.effects} == set(moved_m)
    kept = result.log.kept
    assert len(kept) == 2 and {trial.reason for trial in kept} == {""}
    assert all(trial.probability >= needed for trial in kept)


@pytest.mark.slow
def test_one_anchor_has_no_second_beside_it(selected):
    needed = best_alone(selected({1: 45.0}, 1.0)) + 0.005
    assert selected({1: 45.0}, needed).model.whole.effects == ()


@pytest.mark.parametrize("off_db, limit_moves, named", [
    (6.0, True, ["receiver_gain_offset"]), (6.0, False, ["receiver_gain_offset"]),
    (0.0, True, ["noise_floor_censoring"])])
def test_one_fault_has_one_name(open_ground, off_db, limit_moves, named):
    """A receiver that reads too much has a limit of detection that is as much higher."""
    world = open_ground.fly(3)
    mine = world.receiver == 1
    limit_db = np.where(mine & limit_moves, LIMIT_DB + 6.0, LIMIT_DB)
    world.gain_db += np.where(mine, off_db, 0.0)
    world.gain_db[world.gain_db < limit_db] = np.nan
    world.limit_db = -np.inf
    links = with_usual_limits(prepare_links(open_ground.measured(world), None))
    result = searched(links, registry.ReceiverGainOffset(), registry.DetectionLimit())
    assert [each.name for each in result.model.whole.effects] == named
    used_db = [float(np.median(result.model.whole.model.limit_db[links.receiver == receiver])) for receiver in (0, 1)]
    assert used_db == pytest.approx([LIMIT_DB, LIMIT_DB + 6.0 * limit_moves], abs=1.0)
