"""The shapes of a drift in time, and which of them is proposed for which receiver or device."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift

SLOTS, FLIGHT_S = 200, 300.0


@pytest.fixture
def flown(links):
    """Two receivers on four flights of 50 slots each, which start 300 s apart at 1000 s."""
    def make():
        flight = np.arange(SLOTS) // 50
        time_s = 1000 + FLIGHT_S * flight + 2.0 * (np.arange(SLOTS) % 50)
        # All over the place: where it flies past slowly, a drift looks like errors that are alike in places.
        receiver_m = np.column_stack([np.random.default_rng(0).uniform(0, 900, (SLOTS, 2)), np.full(SLOTS, 50.0)])
        return links([[0.0, 0, 1.5]], np.repeat(receiver_m, 2, axis=0), receiver=np.tile([0, 1], SLOTS),
                     flight=np.repeat(flight, 2), time_s=np.repeat(time_s, 2))
    return make


SHAPES = {
    "warm_up": (80.0, lambda t, flight: np.exp(-(t - 1000) / 80)),
    "warm_up_each_flight": (20.0, lambda t, flight: np.exp(-(t - 1000 - FLIGHT_S * flight) / 20)),
    "step": (1351.0, lambda t, flight: np.where(t >= 1351, 1.0, 0.0)),
    "ageing": (1500.0, lambda t, flight: (t - 1500) / 998),  # from 1000 to 1998 s
}


@pytest.mark.parametrize("form", SHAPES)
def test_a_form_has_its_shape_on_its_receivers_links_only(flown, form):
    records, (number, shape) = flown(), SHAPES[form]
    term = ReceiverDrift().term(records, {"receivers": {"1": [form, number]}}, None)
    mine = records.receiver == 1
    np.testing.assert_allclose(term.columns[mine, 0], shape(records.time_s, records.flight)[mine], atol=1e-9)
    np.testing.assert_array_equal(term.columns[:, 1], mine)
    assert np.abs(term.columns[~mine]).max() == 0 and np.abs(term.offset_db).max() == 0


@pytest.mark.parametrize("form", SHAPES)
def test_the_form_that_is_there_is_proposed_for_the_receiver_that_has_it(flown, view, form):
    records, (number, shape) = flown(), SHAPES[form]
    rng = np.random.default_rng(0)
    records.level_db[:] = rng.normal(0, 0.5, len(records)) \
        + np.where(records.receiver == 1, 6 * shape(records.time_s, records.flight), 0.0)
    (setting,) = ReceiverDrift().propose(view(records, np.zeros(len(records)), 1.0))
    assert list(setting["receivers"]) == ["1"]
    found, value = setting["receivers"]["1"]
    assert found == form and value == pytest.approx(number, rel=0.5 if "warm" in form else 0.01)


def test_without_times_there_is_no_drift(links):
    assert "time_s" in ReceiverDrift().lacks(links([[0.0, 0, 1.5]], np.ones((80, 3))))


def test_ageing_goes_on_as_it_was_learned_whatever_links_are_asked_for(flown, view):
    records = flown()
    records.level_db[:] = np.random.default_rng(0).normal(0, 0.5, len(records)) \
        + np.where(records.receiver == 1, 6 * (records.time_s - 1500) / 998, 0.0)
    (setting,) = ReceiverDrift().propose(view(records, np.zeros(len(records)), 1.0))
    form, middle_s = setting["receivers"]["1"]
    assert form == "ageing"
    two = replace(records.select(np.flatnonzero(records.receiver == 1)[-2:]))  # 2 s apart, as if they were a file
    column = ReceiverDrift().term(two, setting, None).columns[:, 0]
    np.testing.assert_allclose(column, (two.time_s - middle_s) / 998, atol=1e-9)  # from 1000 to 1998 s


@pytest.fixture
def heard(links):
    """One receiver hears three devices on four flights, the third one on the first two only."""
    flight = np.arange(SLOTS) // 50
    receiver_m = np.column_stack([np.random.default_rng(0).uniform(0, 900, (SLOTS, 2)), np.full(SLOTS, 50.0)])
    every = links([[0.0, 0, 1.5], [300, 0, 1.5], [0, 300, 1.5]], receiver_m, flight=np.repeat(flight, 3),
                  time_s=np.repeat(1000 + FLIGHT_S * flight + 2.0 * (np.arange(SLOTS) % 50), 3))
    return replace(every.select((every.device < 2) | (every.flight < 2)))


@pytest.mark.parametrize("form, shape", [("ageing", lambda t: (t - 1500) / 998), ("step", lambda t: 1.0 * (t >= 1600))])
def test_a_device_that_ages_or_has_changed_is_proposed_with_what_it_has_come_to(heard, view, form, shape):
    rng = np.random.default_rng(0)
    heard.level_db[:] = rng.normal(0, 0.5, len(heard)) - np.where(heard.device == 1, 6 * shape(heard.time_s), 0.0)
    (setting,) = DeviceDrift().propose(view(heard, np.zeros(len(heard)), 1.0))
    assert list(setting["devices"]) == ["1"] and setting["devices"]["1"][0] == form
    # A map is of no time: of the last.
    some_day = replace(heard, time_s=np.full(len(heard), np.nan))
    columns = DeviceDrift().term(some_day, setting, None).columns
    mine = heard.device == 1
    np.testing.assert_allclose(columns[mine], [[shape(1998.0), 1.0]] * mine.sum(), atol=0.02)
    assert np.abs(columns[~mine]).max() == 0


def test_a_device_that_few_flights_heard_is_not_said_to_have_changed(heard, view):
    heard.level_db[:] = np.random.default_rng(0).normal(0, 0.5, len(heard)) \
        - np.where((heard.device == 2) & (heard.time_s > 1310), 6.0, 0.0)
    assert DeviceDrift().propose(view(heard, np.zeros(len(heard)), 1.0)) == []
    assert "on 3 flights" in DeviceDrift().lacks(heard.select(heard.flight < 2))
