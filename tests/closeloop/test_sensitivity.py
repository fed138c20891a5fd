"""What would have been seen: sizes that evidence asks for, and that searches find."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.sensitivity import detectable, needed_nats
from radiotwin.effects import GainEffect, catalogue
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.position_errors import MIN_MOVE_M
from radiotwin.effects.catalogue.sector_antenna import median_azimuth_deg
from radiotwin.effects.patterns import MIN_LINKS, Pattern
from tests.closeloop.looking import looked_at

CRITERIA = SelectionCriteria()


@pytest.fixture(scope="module")
def seen(open_ground):
    """`seen(seed, change)`: view of a world's residual, and the hypotheses about it."""
    def make(seed, change=lambda world: None):
        model, hypotheses = looked_at(open_ground, seed, change)
        return model.whole.view, hypotheses
    return make


@pytest.fixture(scope="module")
def nothing_hidden(seen):
    return seen(6)


@pytest.fixture
def sizes(monkeypatch):
    """`sizes(view, hypotheses, *names)`: of those families only, and of two members, as searches take their time."""
    monkeypatch.setattr("radiotwin.effects.patterns.MAX_MEMBERS", 2)

    def make(view, hypotheses, *names, criteria=CRITERIA):
        effects = [effect() for effect in catalogue() if effect.name in names]
        return {each.name: each.size for each in detectable(view, hypotheses, criteria, effects)}
    return make


def test_every_family_that_was_looked_for_has_a_size_within_what_it_may_have(nothing_hidden):
    view, hypotheses = nothing_hidden
    found = {each.name: each.size for each in detectable(view, hypotheses, CRITERIA,
                                                       [effect() for effect in catalogue()])}
    assert {"receiver_gain_offset", "device_gain_offset", "faulty_flight", "episode", "excess_attenuation"} <= set(found)
    assert all(size > 0 for size in found.values())
    assert view.links.city is None and np.isfinite(view.links.frequency_hz)
    assert "removed_obstacle" not in found and "foliage" in found
    assert found["excess_attenuation"] == np.inf  # rain takes a few dB/km at most
    assert found["device_position_error"] >= MIN_MOVE_M


def test_more_evidence_is_needed_for_more_certainty_and_beside_a_larger_rest():
    assert needed_nats("foliage", 0.5, 1.0) <= needed_nats("foliage", 0.9, 1.0) <= needed_nats("foliage", 0.9, 4.0)
    assert needed_nats("foliage", 1.0, 1.0) == np.inf


def test_without_a_frequency_nothing_is_said_of_what_depends_on_it(nothing_hidden, sizes):
    view, hypotheses = nothing_hidden
    unknown = replace(view.links, world=replace(view.links.world, frequency_hz=np.nan))
    found = sizes(replace(view, links=unknown), replace(hypotheses, links=unknown), "missing_obstacle",
                  "excess_attenuation")
    assert "missing_obstacle" not in found and 10 < found["excess_attenuation"] < np.inf


def test_an_offset_of_that_size_is_found_in_the_levels_and_one_of_half_of_it_is_not_probable(seen, nothing_hidden, sizes):
    size_db = sizes(*nothing_hidden, "receiver_gain_offset")["receiver_gain_offset"]
    for share, enough in ((1.3, True), (0.5, False)):
        def louder(world, share=share):
            world.gain_db[world.receiver == 1] += share * size_db

        _, hypotheses = seen(6, louder)
        pattern = (hypotheses.links.receiver == 1) * 1.0
        nats = 0.5 * (share * size_db) ** 2 * hypotheses.information(pattern)
        assert (nats > needed_nats("receiver_gain_offset", CRITERIA.min_probability, 0.2)) == enough


def test_the_size_of_a_fault_is_one_that_its_search_finds(nothing_hidden, sizes, monkeypatch):
    """Flights must differ little for one to stand out, however much evidence an offset would bring."""
    view, hypotheses = nothing_hidden
    usual_db = sizes(view, hypotheses, "faulty_flight")["faulty_flight"]
    pattern = next(FaultyFlight().typical_patterns(view))
    injected = replace(view, residual_db=view.residual_db + pattern.of_size_db(1.3 * usual_db))
    (params,) = FaultyFlight().propose(injected)
    row = np.flatnonzero(pattern.change_db)[0]
    assert params.receiver == view.links.receiver[row]
    assert params.flight == view.links.flight_names[view.links.flight[row]]
    rough = replace(view, residual_db=view.residual_db + np.random.default_rng(0).normal(
        0, 8.0, view.links.track.max() + 1)[view.links.track])
    assert sizes(rough, hypotheses, "faulty_flight")["faulty_flight"] > 1.4 * usual_db
    monkeypatch.setattr(FaultyFlight, "propose", lambda self, view: [])
    assert sizes(view, hypotheses, "faulty_flight")["faulty_flight"] == np.inf


def test_a_first_or_last_flight_counts_only_where_there_is_no_other(nothing_hidden):
    view, _ = nothing_hidden
    flights = {int(view.links.flight[np.flatnonzero(each.change_db)[0]]) for each in FaultyFlight().typical_patterns(view)}
    assert flights and not flights & {0, view.links.flight.max()}
    two = np.isin(view.links.flight, [0, 1])
    few = view.__class__(view.links.select(two), view.residual_db[two], view.scale_db[two], view.mean_db[two],
                         view.level_at)
    patterns = list(FaultyFlight().typical_patterns(few))
    assert patterns and all((each.change_db != 0).sum() >= MIN_LINKS for each in patterns)


def test_flights_with_clocks_far_apart_still_have_episodes(nothing_hidden, sizes):
    view, hypotheses = nothing_hidden
    late = view.links.with_columns(time_s=view.links.flight * 1e6 + view.links.time_s)
    assert sizes(replace(view, links=late), replace(hypotheses, links=late), "episode")["episode"] < np.inf


def test_what_hides_links_hides_those_that_pass_it_low(nothing_hidden):
    view, _ = nothing_hidden
    hidden = [each.change_db != 0 for each in MissingObstacle().typical_patterns(view)]
    assert hidden and all(MIN_LINKS <= each.sum() < 0.5 * len(view.links) for each in hidden)
    low = view.links.offset_m[:, 2] / view.links.distance_m
    assert all(low[each].mean() <= low.mean() + 0.1 for each in hidden)


def test_an_effect_of_ones_own_has_a_size_that_would_have_been_seen_and_a_kind_of_its_own_is_last(nothing_hidden):
    class Hum(GainEffect):
        name = "hum"

        def gain_db(self, links):
            return np.where(links.receiver == 1, -3.0, 0.0)

        def typical_patterns(self, view):
            return [Pattern("hum", "dB", "of one receiver", self.gain_db(view.links) / 3)]

    view, hypotheses = nothing_hidden
    *_, last = detectable(view, hypotheses, CRITERIA, [Hum(), FaultyFlight()])
    assert (last.name, last.pattern) == ("hum", "of one receiver") and 0 < last.size < np.inf


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 270.0])
def test_the_median_direction_turns_with_all(turn_deg):
    azimuth_deg = np.array([-40.0, -20.0, 5.0, 8.0, 30.0])
    assert median_azimuth_deg((azimuth_deg + turn_deg) % 360) == pytest.approx((5.0 + turn_deg) % 360)
