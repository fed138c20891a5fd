"""Cities and wrong maps of the study `maps`, what a twin is given of them, and its table."""

import numpy as np
import pytest
from shapely import distance, points, union_all

from studies import wrong_maps
from studies.tables import read_frame
from studies.wrong_cities import LOWEST_M, city_scene, true_city, with_moved_walls, wrong_map
from studies.wrong_maps import (
    CITIES,
    CLASSES,
    COMBINED,
    LINES,
    SIMPLE,
    TITLES,
    World,
    anchors_outdoors,
    draw_devices,
    judge_map,
    maps_cases,
    maps_table,
    random_waypoints,
)

SETTINGS = maps_cases(0)["city0-exact"]


def wrong(line, city=0, seed=0):
    return wrong_map(true_city(city), LINES[line], np.random.default_rng(seed))


def corners(buildings):
    return [np.array(each.outline.exterior.coords) for each in buildings]


@pytest.mark.parametrize("number", CITIES)
def test_a_city_is_a_scene_of_solids_and_always_the_same(number):
    city = true_city(number)
    assert 20 <= len(city) <= 50 and city == true_city(number)
    assert all(each.outline.is_valid and 8 <= each.height_m <= 35 for each in city)
    apart = [[one.outline.intersection(other.outline).area for other in city] for one in city]
    assert np.all(np.array(apart) - np.diag(np.diag(apart)) < 1e-6)
    assert {"concrete"} < {each.material for each in city}
    with city_scene(city, SETTINGS | {"city": number}) as scene:
        middle_m = np.array([(*each.outline.representative_point().coords[0], each.height_m) for each in city])
        np.testing.assert_allclose(scene.city.height_at(*middle_m.T[:2]), middle_m[:, 2], atol=1e-3)
        assert scene.city.inside(middle_m - [0, 0, 1]).all()
        thickness_m = {each.name: each.thickness_m for each in scene.city.materials}
        assert thickness_m["concrete"] == 0.3
        built = np.bincount(scene.city.material[~scene.city.on_ground])
        assert (built > 0).sum() == len({each.material for each in city})


def test_all_lines_have_a_title_and_a_row_for_each_city():
    assert list(LINES) == list(TITLES) and len(maps_cases(0)) == len(CITIES) * len(LINES)
    assert wrong("exact") == true_city(0)


@pytest.mark.parametrize("line, sd_m", [("walls-1m", 1.0), ("walls-2m", 2.0), ("walls-heights", 1.5)])
def test_walls_move_along_their_normals(line, sd_m):
    moved_m = []
    for seed in range(10):
        for one_m, other_m in zip(corners(true_city(0)), corners(wrong(line, seed=seed)), strict=True):
            along = np.diff(one_m, axis=0)
            normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
            moved_m += list(((other_m - one_m)[:-1] * normal).sum(axis=1))
            np.testing.assert_allclose(((other_m - one_m)[1:] * normal).sum(axis=1), moved_m[-len(normal):],
                                       atol=1e-9)  # both ends of a wall move alike: it is not turned
    assert np.std(moved_m) == pytest.approx(sd_m, rel=0.1) and abs(np.mean(moved_m)) < 0.1 * sd_m


def test_moved_walls_leave_a_building():
    house = true_city(1)[0].outline
    for seed in range(20):
        found = with_moved_walls(house, 5.0, np.random.default_rng(seed))
        assert found.is_valid and found.area > 0.3 * house.area


def test_heights_leave_the_walls_and_the_other_way_round():
    true = true_city(0)
    for line, sd_m in (("heights-3m", 3.0), ("walls-heights", 3.0)):
        found = wrong(line)
        error_m = [one.height_m - other.height_m for one, other in zip(found, true, strict=True)]
        assert 0.6 * sd_m < np.std(error_m) < 1.5 * sd_m and min(each.height_m for each in found) >= LOWEST_M
    assert [each.outline for each in wrong("heights-3m")] == [each.outline for each in true]
    assert [each.height_m for each in wrong("walls-2m")] == [each.height_m for each in true]


def test_the_frame_is_shifted_as_a_whole():
    shifts_m = [np.vstack(corners(wrong("frame-3m", seed=seed))) - np.vstack(corners(true_city(0))) for seed in (0, 1)]
    for shift_m in shifts_m:
        np.testing.assert_allclose(shift_m, np.broadcast_to(shift_m[0], shift_m.shape), atol=1e-9)
        assert np.linalg.norm(shift_m[0]) == pytest.approx(3)
    assert np.linalg.norm(shifts_m[0][0] - shifts_m[1][0]) > 0.1


def test_buildings_are_missing_or_of_metal():
    true, rest = true_city(0), wrong("missing")
    assert len(rest) == len(true) - 4 and all(each in true for each in rest)
    metal = wrong("metal")
    assert [each.material for each in metal] == [each.material.replace("concrete", "metal") for each in true]
    assert [each.outline for each in metal] == [each.outline for each in true]
    assert "metal" not in {each.material for each in true}


