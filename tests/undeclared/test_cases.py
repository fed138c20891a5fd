"""The stored cases and campaigns over open ground are what they say, complete, and tell nothing of their answers."""

import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.undeclared import cases, tables
from tests.undeclared.cases import FAMILIES, OUTSIDE, SEEDS
from tests.undeclared.cities import CITIES, RADIO, buildings, declared_scene
from tests.undeclared.families import world_of
from tests.undeclared.foreign.cases import foreign_case
from tests.undeclared.open_ground import CASES, KNOWN, WRITTEN, open_case
from tests.undeclared.open_ground import OUTSIDE as OPEN_OUTSIDE
from tests.undeclared.shapes import distance_m
from tests.undeclared.worlds import GROUPS, world

FOLDER = Path(__file__).parent
KEYS = [(family, seed) for family in FAMILIES + OUTSIDE for seed in (0, 3) if cases.stored(family, seed)]
COLUMNS = ["time_s", "flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device", "gain_db",
           "heading_deg", "pitch_deg", "roll_deg"]
case = cache(cases.case)


def of(*families):
    return pytest.mark.parametrize("family, seed", [key for key in KEYS if key[0] in families])


def change_db(one):
    """(n,) what the effects do to the levels [dB]; 0 where there is no path in one of the two worlds."""
    return np.nan_to_num(one.clean_gain_db - one.plain_gain_db)


def column(one, name):
    return one.measurements.table[name].to_numpy()


DIGESTS = {
    "nothing 0": "4b8d9e89de03119f",
    "receiver_gain_offset 0": "88a9e99d1c018be1",
    "receiver_drift 0": "445d80116dfb88b1",
    "receiver_saturation 0": "53c1603c61b8533d",
    "excess_attenuation 0": "331f63b381268baf",
    "device_drift 0": "e97d3cc23e71e6a5",
    "receiver_clock_offset 0": "9c09723230173d5b",
    "foliage 0": "319c44754067ab3a",
    "antenna_pattern 0": "78d5ebf4844857f2",
    "device_position_error 0": "766570170640eaf3",
    "open 0": "93bf8d8b6edc008b",
    "open 14": "5055e71ecc8974a7",
    "open 28": "444062a23b98d17b",
    "foreign city00-w0-c0": "b46d6a3f5d41461b",
    "foreign city06-w0-c1": "1b509aa8b4d331c7",
    "foreign city13-w0-c2": "2d4d072390be0d64",
    "foreign city14-w1-c0": "7fdc8f49ffcb8696",
    "foreign city05-w2-c1": "4737afc1a3c36e6e",
}


def drawn(name):
    family, key = name.split()
    return {"open": lambda: open_case(int(key)), "foreign": lambda: foreign_case(key)}.get(
        family, lambda: case(family, int(key)))()


