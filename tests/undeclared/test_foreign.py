"""Foreign worlds: both splits apart, what the answers say is in the levels, and nothing of them in the tables."""

from collections import Counter
from functools import cache

import numpy as np
import pytest

from tests.undeclared.foreign import cases, deck, store
from tests.undeclared.foreign.cases import families, names, split_of
from tests.undeclared.foreign.layouts import CITIES, SPLITS, city
from tests.undeclared.foreign.scenario import Scenario, blocked
from tests.undeclared.foreign.worlds import all_names, world

NAMES = names()
STORED = store.stored()
ATTITUDE = {"heading_deg", "pitch_deg", "roll_deg"}
foreign_case = cache(cases.foreign_case)


def with_family(*wanted):
    """Cases that hide one family alone, of those that are stored."""
    return pytest.mark.parametrize("name", [name for name in NAMES if families(name) in [(one,) for one in wanted]][:3])


def change_db(one):
    return np.nan_to_num(one.clean_level_db - one.plain_level_db)


def test_each_city_and_each_layout_is_in_one_split_or_both_alike():
    of_split = {split: [number for number in range(CITIES) if city(number).split == split] for split in SPLITS}
    assert not set(of_split["calibrate"]) & set(of_split["judge"])
    assert all(sorted(number % 8 for number in numbers) == list(range(8)) for numbers in of_split.values())
    assert set(names("calibrate")) | set(names("judge")) == set(NAMES)
    assert not set(names("calibrate")) & set(names("judge"))
    with pytest.raises(ValueError, match="'train' does not exist"):
        names("train")


def test_both_splits_hide_the_same_families():
    hands = {split: Counter(hand for name, hand in deck.dealt().items() if split_of(name) == split) for split in SPLITS}
    assert hands["calibrate"] == hands["judge"] == Counter(deck.hands())
    dealt = list(deck.dealt().values())
    outside = [hand for hand in dealt if set(hand) & set(deck.OUTSIDE)]
    assert len(dealt) == 240 and dealt.count(()) == 40
    assert 0.3 < len(outside) / (len(dealt) - dealt.count(())) < 0.36
    assert sorted(deck.dealt()) == sorted(f"{name}-c{case}" for name in all_names() for case in range(deck.CASES))


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_the_deck_is_dealt_as_stored(split):
    assert deck.deal(split) == {name: hand for name, hand in deck.dealt().items() if split_of(name) == split}


@pytest.mark.parametrize("name", NAMES[::61])
def test_a_campaign_is_possible_and_says_nothing_of_the_answer(name):
    one, oracle = foreign_case(name), foreign_case(name, hidden=False)
    table, config = one.measurements.table, one.scene.config
    assert set(table) <= {"time_s", "flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device",
                          "gain_db", "rssi_dbm", *ATTITUDE}
    assert list(table) == list(oracle.measurements.table)
    text = (one.scene.folder / "scene.toml").read_text() + one.measurements.devices.to_csv() + one.scene.folder.name
    assert name not in text and not any(family in text for family in deck.DRAWS)
    assert not config.devices and config.name == "city" and config.radio.frequency_hz == world(name[:9]).frequency_hz
    meshes = sorted(path.stem for path in (one.scene.folder / "meshes").iterdir())
    assert meshes == [*(f"b{number:03d}" for number in range(len(meshes) - 1)), "ground"]  # no gap in the numbers
    level_db, nuisance = one.measurements.level_db, one.answer["nuisance"]
    sent_db = nuisance["sent_dbm"] or 0.0
    assert np.nanmax(level_db) - sent_db <= 0 and np.nanmin(level_db) - sent_db > -260
    steps = level_db[np.isfinite(level_db)] / nuisance["step_db"]
    np.testing.assert_allclose(steps, np.round(steps), atol=0.06)
    assert len(level_db) > 1500 and np.isfinite(level_db).mean() > 0.4
    anchors = one.measurements.device_m[one.measurements.is_anchor]
    assert len(anchors) >= 3 and not one.scene.city.inside(np.vstack([anchors, one.measurements.receiver_m])).any()
    assert not oracle.answer["effects"] and oracle.size_db == 0 and nuisance == oracle.answer["nuisance"]
    np.testing.assert_array_equal(oracle.clean_level_db, oracle.plain_level_db)
    assert [each["name"] for each in one.answer["effects"] if not each["in_catalogue"]] == [
        family for family in families(name) if family in deck.OUTSIDE]
    assert 0.05 < one.size_db < 30 or {"lock_loss"} & set(families(name)) or not families(name)


