"""Campaigns over open ground: repeatable, whole, and of every kind."""

import numpy as np
import pandas as pd
import pytest

from tests.undeclared.open_ground import CASES, KNOWN, OUTSIDE, WRITTEN, open_case


def hidden(number):
    effects = open_case(number).answer["effects"]
    return effects[0]["name"] if effects else None


def test_a_number_gives_the_same_campaign_twice_and_another_gives_another():
    one, again, other = (open_case(number).measurements.table for number in (3, 3, 4))
    pd.testing.assert_frame_equal(one, again)
    assert len(one) != len(other)


@pytest.mark.parametrize("number", range(0, CASES, 7))
def test_it_is_a_campaign_that_can_be_measured(number):
    measured = open_case(number).measurements
    table, level_db = measured.table, measured.level_db
    assert table.notna().drop(columns="gain_db").all(axis=None) and measured.is_anchor.all()
    assert 3 <= table["flight"].nunique() <= 8 and 4 <= table["device"].nunique() <= 8
    assert -220 < np.nanmin(level_db) < np.nanmax(level_db) < 0 and np.isnan(level_db).mean() < 0.25


def test_there_is_something_of_every_kind():
    names = [hidden(number) for number in range(CASES)]
    assert names.count(None) == CASES / 5
    assert {*KNOWN, *WRITTEN, *OUTSIDE} == set(names) - {None}
    assert sum(name in OUTSIDE for name in names) == CASES / 5
