"""How far errors are alike, the pieces of evidence that follow from it, and samples of very many links."""

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_folds
from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.links import (
    correlation_length_m,
    evidence,
    evidence_blocks,
    places,
    prepare_links,
    with_evidence,
)
from radiotwin.links.evidence import thin_links, thin_piles
from tests.worlds import synthetic_links


def flown(seed, length_m, noise_sd=0.5, flights=6, devices=3, slots=60, step_m=10.0, side_m=600.0, restart=False):
    """Links of one receiver along bent tracks; errors are a Gaussian field with exp(-d / length_m), and white noise."""
    rng = np.random.default_rng(seed)
    tracks = []
    for _ in range(flights):
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.3, slots))
        track = rng.uniform(0.3, 0.7, 2) * side_m + step_m * np.cumsum(np.c_[np.sin(heading), np.cos(heading)], axis=0)
        tracks.append(np.abs(side_m - np.abs(side_m - track)))  # reflected at the edges
    place = np.vstack(tracks)
    apart_m = np.linalg.norm(place[:, None] - place[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart_m / length_m) + 1e-6 * np.eye(len(place)))
    z = (root @ rng.normal(size=(len(place), devices))).ravel() + noise_sd * rng.normal(size=len(place) * devices)
    flight = np.repeat(np.arange(flights), slots * devices)
    time_s = np.repeat(np.tile(np.arange(slots), flights), devices) + (0 if restart else 200.0) * flight
    device_m = np.column_stack([rng.uniform(0, side_m, (devices, 2)), np.full(devices, 1.5)])
    receiver_m = np.repeat(np.column_stack([place, np.full(len(place), 50.0)]), devices, axis=0)
    return synthetic_links(device_m, np.tile(np.arange(devices), len(place)), receiver_m, level_db=z, flight=flight,
                           time_s=time_s)


def usual(found):
    return float(np.exp(np.mean(np.log(found))))


@pytest.mark.parametrize("length_m", [20.0, 40.0])
def test_the_length_of_a_known_field_is_recovered(length_m):
    found = [correlation_length_m(links, links.level_db) for links in (flown(seed, length_m) for seed in range(6))]
    assert length_m / 1.6 < usual(found) < 1.6 * length_m
    assert sum(length_m / 1.6 < each < 1.6 * length_m for each in found) >= 5


def test_errors_that_are_not_correlated_have_the_length_of_a_step():
    links = flown(0, 20.0)
    z = np.random.default_rng(1).normal(size=len(links))
    assert correlation_length_m(links, z) < 20.0
    assert correlation_length_m(links, z) == correlation_length_m(links, z)


def test_pieces_are_as_wide_as_errors_are_alike():
    links = flown(0, 40.0)
    marked = with_evidence(links, links.level_db)
    length_m = correlation_length_m(links, links.level_db)
    block = evidence_blocks(marked)
    widest = max(np.ptp(links.receiver_m[block == each, :2], axis=0).max() for each in np.unique(block))
    assert widest <= length_m + 1e-9
    some = marked.select(np.arange(50))
    np.testing.assert_array_equal(evidence_blocks(some), block[:50])  # fixed once: candidates are compared on the same


def test_another_flight_and_receiver_over_the_same_ground_is_at_the_same_places():
    once = flown(0, 40.0)
    marked = with_evidence(once, once.level_db)
    both = once.select(np.tile(np.arange(len(once)), 2))
    second = np.arange(len(both)) >= len(once)
    both = synthetic_links(both.device_m, both.device, both.receiver_m, level_db=both.level_db, time_s=both.time_s,
                           flight=both.flight + 6 * second, receiver=second.astype(int))
    twice = with_evidence(both, both.level_db)
    count = {name: [len(np.unique(label(each))) for each in (marked, twice)]
             for name, label in (("places", places), ("pieces", evidence_blocks))}
    assert count["places"][1] < 1.2 * count["places"][0] and count["pieces"][1] > 1.7 * count["pieces"][0]
    assert count["places"][0] < count["pieces"][0]
    np.testing.assert_array_equal(places(twice)[second], places(twice)[~second])
    widest = max(np.ptp(once.receiver_m[places(marked) == each, :2], axis=0).max() for each in np.unique(places(marked)))
    assert widest > correlation_length_m(once, once.level_db)


