"""A fault on one flight, which that flight held out cannot show: in worlds that are made here."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import radiotwin as rt
from radiotwin.closeloop.crossfit import CrossFit, match_effects
from radiotwin.closeloop.search.faults import drop_idle_faults
from radiotwin.closeloop.search.stages import SearchState
from radiotwin.closeloop.search.trials import Trial
from radiotwin.effects.base import Term
from radiotwin.effects.catalogue.episode import Episode
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight
from radiotwin.effects.catalogue.gain_drift import Drift, ReceiverDrift
from radiotwin.effects.params import Estimate
from radiotwin.links.measurements import Measurements
from tests.closeloop.looking import based
from tests.worlds import leave_effects, shortened

LOSS_DB, BEGIN_S, END_S = 9.0, 330.0, 365.0


def campaign(seed, loss_db=LOSS_DB, fault_db=0.0, step_db=0.0):
    """Fly five times past six devices, with shadows of 4 dB that stay.

    All lose some decibels for 35 s of one flight; u1 reads less on flight 2, and u0 on the last.
    """
    rng = np.random.default_rng(seed)
    devices_m = np.column_stack([rng.uniform(0, 400, (6, 2)), np.full(6, 2.0)])
    parts = []
    for flight in range(5):
        for uav in range(2):
            phase = np.linspace(0, 2 * np.pi, 60) + rng.uniform(0, 2 * np.pi)
            place_m = np.column_stack([200 + 150 * np.cos(phase), 200 + 150 * np.sin(2 * phase), np.full(60, 50.0)])
            time_s = 150.0 * flight + np.arange(60) * 1.5
            for number, device_m in enumerate(devices_m):
                shadow_db = 4 * np.sin(place_m[:, 0] / 23 + 5 * number) * np.sin(place_m[:, 1] / 31 + 3 * number)
                level_db = -35 - 25 * np.log10(np.linalg.norm(place_m - device_m, axis=1)) + shadow_db
                level_db -= loss_db * ((time_s >= BEGIN_S) & (time_s <= END_S))
                level_db -= fault_db * (uav == 1 and flight == 2) + step_db * (uav == 0 and flight == 4)
                parts.append(pd.DataFrame({
                    "time_s": time_s, "flight": f"f{flight}", "receiver": f"u{uav}", "receiver_x_m": place_m[:, 0],
                    "receiver_y_m": place_m[:, 1], "receiver_z_m": 50.0, "device": f"d{number}",
                    "gain_db": level_db + rng.normal(0, 1.0, 60)}))
    devices = pd.DataFrame({"device": [f"d{number}" for number in range(6)], "x_m": devices_m[:, 0],
                            "y_m": devices_m[:, 1], "z_m": 2.0, "role": "anchor", "frequency_hz": 2.4e9})
    return Measurements(pd.concat(parts, ignore_index=True), devices)


@pytest.fixture(scope="module")
def found():
    """Loop on a campaign in which each flight is held out in turn."""
    with shortened(), pytest.MonkeyPatch.context() as patch:
        leave_effects(patch, "device_drift", "device_gain_offset", "episode", "faulty_flight", "lock_loss", "receiver_drift",
                      "receiver_gain_offset")
        return rt.close_loop(campaign(0), base="log-distance", hold_out="flight")


@pytest.mark.slow
def test_an_episode_is_as_well_known_as_the_flight_it_was_on_tells(found):
    [episode] = [each for each in rt.make_report(found)["effects"] if each["name"] == "episode"]
    loss, start, end = (episode["parameters"][f"{name}[all]"] for name in ("loss_db", "start_s", "end_s"))
    assert loss["low"] < LOSS_DB < loss["high"] < loss["low"] + 5
    assert start["low"] - 1.5 <= BEGIN_S <= start["high"] + 1.5 and start["high"] - start["low"] < 30
    assert end["low"] - 1.5 <= END_S <= end["high"] + 1.5 and end["high"] - end["low"] < 30
    assert loss["determined"] and start["determined"] and end["determined"]


@pytest.mark.slow
def test_nobody_knew_the_episode_before_its_flight_and_nothing_else_is_judged_by_it(found):
    model = found.after
    during = (model.links.time_s >= BEGIN_S) & (model.links.time_s <= END_S)
    np.testing.assert_array_equal(model.not_learnable, during)
    assert not found.before.not_learnable.any()
    assert "time_s" not in {each.variable for each in found.remaining}


@pytest.mark.slow
@pytest.mark.usefixtures("short_report")
def test_a_faulty_flight_is_no_less_one_because_another_receiver_has_changed():
    report = rt.make_report(rt.close_loop(campaign(1, loss_db=0.0, fault_db=8.0, step_db=15.0), base="log-distance",
                                          hold_out="flight"))
    [fault] = [each for each in report["effects"] if each["name"] == "faulty_flight"]
    offset = fault["parameters"]["offset_db[u1, flight f2]"]
    assert offset["low"] < -8.0 < offset["high"] < offset["low"] + 8


def test_a_step_is_somewhere_between_two_readings():
    links = SimpleNamespace(receiver=np.repeat([0, 1], 6), receiver_names=["u0", "u1"],
                            time_s=np.tile([0.0, 10.0, 20.0, 80.0, 90.0, np.nan], 2), level_db=np.zeros(12))
    links.level_db[2] = np.nan  # which shows nothing
    params = ReceiverDrift.Params(receivers={0: Drift("step", 50.0)})
    when = ReceiverDrift().with_params(params).parameters(links, Estimate(np.zeros(2), [np.eye(2)], np.zeros((2, 0))))["step_time_s[u0]"]
    assert (when.low, when.value, when.high) == (10.0, 50.0, 80.0)


def on_links(effect, first, last):
    """A found effect and its term, which acts on the links of two numbers, of a hundred."""
    number = np.arange(100)
    return effect.with_params(None), Term.of_offset(-9.0 * ((number >= first) & (number < last)))


def model_of(*found):
    """A model, and its own fit."""
    effects, terms = [each for each, _ in found], [term for _, term in found]
    model = SimpleNamespace(effects=effects, terms=terms, with_effects=lambda left: model_of(
        *((each, terms[effects.index(each)]) for each in left)))
    model.model = model
    return model


@pytest.mark.parametrize("effect", [FaultyFlight(), Episode()])
def test_one_fault_is_not_another_where_a_fold_has_not_seen_the_first(effect):
    trend = on_links(Episode(), 0, 100)
    first, second = on_links(effect, 10, 30), on_links(effect, 60, 80)
    as_its_fold_has_it = on_links(effect, 63, 80)
    whole = model_of(first, trend, second)
    assert match_effects(whole, model_of(first, trend, as_its_fold_has_it)) == [0, 1, 2]
    assert match_effects(whole, model_of(trend, as_its_fold_has_it)) == [None, 0, 1]
    assert match_effects(whole, model_of(first, trend)) == [0, 1, None]
    assert match_effects(whole, model_of(on_links(effect, 40, 50))) == [None, None, None]
    assert match_effects(whole, model_of()) == [None, None, None]
    assert match_effects(model_of(first), model_of(second)) == [0], "each has one of them"


@pytest.mark.parametrize("effect", [FaultyFlight(), Episode()])
def test_two_of_a_kind_that_a_fold_found_in_another_order_are_not_swapped(effect):
    first, second = on_links(effect, 10, 30), on_links(effect, 60, 80)
    whole = model_of(first, second)
    assert match_effects(whole, model_of(on_links(effect, 61, 80), on_links(effect, 10, 28))) == [1, 0]
    assert match_effects(whole, model_of(on_links(effect, 31, 40), on_links(effect, 40, 50))) == [0, 1]
    assert match_effects(whole, model_of(on_links(effect, 31, 40), on_links(effect, 15, 50))) == [1, 0]


@pytest.mark.parametrize("step_db", [0.0, 8.0])
def test_a_step_that_other_effects_explain_is_taken_back(step_db):
    model, inputs = based(campaign(4, loss_db=0.0, step_db=step_db), by="flight")
    step = ReceiverDrift(True).with_params(ReceiverDrift.Params(receivers={0: Drift("step", 600.0)}))
    found = SearchState(model).keep(Trial("receiver_drift"), model.map(lambda fit: fit.with_effects([step])))
    result = drop_idle_faults(found, inputs)
    stays = step_db > 0
    assert result.step == len(result.log.kept) == stays
    assert found.step == len(found.log.kept) == 1
    assert [len(fold.effects) for fold in result.model.folds] == [stays] * 5


@pytest.mark.parametrize("always", [False, True])
def test_a_fault_that_its_own_search_would_not_find_beside_the_others_is_taken_back(always):
    measurements = campaign(4, loss_db=0.0)
    table = measurements.table
    lower = (table["receiver"] == "u0") & (always | table["time_s"].between(BEGIN_S, END_S))
    table.loc[lower, "gain_db"] -= 5.0
    model, inputs = based(measurements, by="flight")
    params = Episode.Params(receiver=0, flight=None, start_s=BEGIN_S, end_s=END_S, start_within_s=(BEGIN_S - 1, BEGIN_S),
                            end_within_s=(END_S, END_S + 1), form="loss", frequency_hz=2.4e9)
    episode = Episode().with_params(params)
    found = SearchState(model).keep(Trial("episode"), model.map(lambda fit: fit.with_effects([episode])))
    assert model.whole.objective - found.model.whole.objective > inputs.criteria.min_training_gain_nats
    result = drop_idle_faults(found, inputs)
    assert result.step == len(result.log.kept) == (not always)


def test_of_two_faults_each_is_unforeseen_where_its_flight_was_held_out():
    effect, index = FaultyFlight(), np.arange(100) // 50
    first, second = on_links(effect, 10, 30), on_links(effect, 60, 80)
    folds = model_of(second), model_of(first)  # each learnt from the other half
    model = CrossFit(model_of(first, second), folds, index, None)
    np.testing.assert_array_equal(model.not_learnable, first[1].acts | second[1].acts)
