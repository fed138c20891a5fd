"""Flights that disagree and episodes: found in worlds that are made here, and not where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.episode import Episode
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight
from tests.effects.conftest import law_db, with_params

FLIGHTS, SLOTS, DEVICES, NOISE_DB, HIDDEN_DB = 6, 60, 5, 2.0, 12.0
three_seeds = pytest.mark.parametrize("seed", range(3))


@pytest.fixture
def flown(make_links, view):
    """View of two receivers on six flights along neighbouring loops; `change(links, rng)` (n,) is added [dB]."""
    def make(seed, change=lambda links, rng: 0.0, restart=False, hidden_share=0.0):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 300, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        slot, receiver, flight = (each.ravel() for each in np.meshgrid(
            np.arange(SLOTS), np.arange(2), np.arange(FLIGHTS), indexing="ij"))
        phase = 2 * np.pi * (slot / SLOTS + rng.uniform(size=(2, FLIGHTS))[receiver, flight])
        place = 150 + 100 * np.column_stack([np.sin(phase), np.cos(phase)]) + rng.normal(0, 3, (len(slot), 2))
        links = make_links(device_m, np.column_stack([place, 40.0 + receiver]), receiver=np.repeat(receiver, DEVICES),
                           flight=np.repeat(flight, DEVICES),
                           time_s=np.repeat((0.0 if restart else 200.0) * flight + slot, DEVICES))
        links.level_db[:] = law_db(links) + rng.normal(0, NOISE_DB, len(links)) + change(links, rng)
        if hidden_share:  # without line of sight: far weaker, and as wrong as a map is
            links = links.with_columns(known_los=rng.random(len(links)) >= hidden_share)
            links.level_db[~links.los] += rng.normal(0, HIDDEN_DB, (~links.los).sum())
        return view(links, law_db(links), NOISE_DB)
    return make


def part_of(given, rows):
    return replace(given, links=given.links.select(rows), residual_db=given.residual_db[rows],
                   scale_db=given.scale_db[rows], mean_db=given.mean_db[rows])


def on_flight(links):
    return (links.receiver == 1) & (links.flight == 3)


FAULTS = {
    "offset": lambda links, rng: np.where(on_flight(links), -6.0, 0.0),
    "noise": lambda links, rng: np.where(on_flight(links), rng.normal(0, 5.0, len(links)), 0.0),
    "no relation": lambda links, rng: np.where(on_flight(links), 22 * np.log10(links.distance_m) - 45
                                               + rng.normal(0, 6.0, len(links)), 0.0),
    # A last flight of another receiver that is 25 dB off is a step in time, and does not make a fault of 6 dB usual.
    "beside a step": lambda links, rng: FAULTS["offset"](links, rng) - 25.0 * (
        (links.receiver == 0) & (links.flight == FLIGHTS - 1)),
}


@pytest.mark.parametrize(("fault", "hidden_share"), [*((fault, 0.0) for fault in FAULTS), ("offset", 0.75)])
@three_seeds
def test_a_faulty_flight_is_found(flown, fault, hidden_share, seed):
    (params,) = FaultyFlight().propose(flown(seed, FAULTS[fault], hidden_share=hidden_share))
    assert (params.receiver, params.flight) == (1, "f3")
    if fault == "noise":
        assert params.noise_sd_db == pytest.approx(5.0, abs=1.5)


@pytest.mark.parametrize(("flights", "faulty", "loss_db", "found"), [
    ([0, 3, 5], 3, 12.0, ["f3"]), ([0, 3, 5], 3, 2.5, []),  # two others hardly tell how much flights usually differ
    ([0, 3, 5], 5, 12.0, []),  # the last one may be a step in time
    ([0, 1, 3, 5], 3, 4.0, ["f3"]), ([0, 1, 3, 5], 3, 1.0, [])])
@three_seeds
def test_of_few_flights_one_between_is_found_if_it_is_far_enough_off(flown, seed, flights, faulty, loss_db, found):
    given = flown(seed, lambda links, rng: np.where(links.flight == faulty, -loss_db, 0.0))
    rows = (given.links.receiver == 1) & np.isin(given.links.flight, flights)
    assert [params.flight for params in FaultyFlight().propose(part_of(given, rows))] == found


def test_its_term_acts_on_that_flight_only(flown):
    given = flown(0, FAULTS["noise"])
    (params,) = FaultyFlight().propose(given)
    fault = FaultyFlight().with_params(params)
    term, there = fault.term(given.links, law_db), on_flight(given.links)
    np.testing.assert_array_equal(term.columns[:, 0], there)
    np.testing.assert_array_equal(term.random_effect_sd_db > 0, there)
    assert fault.propose_for_fold(part_of(given, ~there)) == []


OTHERS = {
    "receiver": lambda links, rng: np.where(links.receiver == 1, -6.0, 0.0),
    "device": lambda links, rng: np.where(links.device == 2, -8.0, 0.0),
    "wall": lambda links, rng: np.where((links.receiver_m[:, 0] < 90) & (links.device < 3), -12.0, 0.0),
    "each flight": lambda links, rng: rng.normal(0, 2, (2, FLIGHTS))[links.receiver, links.flight],
}


@pytest.mark.seconds
@pytest.mark.parametrize("other", OTHERS)
@three_seeds
def test_what_is_no_fault_of_a_flight_is_not_called_one(flown, other, seed):
    given = flown(seed, OTHERS[other])
    assert FaultyFlight().propose(given) == []
    if other != "each flight":
        assert Episode().propose(given) == []


@pytest.mark.seconds
@pytest.mark.parametrize("hidden_share", [0.0, 0.75])
def test_in_draws_of_nothing_there_is_no_fault(flown, hidden_share):
    draws = (flown(seed, hidden_share=hidden_share) for seed in range(10, 16))
    assert not any(FaultyFlight().propose(given) + Episode().propose(given) for given in draws)


def during(start_s, end_s, loss_db, receivers=(0, 1), flights=range(FLIGHTS)):
    return lambda links, rng: -loss_db * ((links.time_s >= start_s) & (links.time_s < end_s)
                                          & np.isin(links.receiver, receivers) & np.isin(links.flight, flights))


@pytest.mark.parametrize(("change", "given", "receiver", "flight", "start_s", "end_s", "within_s"), [
    (during(420, 440, 7.0, receivers=[0]), {}, 0, None, 420, 439, 3),  # a wet antenna
    (lambda links, rng: np.where(links.flight == 2, -0.03 * links.distance_m, 0.0), {}, None, None, 400, 459, 5),  # rain
    (during(20, 40, 7.0, receivers=[0], flights=[2]), {"restart": True}, 0, "f2", 20, 39, 3),
    (during(430, 830, 6.0), {}, None, None, 430, 829, 4),  # over a third of the time, few others to differ from
    # A median over all would scatter by 12 dB, as three links in four do; 459 s is the flight's last.
    (during(420, 480, 5.0), {"hidden_share": 0.75}, None, None, 420, 459, 6),
], ids=["wet", "rain", "restart", "long", "hidden"])
@three_seeds
def test_an_episode_is_found_with_its_times(flown, change, given, receiver, flight, start_s, end_s, within_s, seed):
    first = Episode().propose(flown(seed, change, **given))[0]
    assert (first.receiver, first.flight) == (receiver, flight)
    assert first.start_s == pytest.approx(start_s, abs=within_s) and first.end_s == pytest.approx(end_s, abs=within_s)
    if (start_s, end_s) == (420, 439):
        assert first.form == "loss" and first.start_within_s[0] <= 420 <= first.start_within_s[1] + 1
        assert first.end_within_s[0] - 1 <= 439 <= first.end_within_s[1]


@pytest.mark.parametrize(("db_km", "why"), [(20.0, ""), (60.0, "air and rain"), (-2.0, "amplify")])
def test_an_attenuation_is_held_against_rain(db_km, why):
    rain = with_params(Episode, receiver=None, start_s=0, end_s=1, start_within_s=(0, 0), end_within_s=(1, 1),
                 form="attenuation", frequency_hz=28e9)
    assert why in (rain.implausible(np.array([db_km])) or "") and bool(rain.implausible(np.array([db_km]))) == bool(why)


@three_seeds
def test_a_receiver_that_heard_one_reading_has_no_episode(make_links, view, seed):
    """A drone hears all; a receiver far off is there for 90 links and hears one."""
    rng = np.random.default_rng(seed)
    device_m = np.array([[0.0, 0, 10], [200, 0, 10], [0, 200, 10]])
    slots = np.array([(t * 3.0, 50.0, 40.0) for t in range(200)] + [(6000.0 + t, 6000.0, 1.5) for t in range(30)])
    far, time_s = np.repeat(np.arange(230) >= 200, 3), np.repeat(np.arange(230.0), 3)
    links = make_links(device_m, slots, receiver=far.astype(int), flight=(time_s // 100).astype(int), time_s=time_s,
                       limit_db=-120.0)
    mean_db = -40 - 25 * np.log10(links.distance_m)
    level_db = mean_db + rng.normal(0, 3, len(links))
    level_db[far] = np.nan
    level_db[np.flatnonzero(far)[7]] = -118.7
    assert Episode().propose(view(links.with_columns(level_db=level_db), mean_db, 3.0)) == []
