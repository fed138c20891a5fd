"""Plans with a promise, in worlds that the tests draw themselves."""

import numpy as np
import pytest

from marl.airspace import keep_out
from marl.belief import Prior
from marl.environment import Environment
from marl.flights import fly
from marl.mission import Known, make_mission
from marl.plan_flights import PlanSettings, planned_scene
from marl.planner import PlanPolicy
from marl.promise import Size, bases, promise, sized, sizes, smallest
from marl.worlds import WorldSource, draw_positions
from radiotwin import fit_twin, fly_survey
from radiotwin.errors import BadInput


@pytest.fixture(scope="module")
def learnt(small_scene):
    return fit_twin(fly_survey(small_scene, "segmented", flights=2, seed=0), small_scene, "segmented_log_distance")


def test_nine_of_ten_true_worlds_bring_p10(tiny):
    """Levels, silence and data of the true world are drawn here, by what the prior declares."""
    below = above = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        mission = tiny(seed, rows=7, columns=7, devices=6, battery=(26, 26), snr_db=rng.uniform(-5, 25, (2, 6, 7, 7)),
                       data_units=rng.uniform(2000, 8000, 6))
        prior = Prior.of_mission(mission, level_sd_db=5.0, silent=0.2, data_spread=0.4)
        found = promise(prior, mission, 80, 100, seed)
        sends = rng.random(6) > 0.2
        sends[rng.integers(6)] |= not sends.any()
        off_db = rng.normal(0, 5.0, 6).astype(np.float32)
        data_units = mission.data_units * rng.uniform(0.6, 1.4, 6)
        real = mission._replace(snr_db=np.where(sends[:, None, None], mission.snr_db + off_db[:, None, None], -np.inf),
                                data_units=data_units)
        flown = fly(Environment(real, 1, rng), PlanPolicy(found.plan.actions))
        share = flown.collected.sum() / data_units[sends].sum()
        below += share < found.quantiles["p10"] - 1e-4
        above += share > found.quantiles["p90"] + 1e-4
        assert list(found.quantiles.values()) == sorted(found.quantiles.values())
    assert below <= 11 and above <= 11  # P(more than 11 of 50 at one in ten) < 1 %


def test_worlds_have_the_spread_that_is_declared(tiny):
    mission = tiny(0, devices=40, sigma_db=4.0, rows=12, columns=12)
    prior = Prior.of_mission(mission._replace(shadowing_share=0.75), 2.0, 0.3, 0.5)
    prior = prior._replace(common_sd_db=3.0)
    source, rng = WorldSource(prior, mission), np.random.default_rng(0)
    drawn = [source.draw(rng) for _ in range(40)]
    silent = np.mean([~transmits for _, transmits in drawn])
    assert abs(silent - 0.3) < 0.04
    off_db = np.array([np.where(transmits, (real.snr_db - mission.snr_db).mean(axis=(0, 2, 3)), np.nan)
                       for real, transmits in drawn])
    within = np.nanstd(off_db, axis=1).mean()  # of devices in one world: level, and what is left of the map's
    assert 2.0 < within < np.hypot(2.0, 4.0 * np.sqrt(0.75))
    assert abs(np.nanmean(off_db, axis=1).std() - 3.0) < 1.0
    np.testing.assert_allclose(drawn[0][0].sigma_db, 4.0 * np.sqrt(0.25), rtol=1e-6)
    data = np.array([np.where(transmits, real.data_units / mission.data_units, np.nan) for real, transmits in drawn])
    assert np.nanmin(data) >= 0.5 and np.nanmax(data) <= 1.5 and abs(np.nanmean(data) - 1.0) < 0.03


