"""Samples of very many links."""


import numpy as np
import pytest

from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.links import evidence, prepare_links
from radiotwin.links.evidence import thin_links


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
