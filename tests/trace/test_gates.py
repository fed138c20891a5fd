"""Checks that every traced map must pass."""

import numpy as np
import pytest

from radiotwin.errors import RunFailed
from radiotwin.trace.run import check_gains, free_space_gain_db

FREQUENCY_HZ = 2.4e9


@pytest.fixture
def links():
    """Half of 1000 links with LoS, as in a street: free space and 0 to 2 dB; the others 20 dB and more below."""
    generator = np.random.default_rng(0)
    distance_m = generator.uniform(50, 900, 1000)
    los = np.arange(1000) < 500
    gain_db = free_space_gain_db(distance_m, FREQUENCY_HZ) + np.where(
        los, generator.uniform(0, 2, 1000), generator.uniform(-60, -20, 1000))
    gain_db[-100:] = np.nan
    return gain_db, los, distance_m


def check(gain_db, los, distance_m, solver="paths", combining="power"):
    return check_gains(gain_db, los, distance_m, FREQUENCY_HZ, solver, combining)


def test_free_space_at_one_kilometre():
    """32.4 + 20 log10(f / MHz) + 20 log10(d / km) dB (ITU-R P.525)."""
    assert free_space_gain_db(1000.0, 2.4e9) == pytest.approx(-(32.4 + 20 * np.log10(2400)), abs=0.06)


def test_sound_map_passes_with_its_figures(links):
    figures = check(*links)
    assert figures["links"] == 1000 and figures["links_with_path"] == 900 and figures["links_los"] == 500
    assert 0.8 < figures["los_excess_median_db"] < 1.2


def test_gain_above_zero_fails(links):
    links[0][700] = 0.1
    with pytest.raises(RunFailed, match="0.1 dB: more power"):
        check(*links)


def test_no_path_at_all_fails(links):
    with pytest.raises(RunFailed, match="none of 1000 links has a path"):
        check(np.full(1000, np.nan), *links[1:])


@pytest.mark.parametrize("shift_db", [-2.0, 2.5])
def test_los_links_far_from_free_space_fail(links, shift_db):
    with pytest.raises(RunFailed, match="from free space in the median"):
        check(links[0] + shift_db, *links[1:])


@pytest.mark.parametrize(("count", "passes"), [(3, True), (4, False)])
def test_tracer_and_map_may_disagree_on_a_few_links(links, count, passes):
    links[0][:count] = np.nan
    if passes:
        assert check(*links)["los_below_free_space_share"] == pytest.approx(count / 500)
    else:
        with pytest.raises(RunFailed, match="do not see the same city"):
            check(*links)


def test_fields_may_cancel(links):
    links[0][:50] -= 30
    check(*links, combining="coherent")
    with pytest.raises(RunFailed):
        check(*links)


def test_without_los_there_is_nothing_to_compare(links):
    assert "los_excess_median_db" not in check(links[0], np.zeros(1000, dtype=bool), links[2])
