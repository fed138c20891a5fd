"""The shapes of a drift in time, and which of them is proposed for which receiver or device."""


import numpy as np
import pytest

from radiotwin.effects.catalogue.gain_drift import DeviceDrift, Drift, ReceiverDrift

SLOTS, FLIGHT_S = 200, 300.0


@pytest.fixture
def flying(make_links):
    """Make links of receivers on four flights of 50 slots each, which start 300 s apart at 1000 s."""
    def make(device_m, receivers):
        flight = np.arange(SLOTS) // 50
        time_s = 1000 + FLIGHT_S * flight + 2.0 * (np.arange(SLOTS) % 50)
        # At random positions: along a slow track, a drift looks like spatially correlated errors.
        receiver_m = np.column_stack([np.random.default_rng(0).uniform(0, 900, (SLOTS, 2)), np.full(SLOTS, 50.0)])
        each = receivers * len(device_m)
        return make_links(device_m, np.repeat(receiver_m, receivers, axis=0), flight=np.repeat(flight, each),
                          receiver=np.repeat(np.tile(np.arange(receivers), SLOTS), len(device_m)),
                          time_s=np.repeat(time_s, each))
    return make


@pytest.fixture
def flown(flying):
    return flying([[0.0, 0, 1.5]], 2)


SHAPES = {
    "warm_up": (80.0, lambda t, flight: np.exp(-(t - 1000) / 80)),
    "warm_up_each_flight": (20.0, lambda t, flight: np.exp(-(t - 1000 - FLIGHT_S * flight) / 20)),
    "step": (1351.0, lambda t, flight: np.where(t >= 1351, 1.0, 0.0)),
    "ageing": (1500.0, lambda t, flight: (t - 1500) / 998),  # from 1000 to 1998 s
}


@pytest.mark.parametrize("form", SHAPES)
def test_a_form_has_its_shape_on_its_receivers_links_only(flown, form):
    links, (number, shape) = flown, SHAPES[form]
    term = ReceiverDrift().with_params(ReceiverDrift.Params(receivers={1: Drift(form, number)})).term(links, None)
    mine = links.receiver == 1
    np.testing.assert_allclose(term.columns[mine, 0], shape(links.time_s, links.flight)[mine], atol=1e-9)
    np.testing.assert_array_equal(term.columns[:, 1], mine)
    assert np.abs(term.columns[~mine]).max() == 0 and np.abs(term.offset_db).max() == 0


@pytest.mark.parametrize("form", SHAPES)
def test_the_true_form_is_proposed_for_the_receiver_that_has_it(flown, view, form):
    links, (number, shape) = flown, SHAPES[form]
    rng = np.random.default_rng(0)
    links.level_db[:] = rng.normal(0, 0.5, len(links)) \
        + np.where(links.receiver == 1, 6 * shape(links.time_s, links.flight), 0.0)
    (params,) = ReceiverDrift().propose(view(links))
    assert list(params.receivers) == [1]
    found, value = params.receivers[1]
    assert found == form and value == pytest.approx(number, rel=0.5 if "warm" in form else 0.01)
    if form == "ageing":  # it continues as learnt for any links, here two that are 2 s apart
        two = links.select(np.flatnonzero(links.receiver == 1)[-2:])
        column = ReceiverDrift().with_params(params).term(two, None).columns[:, 0]
        np.testing.assert_allclose(column, (two.time_s - value) / 998, atol=1e-9)  # from 1000 to 1998 s


@pytest.fixture
def heard(flying):
    """Links of one receiver and three devices, of the third device on the first two flights only."""
    every = flying([[0.0, 0, 1.5], [300, 0, 1.5], [0, 300, 1.5]], 1)
    return every.select((every.device < 2) | (every.flight < 2))


@pytest.mark.parametrize("form, shape", [("ageing", lambda t: (t - 1500) / 998), ("step", lambda t: 1.0 * (t >= 1600))])
def test_a_device_that_ages_or_has_changed_is_proposed_and_mapped_in_its_latest_state(heard, view, form, shape):
    rng = np.random.default_rng(0)
    heard.level_db[:] = rng.normal(0, 0.5, len(heard)) - np.where(heard.device == 1, 6 * shape(heard.time_s), 0.0)
    (params,) = DeviceDrift().propose(view(heard))
    assert list(params.devices) == [1] and params.devices[1].form == form
    # A map has no time: it is of the latest state.
    timeless = heard.with_columns(time_s=np.full(len(heard), np.nan))
    columns = DeviceDrift().with_params(params).term(timeless, None).columns
    mine = heard.device == 1
    np.testing.assert_allclose(columns[mine], [[shape(1998.0), 1.0]] * mine.sum(), atol=0.02)
    assert np.abs(columns[~mine]).max() == 0


def test_no_drift_is_proposed_for_a_device_heard_on_few_flights(heard, view):
    heard.level_db[:] = np.random.default_rng(0).normal(0, 0.5, len(heard)) \
        - np.where((heard.device == 2) & (heard.time_s > 1310), 6.0, 0.0)
    assert DeviceDrift().propose(view(heard)) == []
    assert "on 3 flights" in DeviceDrift().unavailable(heard.select(heard.flight < 2))


def test_a_time_constant_is_refined_on_a_logarithmic_scale():
    params = ReceiverDrift.Params(receivers={0: Drift("step", 90.0), 1: Drift("warm_up", 80.0)})
    variation = ReceiverDrift().with_params(params).variation()
    np.testing.assert_array_equal(variation.values, np.log([80.0]))
    changed = variation.effect(np.array([2.0])).params
    assert changed.receivers == {0: ("step", 90.0), 1: ("warm_up", float(np.exp(2.0)))}
    assert DeviceDrift().with_params(DeviceDrift.Params(devices={0: Drift("step", 90.0)})).variation() is None


def test_which_links_no_other_flight_tells(make_links):
    time_s = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 200.0])
    links = make_links([[0.0, 0, 1.5]], np.full((6, 3), 50.0), time_s=time_s, receiver=np.array([0, 0, 0, 0, 0, 1]),
                       flight=np.arange(6), level_db=np.full(6, -80.0))
    step = ReceiverDrift().with_params(ReceiverDrift.Params(receivers={0: Drift("step", 150.0)}))
    for held_out, is_untold in ((0, False), (1, True), (2, True), (3, False), (5, False)):
        assert step.untold(links, np.arange(6) != held_out)[held_out] == is_untold
    assert step.untold(links, time_s > 150).tolist() == [True, True, False, False, False, False]
    blank = links.with_columns(level_db=np.where(np.arange(6) == 2, np.nan, -80.0))
    assert step.untold(blank, np.arange(6) != 3)[3], "a blank tells nothing"
    warming = ReceiverDrift().with_params(ReceiverDrift.Params(receivers={0: Drift("warm_up", 40.0)}))
    assert warming.untold(links, np.arange(6) != 0).tolist() == [True, False, False, False, False, False]
    ageing = ReceiverDrift().with_params(ReceiverDrift.Params(receivers={0: Drift("ageing", 150.0)}))
    assert not ageing.untold(links, np.zeros(6, dtype=bool)).any()