def test_devices_stand_outdoors_and_not_on_whole_metres():
    city, roles = true_city(1), ["anchor"] * 3 + ["unknown"] * 8
    device_m = draw_devices(city, roles, np.random.default_rng(0))
    away_m = distance(union_all([each.outline for each in city]), points(device_m[:, :2]))
    assert (away_m[:3] >= 6).all() and (away_m >= 1).all()
    assert (np.abs(device_m - np.round(device_m)) > 0).all() and (device_m[:, 2] <= 3).all()


def test_a_flight_goes_straight_in_even_steps_but_for_turns():
    way_m = np.linalg.norm(np.diff(random_waypoints(250, np.random.default_rng(0)), axis=0), axis=1)
    assert way_m.max() == pytest.approx(6) and np.median(way_m) == pytest.approx(6)


def flown(flown=40, held_out=10):
    """A small world by free space and a loss without line of sight."""
    rng, roles = np.random.default_rng(0), ["anchor"] * 3 + ["unknown"]
    city = true_city(0)
    device_m = draw_devices(city, roles, rng)
    points_m = np.column_stack([rng.uniform(0, 400, (flown + held_out, 2)), np.full(flown + held_out, 55.0)])
    with city_scene(city, SETTINGS) as scene:
        los = np.stack([scene.city.line_of_sight(one_m[None], points_m) for one_m in device_m])
    distance_m = np.linalg.norm(points_m - device_m[:, None], axis=2)
    gain_db = np.where(los, -40, -60) - 20 * np.log10(distance_m)
    gain_db[0, :3] = np.nan
    return World(roles, device_m, points_m[:flown], points_m[flown:], gain_db, los)


def test_measurements_are_those_of_the_flight_with_noise():
    world = flown()
    measured = world.measurements(1.0, -120.0, np.random.default_rng(0))
    clean_db = world.gain_db[:, :40].T.ravel()
    assert len(measured.table) == 160 and np.isnan(measured.level_db).sum() == 3
    assert np.nanstd(measured.level_db - clean_db) == pytest.approx(1, rel=0.2)
    np.testing.assert_array_equal(measured.receiver_m[:4], np.repeat(world.flight_m[:1], 4, axis=0))
    assert np.isnan(measured.device_m[3, :2]).all() and measured.device_m[3, 2] == world.device_m[3, 2]
    np.testing.assert_array_equal(measured.device_m[:3], world.device_m[:3])


def test_no_map_has_an_anchor_in_a_building():
    world = flown()
    for seed in range(3):
        found = anchors_outdoors(world, SETTINGS | {"wrong": {"wall_m": 2.0}}, np.random.default_rng(seed))
        assert (distance(union_all([each.outline for each in found]), points(world.device_m[:3, :2])) > 0).all()


@pytest.mark.slow
def test_twins_over_a_wrong_map_are_judged(monkeypatch):
    monkeypatch.setattr(wrong_maps, "true_world", lambda seed, settings: flown(120, 20))
    row = judge_map(0, maps_cases(0)["city0-missing"])
    assert row["buildings"] == len(true_city(0)) - 4 and sum(row["links"].values()) == 80
    for model in (*SIMPLE, COMBINED):
        assert row[model]["rmse_db"]["all"] > 0 and len(row[model]["devices"]["error_m"]) == 1
    assert set(row["map_error"]) == {"wall_m", "height_m", "shift_m", "offsets_db"}


def result(combined_db, held, error_m=2.0):
    """Results of a world: paths 3 dB, network 6 dB, kriging 4 dB."""
    return {"map_error": {"wall_m": [1.5, 1.0, 2.0], "height_m": [3.0, 2.0, 4.0],
                          "shift_m": [3.0, -4.0, 1.0], "offsets_db": [-6.0, 1.0]}} | {model: {
        "rmse_db": dict.fromkeys((*CLASSES, "anchors"), rmse_db), "bias_db": dict.fromkeys(CLASSES, 0.5),
        "coverage": {"all": held, "LoS": held, "NLoS": held - 0.1},
        "devices": {"error_m": [error_m, None], "radius_m": [3.0, None], "located": [True, False]},
        "warnings": ["the 3D map seems to be off", "few links"] if held > 0.8 else ["few links"]}
        for model, rmse_db in zip((*SIMPLE, COMBINED), (3.0, 6.0, 4.0, combined_db), strict=True)}


def test_the_table_has_a_line_for_each_error_of_the_map():
    rows = [{"name": f"city{city}-{line}", "seed": 0, "settings": {}, "cpu_s": 1.0, "results": result(*results)}
            for line in ("missing", "exact") for city, results in enumerate([(2.0, 0.9), (4.0, 0.8, 5.0)])]
    lines = maps_table(read_frame(rows)).splitlines()
    assert lines[4] == ("| exact | 2 | 3.00 | 6.00 | 4.00 | 3.16 | 1 | 0.50 / 0.50 | 85 % / 75 % | 3.16 | 1.5 | 3.0 | 5.0 | -6.0 | 1 |")
    assert lines[5].startswith("| 4 buildings missing | 2 |")
    assert "| exact | `path_kriging` | 4 | 2 | 50 % | 3.5 | 3.0 |" in lines