@with_family("receiver_gain_offset", "device_gain_offset")
def test_an_offset_is_in_the_links_of_one_end_only(name):
    one = foreign_case(name)
    (effect,) = one.answer["effects"]
    end = "device" if "device" in effect else "receiver"
    its = (one.measurements.table[end] == effect[end]).to_numpy()
    assert np.abs(change_db(one)[~its]).max() == 0
    finite = its & np.isfinite(one.plain_level_db)
    np.testing.assert_allclose(change_db(one)[finite], effect["offset_db"], atol=1e-3)
    heard = np.isfinite(one.measurements.level_db)
    assert one.size_db == pytest.approx(np.sqrt(np.mean(change_db(one)[heard]**2)), rel=0.1)


@with_family("sector_antenna")
def test_a_sector_antenna_looks_where_the_answer_says(name):
    one = foreign_case(name)
    (effect,) = one.answer["effects"]
    device_m = one.measurements.device_m[int(effect["device"][1:]) - 1]
    offset_m = one.measurements.receiver_m - device_m
    turn = np.arctan2(offset_m[:, 0], offset_m[:, 1]) - np.radians(effect["azimuth_deg"])
    its = (one.measurements.table["device"] == effect["device"]).to_numpy() & np.isfinite(one.plain_level_db)
    its &= np.abs(offset_m[:, 2]) < 0.25 * np.hypot(*offset_m[:, :2].T)  # low: the column has lobes in elevation
    its[its] = one.scene.city.line_of_sight(device_m, one.measurements.receiver_m[its])
    if its.sum() < 30 or np.ptp(np.cos(turn[its])) < 0.5:
        pytest.skip("its receivers are all on one side")
    assert np.corrcoef(change_db(one)[its], np.cos(turn[its]))[0, 1] > 0.5


@with_family("foliage", "excess_attenuation", "shower", "mover", "body_shadowing")
def test_losses_are_losses(name):
    change = change_db(foreign_case(name))
    assert change.max() < 1e-6 and change.min() < -0.5


@with_family("interference", "duty_cycled_jammer", "noise_floor")
def test_added_power_only_adds(name):
    change = change_db(foreign_case(name))
    assert change.min() > -1e-6 and change.max() > 1


@with_family("missing_obstacle", "removed_obstacle", "device_position_error", "receiver_clock_offset")
def test_of_a_wrong_map_or_position_no_level_is_changed(name):
    one, oracle = foreign_case(name), foreign_case(name, hidden=False)
    (effect,) = one.answer["effects"]
    np.testing.assert_array_equal(one.clean_level_db, one.plain_level_db)
    if "centre_m" in effect:
        heights = [float(each.scene.city.height_at(*np.array([effect["centre_m"]]).T)[0]) for each in (one, oracle)]
        assert min(heights) < 1 < max(heights)
        assert (heights[0] < heights[1]) == (effect["name"] == "missing_obstacle")
    else:
        assert (not one.measurements.devices.equals(oracle.measurements.devices)) + (
            not np.array_equal(one.measurements.receiver_m, oracle.measurements.receiver_m)) == 1


@pytest.mark.parametrize("name", STORED[::16])
def test_paths_are_possible(name):
    at = Scenario.of(name)
    a_m, b_m = at.where.device_m[at.device], at.where.campaign.points_m[at.point]
    space_db = 20 * np.log10(299_792_458 / (4 * np.pi * at.where.frequency_hz * np.linalg.norm(a_m - b_m, axis=1)))
    assert np.mean(at.direct == ~blocked(at.standing, a_m, b_m)) > 0.99
    assert np.all(at.plain_db[at.direct] > space_db[at.direct] - 0.3) and np.all(at.plain_db < space_db + 12)
    assert np.bincount(at.paths.link).max() <= 8
    assert at.paths.bounces.max() <= at.where.settings.max_depth


def test_a_trace_of_another_draw_is_refused(monkeypatch):
    monkeypatch.setattr(store, "_positions", lambda where: np.zeros(3, dtype=np.int32))
    store.load.cache_clear()
    with pytest.raises(ValueError, match="earlier draw"):
        store.load(STORED[0])
