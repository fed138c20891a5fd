"""Flights that disagree and episodes: found in worlds that are made here, and not where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.episode import Episode
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight
from radiotwin.effects.comparison import by_precision, mean_by_precision

FLIGHTS, SLOTS, DEVICES, NOISE_DB, HIDDEN_DB = 6, 60, 5, 2.0, 12.0


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
        mean_db = -40 - 22 * np.log10(links.distance_m)
        links.level_db[:] = mean_db + rng.normal(0, NOISE_DB, len(links)) + change(links, rng)
        if hidden_share:  # without line of sight: far weaker, and as wrong as a map is
            links = links.with_columns(known_los=rng.random(len(links)) >= hidden_share)
            links.level_db[~links.los] += rng.normal(0, HIDDEN_DB, (~links.los).sum())
        return view(links, mean_db, NOISE_DB)
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
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", range(3))
def test_a_faulty_flight_is_found(flown, fault, seed):
    (params,) = FaultyFlight().propose(flown(seed, FAULTS[fault]))
    assert (params.receiver, params.flight) == (1, "f3")
    if fault == "noise":
        assert params.noise_sd_db == pytest.approx(5.0, abs=1.5)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_another_receiver_does_not_hide_a_faulty_flight(flown, seed):
    """A last flight that is 25 dB off is a step in time, and does not make a fault of 6 dB usual."""
    (params,) = FaultyFlight().propose(flown(seed, lambda links, rng: FAULTS["offset"](links, rng) - 25.0 * (
        (links.receiver == 0) & (links.flight == FLIGHTS - 1))))
    assert (params.receiver, params.flight) == (1, "f3")


@pytest.mark.parametrize(("flights", "faulty", "loss_db", "found"), [
    ([0, 3, 5], 3, 12.0, ["f3"]), ([0, 3, 5], 3, 2.5, []),  # two others hardly tell how much flights usually differ
    ([0, 3, 5], 5, 12.0, []),  # the last one may be a step in time
    ([0, 1, 3, 5], 3, 4.0, ["f3"]), ([0, 1, 3, 5], 3, 1.0, [])])
@pytest.mark.parametrize("seed", range(3))
def test_of_few_flights_one_between_is_found_if_it_is_far_enough_off(flown, seed, flights, faulty, loss_db, found):
    given = flown(seed, lambda links, rng: np.where(links.flight == faulty, -loss_db, 0.0))
    rows = (given.links.receiver == 1) & np.isin(given.links.flight, flights)
    assert [params.flight for params in FaultyFlight().propose(part_of(given, rows))] == found


def test_its_term_acts_on_that_flight_only(flown):
    given = flown(0, FAULTS["noise"])
    (params,) = FaultyFlight().propose(given)
    fault = FaultyFlight().with_params(params)
    term = fault.term(given.links, lambda links, exact=False: -40 - 22 * np.log10(links.distance_m))
    there = on_flight(given.links)
    np.testing.assert_array_equal(term.columns[:, 0], there)
    np.testing.assert_array_equal(term.random_effect_sd_db > 0, there)
    assert fault.propose_like(part_of(given, ~there)) == []


OTHERS = {
    "nothing": lambda links, rng: 0.0,
    "receiver": lambda links, rng: np.where(links.receiver == 1, -6.0, 0.0),
    "device": lambda links, rng: np.where(links.device == 2, -8.0, 0.0),
    "wall": lambda links, rng: np.where((links.receiver_m[:, 0] < 90) & (links.device < 3), -12.0, 0.0),
    "each flight": lambda links, rng: rng.normal(0, 2, (2, FLIGHTS))[links.receiver, links.flight],
}


@pytest.mark.seconds
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("seed", range(3))
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


@pytest.mark.parametrize("seed", range(3))
def test_a_wet_antenna_within_a_flight_is_found_with_its_times(flown, seed):
    first = Episode().propose(flown(seed, lambda links, rng: np.where(
        (links.receiver == 0) & (links.time_s >= 420) & (links.time_s < 440), -7.0, 0.0)))[0]
    assert first.receiver == 0 and first.form == "loss"
    assert first.start_s == pytest.approx(420, abs=3) and first.end_s == pytest.approx(439, abs=3)
    assert first.start_within_s[0] <= 420 <= first.start_within_s[1] + 1
    assert first.end_within_s[0] - 1 <= 439 <= first.end_within_s[1]


@pytest.mark.parametrize("seed", range(3))
def test_rain_on_one_flight_is_an_attenuation_of_all_receivers(flown, seed):
    first = Episode().propose(flown(seed, lambda links, rng: np.where(
        links.flight == 2, -30.0 * links.distance_m / 1000, 0.0)))[0]
    assert first.receiver is None
    assert first.start_s == pytest.approx(400, abs=5) and first.end_s == pytest.approx(459, abs=5)


def test_where_clocks_restart_an_episode_names_its_flight(flown):
    first = Episode().propose(flown(0, lambda links, rng: np.where(
        (links.receiver == 0) & (links.flight == 2) & (links.time_s >= 20) & (links.time_s < 40), -7.0, 0.0),
        restart=True))[0]
    assert (first.receiver, first.flight) == (0, "f2")
    assert first.start_s == pytest.approx(20, abs=3) and first.end_s == pytest.approx(39, abs=3)


def test_an_attenuation_is_held_against_rain():
    params = Episode.Params(receiver=None, start_s=0, end_s=1, start_within_s=(0, 0), end_within_s=(1, 1),
                            form="attenuation", frequency_hz=28e9)
    assert Episode().with_params(params).implausible(np.array([20.0])) is None
    assert "air and rain" in Episode().with_params(params).implausible(np.array([60.0]))
    assert "amplify" in Episode().with_params(params).implausible(np.array([-2.0]))


@pytest.mark.parametrize("seed", range(3))
def test_what_all_links_have_in_common_shows_in_the_few_with_line_of_sight(flown, seed):
    """A median over all would scatter by 12 dB, as three links in four do."""
    given = flown(seed, lambda links, rng: np.where((links.time_s >= 420) & (links.time_s < 480), -5.0, 0.0),
                  hidden_share=0.75)
    first = Episode().propose(given)[0]
    assert first.receiver is None and first.form == "loss"
    assert first.start_s == pytest.approx(420, abs=6) and first.end_s == pytest.approx(459, abs=6)  # the flight's last
    (params,) = FaultyFlight().propose(flown(seed, FAULTS["offset"], hidden_share=0.75))
    assert (params.receiver, params.flight) == (1, "f3")



@pytest.mark.parametrize("seed", range(3))
def test_an_episode_over_a_third_of_the_time_has_too_few_others_to_differ_from(flown, seed):
    first = Episode().propose(flown(seed, lambda links, rng: np.where(
        (links.time_s >= 430) & (links.time_s < 830), -6.0, 0.0)))[0]
    assert first.receiver is None
    assert first.start_s == pytest.approx(430, abs=4) and first.end_s == pytest.approx(829, abs=4)


def test_a_value_counts_by_the_scatter_of_its_class_and_outliers_no_more_than_four_times_that(flown):
    given = flown(0, hidden_share=0.5)
    given.residual_db[0] = 80.0
    value_db, weight = by_precision(given, given.residual_db)
    los = given.links.los
    assert weight[~los].max() < 0.05 * weight[los].min()  # (12² + 2²) / 2² = 37
    assert value_db[0] <= 4 * 1.2 * (NOISE_DB if los[0] else np.hypot(NOISE_DB, HIDDEN_DB))
    assert abs(mean_by_precision(value_db, weight)) < 0.3
    unknown_db = np.where(los, given.residual_db, np.nan)
    assert not by_precision(given, unknown_db)[1][~los].any()



@pytest.mark.parametrize("seed", range(3))
def test_a_receiver_that_heard_one_reading_has_no_episode(make_links, view, seed):
    """A drone hears all; a receiver far off is there for 90 links and hears one."""
    rng = np.random.default_rng(seed)
    device_m = np.array([[0.0, 0, 10], [200, 0, 10], [0, 200, 10]])
    slots = np.array([(t * 3.0, 50.0, 40.0) for t in range(200)] + [(6000.0 + t, 6000.0, 1.5) for t in range(30)])
    far = np.repeat(np.arange(230) >= 200, 3)
    time_s = np.repeat(np.arange(230.0), 3)
    links = make_links(device_m, slots, receiver=far.astype(int), flight=(time_s // 100).astype(int), time_s=time_s,
                       limit_db=-120.0)
    mean_db = -40 - 25 * np.log10(links.distance_m)
    level_db = mean_db + rng.normal(0, 3, len(links))
    level_db[far] = np.nan
    level_db[np.flatnonzero(far)[7]] = -118.7
    assert Episode().propose(view(links.with_columns(level_db=level_db), mean_db, 3.0)) == []