def digest(one):
    """Of the tables of measurements and devices, and the answer, to the third decimal."""
    csv = [table.to_csv(index=False, float_format="%.3f") for table in (one.measurements.table, one.measurements.devices)]
    answer = json.loads(json.dumps(one.answer, default=float), parse_float=lambda text: round(float(text), 3))
    return hashlib.sha256("".join([*csv, json.dumps(answer)]).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", DIGESTS)
def test_what_results_were_published_of_is_drawn_again(name):
    assert digest(drawn(name)) == DIGESTS[name]


@pytest.mark.parametrize("family, seed", KEYS)
def test_it_has_all_its_links_with_blanks_and_noise_as_meant_and_says_nothing_of_the_answer(family, seed):
    one, where = case(family, seed), world_of(family, seed)
    table, level_db, limit_db = one.measurements.table, one.measurements.level_db, one.scene.config.gain_limit_db
    assert list(table.columns) == COLUMNS
    assert len(table) == len(one.clean_gain_db) == len(one.plain_gain_db) == 6 * 60 * 3 * 10
    assert table.groupby(["flight", "receiver", "time_s"]).size().eq(10).all()
    assert table.drop(columns="gain_db").notna().all(axis=None)
    assert 0.02 < np.isnan(level_db).mean() < 0.4
    assert np.nanmin(level_db) >= limit_db and np.nanmax(level_db) < 0
    noise_db = (level_db - one.clean_gain_db)[np.isfinite(level_db) & (one.clean_gain_db > limit_db + 12)]
    assert abs(noise_db.mean()) < 0.06 and 0.95 < noise_db.std() < 1.06
    assert one.scene is declared_scene(where.city)
    assert one.scene.config.devices == [] and one.scene.config.uavs == []
    assert set(one.measurements.devices.columns) == {"device", "x_m", "y_m", "z_m", "role"}
    assert np.isnan(one.measurements.device_m[~one.measurements.is_anchor, :2]).all()
    assert set(one.answer["device_m"]) == set(one.measurements.devices["device"][~one.measurements.is_anchor])


def law_db(effect, one):
    """What a fault changes in its own links [dB]; of saturation nothing is said."""
    time_s = column(one, "time_s")
    if "offset_db" in effect:
        return np.full(len(time_s), effect["offset_db"])
    if effect.get("kind") == "step":
        return np.where(time_s >= effect["time_s"], effect["step_db"], 0.0)
    if effect.get("kind") == "ageing":
        return effect["last_db"] * time_s / time_s.max()
    return effect["final_db"] * -np.expm1(-time_s / effect["time_constant_s"])


@of("receiver_gain_offset", "receiver_drift", "receiver_saturation", "device_drift", "antenna_pattern",
    "device_position_error", "nothing")
def test_an_effect_is_in_the_links_of_one_end_only(family, seed):
    one = case(family, seed)
    change, path = change_db(one), np.isfinite(one.plain_gain_db)
    its = np.zeros(len(change), dtype=bool)
    for effect in one.answer["effects"]:
        end = "device" if "device" in effect else "receiver"
        its = column(one, end) == effect[end]
        if family == "receiver_saturation":
            strong = one.plain_gain_db > effect["saturation_db"]
            assert change.max() <= 0 and 0.05 < strong[its].mean() < 0.3 and change[its & strong].max() < -1
            assert one.clean_gain_db[its & path].max() <= effect["saturation_db"]
        elif family in ("antenna_pattern", "device_position_error"):
            assert np.sqrt(np.mean(change[its] ** 2)) > 2
        else:
            np.testing.assert_allclose(change[its & path], law_db(effect, one)[its & path], atol=0.02)
    assert np.abs(change[~its]).max() == 0 and its.any() == (family != "nothing")


@of("receiver_clock_offset")
def test_places_are_those_of_another_time(family, seed):
    one, where = case(family, seed), world_of(family, seed)
    (effect,) = one.answer["effects"]
    np.testing.assert_array_equal(one.clean_gain_db, one.plain_gain_db)
    given_m, late, slots = one.measurements.receiver_m[::10], effect["late_s"], np.arange(60.0)
    its = column(one, "receiver")[::10] == effect["receiver"]
    np.testing.assert_array_equal(given_m[~its], where.points_m[~its])
    # A place that is so many seconds late comes beside the level of so much later.
    inside = (slots - late >= 0) & (slots - late <= 59)
    for written_m, true_m in zip(given_m[its].reshape(6, 60, 3), where.points_m[its].reshape(6, 60, 3)):
        for axis in range(3):
            np.testing.assert_allclose(written_m[inside, axis],
                                       np.interp(slots[inside] - late, slots, true_m[:, axis]), atol=0.011)


@of("foliage", "missing_obstacle", "removed_obstacle", "pairs", "excess_attenuation", *OUTSIDE)
def test_effects_without_an_end_change_some_links(family, seed):
    one = case(family, seed)
    change = change_db(one)
    assert len(one.answer["effects"]) == (2 if family == "pairs" else 1)
    assert np.mean(np.abs(change) > 1.5) > 0.01
    if family == "foliage":
        assert change.max() <= 0 and -one.answer["effects"][0]["most_db"] <= change.min() < -10
    if family.endswith("obstacle"):
        risen = change if family == "removed_obstacle" else -change
        assert np.mean(risen > 6) > max(0.01, 1.5 * np.mean(risen < -6))
        assert np.mean(np.abs(change) < 2) > 0.5  # most links know nothing of it


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("seed", SEEDS)
def test_worlds_are_possible(group, seed):
    where = world(group, seed)
    assert not declared_scene(where.city).city.inside(np.concatenate([where.device_m, where.points_m])).any()
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
    assert sum(path.stat().st_size for path in FOLDER.rglob("*.*") if "__pycache__" not in path.parts) < 8_500_000


@pytest.mark.parametrize("number", range(0, CASES, 7))
def test_a_campaign_over_open_ground_can_be_measured(number):
    measured = open_case(number).measurements
    table, level_db = measured.table, measured.level_db
    assert table.notna().drop(columns="gain_db").all(axis=None) and measured.is_anchor.all()
    assert 3 <= table["flight"].nunique() <= 8 and 4 <= table["device"].nunique() <= 8
    assert -220 < np.nanmin(level_db) < np.nanmax(level_db) < 0 and np.isnan(level_db).mean() < 0.25


def test_open_ground_has_something_of_every_kind():
    effects = [open_case(number).answer["effects"] for number in range(CASES)]
    names = [each[0]["name"] for each in effects if each]
    assert len(names) == 0.8 * CASES and {*KNOWN, *WRITTEN, *OPEN_OUTSIDE} == set(names)
    assert sum(name in OPEN_OUTSIDE for name in names) == CASES / 5