def test_positions_are_drawn_in_their_circle_outside_buildings(small_scene, learnt):
    rng = np.random.default_rng(0)
    for row, device in enumerate(learnt.devices):
        drawn_m = draw_positions(learnt, row, small_scene, 400, rng)
        off_m = np.hypot(drawn_m[:, 0] - device.x_m, drawn_m[:, 1] - device.y_m)
        assert not small_scene.city.inside(drawn_m).any()
        if device.role == "anchor":
            assert not off_m.any()
        elif device.second_mode is None and device.credible_radius_m < 5:
            assert 0.8 < (off_m <= device.credible_radius_m).mean() < 0.97


def test_sizes_rise_with_uavs_and_battery_and_the_least_that_is_enough_is_told(tiny):
    mission = tiny(5, rows=9, columns=9, uavs=2, devices=5, battery=(20, 20), data_units=np.full(5, 1500.0),
                   start=[(0, 0), (8, 8)], terminal=[(0, 0), (8, 8)])
    prior = Prior.of_mission(mission, level_sd_db=2.0)
    assert bases(mission, ["a", "b"]) == {"a": [0], "b": [1], "all": [0, 1]}
    found = sizes(prior, mission, ["a", "b"], (1, 3), (4.0, 20.0), 0.9, 30, 200, 0)
    share = {(row.base, row.uavs, row.battery): row.p50 for row in found}
    for base in ("a", "b", "all"):
        assert share[base, 3, 20.0] > share[base, 1, 4.0]
    rows = [Size(1, 20.0, "a", 0, 0, 0, 0.5), Size(2, 30.0, "a", 0, 0, 0, 0.95), Size(2, 20.0, "b", 0, 0, 0, 0.92)]
    assert smallest(rows, 0.9) == rows[2] and smallest(rows[:1], 0.9) is None
    assert sized(mission, [1, 1, 0], 7.5).battery.tolist() == [15, 15, 15]


def test_no_uav_is_near_a_building_or_over_an_area(small_scene):
    from shapely import Polygon, box, contains_xy

    lattice = small_scene.lattice
    square = box(lattice.x_m[3] + 1, lattice.y_m[3] + 1, lattice.x_m[5] - 1, lattice.y_m[5] - 1)
    blocked = keep_out(small_scene, [square, Polygon()], 8.0)
    x_m, y_m = np.meshgrid(lattice.x_m, lattice.y_m)
    assert blocked[:, contains_xy(square, x_m, y_m)].all() and blocked[:, 4, 3].all()  # a move leads over its edge
    rng = np.random.default_rng(0)
    free = np.argwhere(~blocked)
    positions_m = lattice.positions_m.reshape(*lattice.shape, 3)[tuple(free[rng.integers(len(free), size=400)].T)]
    angle, away_m = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0, 4.0, 400)
    around_m = positions_m + np.column_stack([away_m * np.cos(angle), away_m * np.sin(angle), np.zeros(400)])
    assert not small_scene.city.inside(around_m).any()
    assert (blocked >= small_scene.blocked).all()


def test_who_flies_and_what_waits_is_as_asked(small_scene, learnt, tmp_path):
    table = tmp_path / "data.csv"
    table.write_text(f"device,data_units\n{learnt.devices[1].device},123\n")
    scene = planned_scene(small_scene, learnt, PlanSettings(uavs=3, battery=55.0, data=table))
    assert [uav.battery for uav in scene.config.uavs] == [55.0] * 3
    assert len({uav.uav for uav in scene.config.uavs}) == 3
    mission = make_mission(scene, learnt.radio_map(small_scene), Known.of(learnt.devices))
    assert mission.data_units[1] == 123 and mission.data_units[0] == small_scene.config.mission.data_units
    for text, message in (("device,data_units\nnobody,5\n", "no device of the twin"),
                          (f"device,data_units\n{learnt.devices[0].device},-5\n", "above 0"),
                          (f"device,data_units\n{learnt.devices[0].device},5\n{learnt.devices[0].device},6\n", "listed twice")):
        table.write_text(text)
        with pytest.raises(BadInput, match=message):
            planned_scene(small_scene, learnt, PlanSettings(data=table))