def test_a_campaign_within_100_m_is_cut_into_smaller_pieces_and_says_so():
    links = flown(1, 30.0, flights=2, side_m=60.0, step_m=4.0)
    east_m, north_m = links.receiver_m[:, :2].T
    waves = np.sin(2 * np.pi * east_m / 60.0) + np.cos(2 * np.pi * north_m / 60.0)  # alike for some 15 m
    marked = with_evidence(links, waves + np.random.default_rng(1).normal(0, 0.2, len(links)))
    places = np.unique(np.column_stack([marked.evidence, marked.flight, marked.device]), axis=0)
    assert len(places) >= 6 and "evidence is little" in " ".join(marked.notes)
    folds = make_folds(links, 0)
    assert folds.by == "block" and folds.count == 6
    assert np.bincount(folds.index).min() > 0


def test_a_receiver_that_hovers_is_thinned_and_the_rest_stays():
    links = flown(2, 30.0)
    hover = np.repeat(np.flatnonzero((links.flight == 2) & (links.time_s == 430)), 400)
    both = links.select(np.r_[np.arange(len(links)), hover])
    thinned = thin_piles(both)
    assert len(thinned) < len(links) + 100 and "stayed at" in thinned.notes[-1]
    elsewhere = [(each.flight != 2).sum() for each in (links, thinned)]
    assert elsewhere[0] == elsewhere[1]
    assert thin_piles(links) is links


def test_three_places_at_which_a_receiver_hovers_have_folds():
    links = flown(3, 30.0, flights=3)
    place_m = np.array([[100.0, 100, 50], [300, 120, 50], [180, 400, 50]])[links.flight]
    links = synthetic_links(links.device_m, links.device, place_m, level_db=links.level_db, flight=links.flight,
                            time_s=links.time_s)
    folds = make_folds(links, 0)
    assert folds.count == 6 and np.bincount(folds.index).min() > 20
    assert len(np.unique(evidence_blocks(with_evidence(links, links.level_db)))) == 9  # three places, three devices


@pytest.fixture
def small_sample(monkeypatch):
    monkeypatch.setattr(evidence, "MAX_LINKS", 1000)
    monkeypatch.setattr(evidence, "SAMPLE_LINKS", 500)


@pytest.fixture
def links(open_ground):
    return prepare_links(open_ground.measured(open_ground.fly(0)), None)


def shares(index, rows=slice(None)):
    count = np.bincount(index[rows], minlength=index.max() + 1)
    return count / count.sum()


def test_few_links_are_all_used(links):
    assert thin_links(links, 0) is links
    assert evidence.MAX_LINKS > 106_455  # no data set that results were recorded of is thinned


def test_every_flight_device_receiver_and_time_keeps_its_share(links, small_sample):
    some = thin_links(links, 0)
    assert len(some) == 500 < len(links)
    for name in ("flight", "device", "receiver"):
        assert shares(getattr(some, name)) == pytest.approx(shares(getattr(links, name)), abs=0.01)
    quantiles = np.linspace(0, 1, 11)
    assert np.quantile(some.time_s, quantiles) == pytest.approx(np.quantile(links.time_s, quantiles),
                                                                abs=0.05 * np.ptp(links.time_s))
    assert np.isnan(some.level_db).mean() == pytest.approx(np.isnan(links.level_db).mean(), abs=0.03)
    assert some.notes[-1].startswith(f"of {len(links):,} links 500 are used")


def test_a_sample_is_drawn_by_the_seed_without_repetition(links, small_sample):
    numbered = links.with_columns(quality=np.arange(float(len(links))))
    first, again, other = (thin_links(numbered, seed).quality for seed in (0, 0, 1))
    assert (first == again).all() and (np.diff(first) > 0).all()
    assert not np.array_equal(first, other)


def test_no_position_in_time_is_preferred(links, small_sample):
    """Rationale: every k-th link would always be of the same part of a regular flight."""
    numbered = links.with_columns(quality=np.arange(float(len(links))))
    drawn = np.concatenate([thin_links(numbered, seed).quality for seed in range(200)]).astype(int)
    often = np.bincount(drawn, minlength=len(links)) / 200
    assert often.mean() == pytest.approx(500 / len(links))
    assert np.abs(often - often.mean()).max() < 0.25 and often.min() > 0


@pytest.mark.seconds
@pytest.mark.usefixtures("short_report")
def test_the_report_says_so_and_finds_what_all_links_show(open_ground, small_sample):
    world = open_ground.fly(2)
    world.gain_db[world.receiver == 1] += 5.0
    report = make_report(close_loop(open_ground.measured(world), base="log-distance"))
    assert [effect["name"] for effect in report["effects"]] == ["receiver_gain_offset"]
    assert any("links 500 are used" in note for note in report["notes"])
    assert report["heldout"]["n"] <= 500
