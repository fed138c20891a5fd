"""Foreign worlds: both splits apart, what the answers say is in the levels, and nothing of them in the tables."""

import json
from collections import Counter

import numpy as np
import pytest

from tests.undeclared.foreign import deck, store
from tests.undeclared.foreign.cases import families, foreign_case, names, split_of
from tests.undeclared.foreign.layouts import CITIES, SPLITS, city
from tests.undeclared.foreign.scenario import Scenario, blocked
from tests.undeclared.foreign.worlds import all_names, world

NAMES = names()
SOME = NAMES[::31]
STORED = store.stored()
ATTITUDE = {"heading_deg", "pitch_deg", "roll_deg"}


def column(one, name):
    return one.measurements.table[name].to_numpy()


def with_family(*wanted):
    """Cases that hide one family alone, of those that are stored."""
    return [name for name in NAMES if len(families(name)) == 1 and families(name)[0] in wanted][:3]


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
    cases = [hand for hand in deck.dealt().values()]
    outside = [hand for hand in cases if set(hand) & set(deck.OUTSIDE)]
    assert len(cases) == 240 and cases.count(()) == 40
    assert 0.3 < len(outside) / (len(cases) - cases.count(())) < 0.36
    assert sorted(deck.dealt()) == sorted(f"{name}-c{case}" for name in all_names() for case in range(deck.CASES))


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_the_deck_is_dealt_as_stored(split):
    assert deck.deal(split) == {name: hand for name, hand in deck.dealt().items() if split_of(name) == split}


@pytest.mark.parametrize("name", SOME)
def test_two_loads_are_equal_and_the_answer_is_json(name):
    first, again = foreign_case(name), foreign_case(name)
    assert again.measurements.table.equals(first.measurements.table)
    assert again.measurements.devices.equals(first.measurements.devices)
    assert again.scene.content_hash() == first.scene.content_hash()
    assert json.loads(json.dumps(again.answer)) == json.loads(json.dumps(first.answer))
    assert [each["name"] for each in first.answer["effects"] if not each["in_catalogue"]] == [
        family for family in families(name) if family in deck.OUTSIDE]


@pytest.mark.parametrize("name", SOME)
def test_table_and_scene_say_nothing_of_the_answer(name):
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


@pytest.mark.parametrize("name", SOME)
def test_levels_are_possible(name):
    one = foreign_case(name)
    level_db, nuisance = one.measurements.level_db, one.answer["nuisance"]
    sent_db = nuisance["sent_dbm"] or 0.0
    assert np.nanmax(level_db) - sent_db <= 0 and np.nanmin(level_db) - sent_db > -260
    steps = level_db[np.isfinite(level_db)] / nuisance["step_db"]
    np.testing.assert_allclose(steps, np.round(steps), atol=0.06)
    assert len(level_db) > 1500 and np.isfinite(level_db).mean() > 0.4
    assert not one.scene.city.inside(one.measurements.receiver_m).any()
    anchors = one.measurements.device_m[one.measurements.is_anchor]
    assert len(anchors) >= 3 and not one.scene.city.inside(anchors).any()
    assert one.clean_level_db.shape == one.plain_level_db.shape == level_db.shape


@pytest.mark.parametrize("name", SOME)
def test_the_oracle_is_the_same_campaign_with_nothing_hidden(name):
    one, oracle = foreign_case(name), foreign_case(name, hidden=False)
    assert not oracle.answer["effects"] and oracle.size_db == 0
    np.testing.assert_array_equal(oracle.clean_level_db, oracle.plain_level_db)
    kept = {key: value for key, value in one.answer["nuisance"].items()}
    assert kept == oracle.answer["nuisance"]
    if families(name):
        assert one.size_db > 0.05 or "lock_loss" in families(name)
        assert one.size_db < 30


@pytest.mark.parametrize("name", with_family("receiver_gain_offset", "device_gain_offset"))
def test_an_offset_is_in_the_links_of_one_end_only(name):
    one = foreign_case(name)
    (effect,) = one.answer["effects"]
    end = "device" if "device" in effect else "receiver"
    its = column(one, end) == effect[end]
    assert np.abs(change_db(one)[~its]).max() == 0
    finite = its & np.isfinite(one.plain_level_db)
    np.testing.assert_allclose(change_db(one)[finite], effect["offset_db"], atol=1e-3)
    heard = np.isfinite(one.measurements.level_db)
    assert one.size_db == pytest.approx(np.sqrt(np.mean(change_db(one)[heard]**2)), rel=0.1)


