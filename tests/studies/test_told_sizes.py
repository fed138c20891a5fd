"""Effects that are put in again change what they say, and are counted."""

import numpy as np
import pandas as pd
import pytest

from studies import told_sizes
from tests.undeclared.open_ground import open_case

MEASURED = open_case(10).measurements


def hidden(family, size=6.0, seed=0):
    return told_sizes.HIDE[family](MEASURED, size, np.random.default_rng(seed))


def change_db(family, **given):
    return (hidden(family, **given).table["gain_db"] - MEASURED.table["gain_db"]).to_numpy()


@pytest.mark.parametrize(("family", "columns"), [
    ("receiver_gain_offset", ["receiver"]), ("device_gain_offset", ["device"]), ("faulty_flight", ["receiver", "flight"])])
def test_a_constant_is_that_of_one_member(family, columns):
    changed = np.abs(np.nan_to_num(change_db(family))) > 0
    members = MEASURED.table.loc[changed, columns].drop_duplicates()
    assert len(members) == 1
    of_it = (MEASURED.table[columns] == members.iloc[0]).all(axis=1) & MEASURED.table["gain_db"].notna()
    np.testing.assert_allclose(np.abs(change_db(family)[of_it]), 6.0)


def test_an_episode_takes_a_tenth_of_a_receivers_time_and_a_faulty_flight_is_between_others():
    changed = np.nan_to_num(change_db("episode")) < 0
    receiver = MEASURED.table.loc[changed, "receiver"].unique()
    assert len(receiver) == 1
    assert changed.sum() == pytest.approx(0.1 * (MEASURED.table["receiver"] == receiver[0]).sum(), rel=0.35)
    for seed in range(5):
        row = MEASURED.table[np.nan_to_num(change_db("faulty_flight", seed=seed)) < 0].iloc[0]
        start_s = MEASURED.table[MEASURED.table["receiver"] == row["receiver"]].groupby("flight")["time_s"].min()
        assert start_s.min() < start_s[row["flight"]] < start_s.max()


def test_a_drift_grows_to_its_size_and_a_sector_weakens_what_is_off_its_middle():
    drift_db = np.nan_to_num(change_db("device_drift"))
    assert drift_db.min() == 0 and drift_db.max() == pytest.approx(6.0, abs=0.5)
    sector_db = np.nan_to_num(change_db("antenna_pattern"))
    assert sector_db.min() >= -6.0 - 1e-9 and np.count_nonzero(sector_db < -0.1) > 10


def test_one_anchor_is_moved_and_levels_stay():
    changed = hidden("device_position_error", size=30.0)
    moved_m = changed.devices["y_m"].to_numpy() - MEASURED.devices["y_m"].to_numpy()
    assert sorted(moved_m)[-1] == 30.0 and np.count_nonzero(moved_m) == 1
    pd.testing.assert_frame_equal(changed.table, MEASURED.table)


def test_a_building_hides_lines_that_pass_it_below_its_roof():
    behind = np.nan_to_num(change_db("missing_obstacle")) < 0
    assert told_sizes.MIN_ROWS / 2 < behind.sum() < 0.6 * len(behind)
    a_m, b_m = told_sizes._devices_m(MEASURED)[behind], told_sizes._receivers_m(MEASURED)[behind]
    shares = np.linspace(0, 1, 400)[:, None, None]
    low = ((a_m + shares * (b_m - a_m))[:, :, 2] < told_sizes.HIGH_M).any(axis=0)
    assert low.all()


def test_counts_are_by_family_and_place():
    rows = pd.DataFrame([{"name": "open:0", "named": [], "again": [["episode", 3.0, 1.0, []],
                                                                   ["episode", 3.0, 1.5, ["episode", "foliage"]]]},
                         {"name": "city02-w1-c3", "named": ["foliage"], "again": [["episode", 4.0, 1.0, ["foliage"]]]}])
    table = told_sizes.sizes_table(rows)
    assert "Over open ground" in table and "In cities whose maps are wrong" in table
    assert "| `episode` | 3.000 | 0 of 1 | 1 of 1 | 1 |" in table and "| `episode` | 4.000 | 0 of 1 | 0 of 0 | 0 |" in table
