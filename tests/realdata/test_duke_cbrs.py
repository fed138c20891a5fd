"""Sectors of an LTE network with undeclared antennas: their directions, on ground that is held out."""

import pytest

from radiotwin import close_loop, make_report
from studies.closeloop_real import AZIMUTHS_DEG, azimuth_errors_deg, permuted, turned_rmse_db

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def loop(duke):
    return close_loop(duke, base="log-distance", hold_out="block")


NOT_NAMED = pytest.mark.xfail(strict=True, reason="without the map an emitter is as probable as antennas: docs/real-data.md")


@NOT_NAMED
def test_antennas_are_named_first_and_look_where_they_do(loop):
    off_deg = azimuth_errors_deg(make_report(loop))
    assert loop.after.whole.effects[0].name == "antenna_pattern"
    assert set(off_deg) == set(AZIMUTHS_DEG) and max(map(abs, off_deg.values())) <= 20


@NOT_NAMED
def test_named_effects_take_a_quarter_of_the_error(loop):
    assert loop.explained.rmse_db() <= 9.3  # version 0.1 had 8.8, with a mast moved by 109 m, which is right


def test_what_is_learnt_takes_half_of_the_error(loop):
    assert 11.0 < loop.before.rmse_db() < 13.5 and loop.after.rmse_db() <= 6.4


def test_with_boresights_turned_round_the_gain_is_gone(loop):
    assert turned_rmse_db(loop) > loop.before.rmse_db() - 1.0


def test_of_permuted_levels_only_what_the_permutation_leaves_is_named(duke):
    """Each sector keeps its mean level, and the sectors differ by ten decibels; nothing else is left."""
    loop = close_loop(permuted(duke, 0), base="log-distance", hold_out="block")
    assert [each.name for each in loop.after.whole.effects] == ["device_gain_offset"]
