"""Sectors of an LTE network whose antennas nobody declared: which way they look, on ground that is held out."""

import numpy as np
import pytest

from radiotwin import close_loop, make_report
from radiotwin.closeloop.search import rmse_db
from studies.closeloop_internals import turned_rmse_db
from studies.closeloop_real import AZIMUTHS_DEG, azimuth_errors_deg, permuted


@pytest.fixture(scope="module")
def loop(duke):
    return close_loop(duke, None, "log-distance", 0, lambda text: None, "block")


def everywhere(loop) -> np.ndarray:
    return np.ones(len(loop.records), dtype=bool)


def test_antennas_are_named_first_and_look_where_they_do(loop):
    off_deg = azimuth_errors_deg(make_report(loop))
    assert loop.after.whole.parts[0].effect.name == "antenna_pattern"
    assert set(off_deg) == set(AZIMUTHS_DEG) and max(map(abs, off_deg.values())) <= 20


def test_named_effects_take_a_quarter_of_the_error_and_interpolation_more_of_the_rest(loop):
    rows = everywhere(loop)
    assert 11.0 < rmse_db(loop.before, rows) < 13.5
    assert rmse_db(loop.search.explained, rows) <= 8.9
    assert rmse_db(loop.after, rows) <= 6.4


def test_with_boresights_turned_round_the_gain_is_gone(loop):
    assert turned_rmse_db(loop) > rmse_db(loop.before, everywhere(loop)) - 1.0


def test_of_permuted_levels_only_what_the_permutation_leaves_is_named(duke):
    """Each sector keeps its mean level, and the sectors differ by ten decibels; nothing else is left."""
    loop = close_loop(permuted(duke, 0), None, "log-distance", 0, lambda text: None, "block")
    assert [part.effect.name for part in loop.after.whole.parts] == ["device_gain_offset"]
