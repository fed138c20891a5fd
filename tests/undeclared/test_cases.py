"""The stored cases are what they say: complete, repeatable, their effects visible, and their answers kept apart."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.undeclared import cases, tables
from tests.undeclared.cases import FAMILIES, OUTSIDE, SEEDS
from tests.undeclared.cities import CITIES, RADIO, buildings, declared_scene
from tests.undeclared.families import world_of
from tests.undeclared.shapes import distance_m
from tests.undeclared.worlds import GROUPS, world

FOLDER = Path(__file__).parent
ALL = [(family, seed) for family in FAMILIES + OUTSIDE for seed in SEEDS]
KEYS = [key for key in ALL if cases.stored(*key)]
COLUMNS = ["time_s", "flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device", "gain_db",
           "heading_deg", "pitch_deg", "roll_deg"]
case = cache(cases.case)
every_case = pytest.mark.parametrize("family, seed", KEYS)


def of(*families):
    return pytest.mark.parametrize("family, seed", [key for key in KEYS if key[0] in families])


def change_db(one):
    """(n,) what the effects do to the levels [dB]; 0 where there is no path in one of the two worlds."""
    return np.nan_to_num(one.clean_gain_db - one.plain_gain_db)


def column(one, name):
    return one.measurements.table[name].to_numpy()


def test_some_case_of_every_kind_of_table_is_stored():
    assert {"nothing", "receiver_drift", "foliage", "antenna_pattern", "missing_obstacle"} <= {name for name, _ in KEYS}


@every_case
def test_has_all_its_links_with_blanks_and_noise_as_meant(family, seed):
    one = case(family, seed)
    table, level_db, limit_db = one.measurements.table, one.measurements.level_db, one.scene.config.gain_limit_db
    assert list(table.columns) == COLUMNS
    assert len(table) == len(one.clean_gain_db) == len(one.plain_gain_db) == 6 * 60 * 3 * 10
    assert table.groupby(["flight", "receiver", "time_s"]).size().eq(10).all()
    assert one.measurements.is_anchor.sum() == 6 and len(one.measurements.devices) == 10
    assert table.drop(columns="gain_db").notna().all(axis=None)
    assert 0.02 < np.isnan(level_db).mean() < 0.4
    assert np.nanmin(level_db) >= limit_db and np.nanmax(level_db) < 0
    assert np.all(level_db[np.isfinite(level_db)] % 0.25 == 0)
    noise_db = (level_db - one.clean_gain_db)[np.isfinite(level_db) & (one.clean_gain_db > limit_db + 12)]
    assert abs(noise_db.mean()) < 0.06
    assert 0.95 < noise_db.std() < 1.06


@every_case
def test_says_nothing_of_the_answer(family, seed):
    one, where = case(family, seed), world_of(family, seed)
    assert one.scene is declared_scene(where.city)
    assert one.scene.config.devices == [] and one.scene.config.uavs == []
    assert set(one.measurements.devices.columns) == {"device", "x_m", "y_m", "z_m", "role"}
    assert np.isnan(one.measurements.device_m[~one.measurements.is_anchor, :2]).all()
    assert set(one.answer["device_m"]) == set(one.measurements.devices["device"][~one.measurements.is_anchor])
    for effect in one.answer["effects"]:
        if effect["name"] == "device_position_error":
            row = where.names.index(effect["device"])
            assert one.measurements.device_m[row].tolist() == effect["declared_m"] != effect["true_m"]
            assert 20 <= np.hypot(*np.subtract(effect["declared_m"], effect["true_m"])[:2]) <= 60.2


@of("nothing")
def test_nothing_hides_nothing(family, seed):
    assert case(family, seed).answer["effects"] == []
    np.testing.assert_array_equal(case(family, seed).clean_gain_db, case(family, seed).plain_gain_db)


@of("receiver_gain_offset", "receiver_drift", "receiver_saturation")
def test_a_receivers_fault_is_in_its_links_only(family, seed):
    one = case(family, seed)
    (effect,), change = one.answer["effects"], change_db(one)
    its = column(one, "receiver") == effect["receiver"]
    path = np.isfinite(one.plain_gain_db)
    assert np.abs(change[~its]).max() == 0
    if family == "receiver_gain_offset":
        np.testing.assert_allclose(change[its & path], effect["offset_db"], atol=1e-9)
    elif family == "receiver_saturation":
        strong = one.plain_gain_db > effect["saturation_db"]
        assert change.max() <= 0 and 0.05 < strong[its].mean() < 0.3 and change[its & strong].max() < -1
        assert one.clean_gain_db[its & path].max() <= effect["saturation_db"]
    elif effect["kind"] == "step":
        after = column(one, "time_s") >= effect["time_s"]
        assert np.abs(change[its & ~after]).max() == 0
        np.testing.assert_allclose(change[its & after & path], effect["step_db"], atol=1e-9)
    else:
        law = effect["final_db"] * -np.expm1(-column(one, "time_s") / effect["time_constant_s"])
        np.testing.assert_allclose(change[its & path], law[its & path], atol=0.02)


@of("device_drift")
def test_a_devices_power_changes_in_time_in_its_links_only(family, seed):
    one = case(family, seed)
    (effect,), change, time_s = one.answer["effects"], change_db(one), column(one, "time_s")
    its = column(one, "device") == effect["device"]
    path = np.isfinite(one.plain_gain_db)
    assert np.abs(change[~its]).max() == 0 and effect["device"] not in one.answer["device_m"]
    if effect["kind"] == "step":
        law = np.where(time_s >= effect["time_s"], effect["step_db"], 0.0)
    else:
        law = effect["last_db"] * time_s / time_s.max()
    np.testing.assert_allclose(change[its & path], law[its & path], atol=1e-9)
    assert np.ptp(law[its]) > 4


@of("receiver_clock_offset")
def test_places_are_those_of_another_time(family, seed):
    one, where = case(family, seed), world_of(family, seed)
    (effect,) = one.answer["effects"]
    np.testing.assert_array_equal(one.clean_gain_db, one.plain_gain_db)
    given_m = one.measurements.receiver_m[::10]
    its = column(one, "receiver")[::10] == effect["receiver"]
    np.testing.assert_array_equal(given_m[~its], where.points_m[~its])
    away_m = np.linalg.norm(given_m - where.points_m, axis=1)[its]
    assert np.all(away_m < 12.5 * abs(effect["late_s"]) + 0.1) and np.median(away_m) > 6 * abs(effect["late_s"])
    # A place that is so many seconds late comes beside the level of so much later.
    late = effect["late_s"]
    tracks = zip(given_m[its].reshape(6, 60, 3), where.points_m[its].reshape(6, 60, 3))
    for written_m, true_m in tracks:
        slots = np.arange(60.0)
        inside = (slots - late >= 0) & (slots - late <= 59)
        for axis in range(3):
            np.testing.assert_allclose(written_m[inside, axis],
                                       np.interp(slots[inside] - late, slots, true_m[:, axis]), atol=0.011)


@of("antenna_pattern", "device_position_error")
def test_a_devices_or_receivers_antenna_is_in_its_links_only(family, seed):
    one = case(family, seed)
    (effect,), change = one.answer["effects"], change_db(one)
    end = "device" if "device" in effect else "receiver"
    its = column(one, end) == effect[end]
    assert np.abs(change[~its]).max() == 0
    assert np.sqrt(np.mean(change[its] ** 2)) > 2


@of("antenna_pattern")
def test_a_sector_antenna_looks_where_the_answer_says(family, seed):
    one = case(family, seed)
    (effect,), change = one.answer["effects"], change_db(one)
    if effect["kind"] != "sector":
        pytest.skip("a dipole")
    device_m = one.measurements.device_m[one.measurements.device_index]
    offset_m = one.measurements.receiver_m - device_m
    bearing_deg = np.degrees(np.arctan2(offset_m[:, 0], offset_m[:, 1]))
    off_deg = np.abs((bearing_deg - effect["azimuth_deg"] + 180) % 360 - 180)
    its = (column(one, "device") == effect["device"]) & (change != 0)
    assert np.median(change[its & (off_deg < 30)]) > np.median(change[its & (off_deg > 90)]) + 2


@of("foliage")
def test_groves_take_some_power_from_some_links(family, seed):
    change, (effect,) = change_db(case(family, seed)), case(family, seed).answer["effects"]
    assert change.max() <= 0 and -effect["most_db"] <= change.min() < -10
    assert 0.02 < np.mean(change < -3) < 0.5


@of("missing_obstacle", "removed_obstacle")
def test_an_obstacle_changes_the_links_in_its_shadow(family, seed):
    one = case(family, seed)
    change = change_db(one)
    sign = -1 if family == "missing_obstacle" else 1
    assert np.mean(sign * change > 6) > 0.01
    assert np.mean(sign * change > 6) > 1.5 * np.mean(sign * change < -6)
    assert np.mean(np.abs(change) < 2) > 0.5  # most links know nothing of it


@of("pairs", "excess_attenuation", *OUTSIDE)
def test_other_effects_are_there(family, seed):
    one = case(family, seed)
    assert len(one.answer["effects"]) == (2 if family == "pairs" else 1)
    assert np.mean(np.abs(change_db(one)) > 1.5) > 0.02


@pytest.mark.parametrize("family, seed", [("antenna_pattern", 0), ("foliage", 0), ("agc_hysteresis", 0)])
def test_two_loads_are_equal(family, seed):
    first = case(family, seed)
    world.cache_clear()
    again = cases.case(family, seed)
    assert again.measurements.table.equals(first.measurements.table)
    assert again.measurements.devices.equals(first.measurements.devices)
    assert again.answer == first.answer
    np.testing.assert_array_equal(again.clean_gain_db, first.clean_gain_db)


def test_cases_differ_and_noise_is_drawn_for_each():
    same_world, other_world = case("receiver_drift", 0), case("foliage", 0)
    nothing = case("nothing", 0).measurements
    assert nothing.table["receiver_x_m"].equals(same_world.measurements.table["receiver_x_m"])
    assert not nothing.table["receiver_x_m"].equals(other_world.measurements.table["receiver_x_m"])
    others = column(same_world, "receiver") != same_world.answer["effects"][0]["receiver"]
    assert np.nanmean(nothing.level_db[others] != same_world.measurements.level_db[others]) > 0.5



@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("seed", SEEDS)
def test_worlds_are_possible(group, seed):
    where = world(group, seed)
    city = declared_scene(where.city).city
    assert not city.inside(np.concatenate([where.device_m, where.points_m])).any()
    assert 48 < where.points_m[:, 2].min() and where.points_m[:, 2].max() < 80
    step_m = np.linalg.norm(np.diff(where.points_m.reshape(18, 60, 3), axis=1), axis=-1)
    assert 7.5 < step_m.min() and step_m.max() < 12.5
    assert np.all(np.diff(where.time_s.reshape(6, 3, 60)[:, 0].ravel()) > 0)
    for tower in where.towers:
        assert distance_m(where.points_m[:, :2], tower.footprint_m).min() > 5
        assert distance_m(where.device_m[:, :2], tower.footprint_m).min() > 8


@pytest.mark.parametrize("city", CITIES)
def test_the_declared_folder_is_the_generated_city(city):
    heights_m = [building.height_m for building in buildings(city)]
    middles = [building.footprint_m[:3].mean(axis=0) for building in buildings(city)]
    np.testing.assert_allclose(declared_scene(city).city.height_at(*np.array(middles).T), heights_m, atol=0.01)
    assert declared_scene(city).config.radio == RADIO[city]


def test_a_table_of_another_draw_is_refused():
    with pytest.raises(ValueError, match="earlier draw"):
        tables.load(tables.world_key("receivers", 0), world("receivers", 1))



def test_the_folder_stays_small():
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")
               if not {"__pycache__", "foreign"} & set(path.parts)) < 2_000_000