@pytest.mark.parametrize("name", with_family("sector_antenna"))
def test_a_sector_antenna_looks_where_the_answer_says(name):
    one = foreign_case(name)
    (effect,) = one.answer["effects"]
    device_m = one.measurements.device_m[int(effect["device"][1:]) - 1]
    offset_m = one.measurements.receiver_m - device_m
    turn = np.arctan2(offset_m[:, 0], offset_m[:, 1]) - np.radians(effect["azimuth_deg"])
    its = (column(one, "device") == effect["device"]) & np.isfinite(one.plain_level_db)
    its &= np.abs(offset_m[:, 2]) < 0.25 * np.hypot(*offset_m[:, :2].T)  # low: the column has lobes in elevation
    its[its] = one.scene.city.line_of_sight(device_m, one.measurements.receiver_m[its])
    if its.sum() < 30 or np.ptp(np.cos(turn[its])) < 0.5:
        pytest.skip("its receivers are all on one side")
    assert np.corrcoef(change_db(one)[its], np.cos(turn[its]))[0, 1] > 0.5


@pytest.mark.parametrize("name", with_family("foliage", "excess_attenuation", "shower", "mover", "body_shadowing"))
def test_losses_are_losses(name):
    change = change_db(foreign_case(name))
    assert change.max() < 1e-6 and change.min() < -0.5


@pytest.mark.parametrize("name", with_family("interference", "duty_cycled_jammer", "noise_floor"))
def test_added_power_only_adds(name):
    change = change_db(foreign_case(name))
    assert change.min() > -1e-6 and change.max() > 1


@pytest.mark.parametrize("name", with_family("missing_obstacle", "removed_obstacle"))
def test_the_map_is_wrong_by_one_building(name):
    one, oracle = foreign_case(name), foreign_case(name, hidden=False)
    (effect,) = one.answer["effects"]
    middle = np.array([effect["centre_m"]])
    heights = [float(each.scene.city.height_at(*middle.T)[0]) for each in (one, oracle)]
    assert (heights[0] < 1 < heights[1]) if effect["name"] == "missing_obstacle" else (heights[1] < 1 < heights[0])
    np.testing.assert_array_equal(one.clean_level_db, one.plain_level_db)


@pytest.mark.parametrize("name", with_family("device_position_error", "receiver_clock_offset"))
def test_a_position_is_wrong_and_no_level(name):
    one, oracle = foreign_case(name), foreign_case(name, hidden=False)
    np.testing.assert_array_equal(one.clean_level_db, one.plain_level_db)
    moved = (not one.measurements.devices.equals(oracle.measurements.devices)) + (
        not np.array_equal(one.measurements.receiver_m, oracle.measurements.receiver_m))
    assert moved == 1


@pytest.mark.parametrize("name", STORED[::12])
def test_paths_are_possible(name):
    at = Scenario.of(name)
    way_m = at.where.device_m[at.device] - at.where.campaign.points_m[at.point]
    space_db = 20 * np.log10(299_792_458 / (4 * np.pi * at.where.frequency_hz * np.linalg.norm(way_m, axis=1)))
    direct = np.zeros(at.links, dtype=bool)
    direct[at.paths.link[at.paths.bounces == 0]] = True
    seen = ~blocked(at.standing, at.where.device_m[at.device], at.where.campaign.points_m[at.point])
    assert np.mean(direct == seen) > 0.99
    assert np.all(at.plain_db[direct] > space_db[direct] - 0.3) and np.all(at.plain_db < space_db + 12)
    assert np.bincount(at.paths.link).max() <= 8
    assert at.paths.bounces.max() <= at.where.settings.max_depth


def test_a_trace_of_another_draw_is_refused(monkeypatch):
    monkeypatch.setattr(store, "_positions", lambda where: np.zeros(3, dtype=np.int32))
    store.load.cache_clear()
    with pytest.raises(ValueError, match="earlier draw"):
        store.load(STORED[0])


def test_the_folder_stays_small():
    assert sum(path.stat().st_size for path in store.FOLDER.iterdir()) < 6_500_000
