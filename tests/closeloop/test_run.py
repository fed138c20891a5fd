"""The loop on worlds without a map, made by other formulas: the hidden effect is named and the error falls."""

from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import CrossFit, best_base
from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.errors import BadInput

pytestmark = pytest.mark.usefixtures("short_report")


def run(measurements, seed=0):
    return make_report(close_loop(measurements, base="log-distance", seed=seed))


def named(report):
    return [effect["name"] for effect in report["effects"]]


def value(report, name, parameter):
    effect = next(effect for effect in report["effects"] if effect["name"] == name)
    return effect["parameters"][parameter]["value"]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_where_nothing_is_missing_nothing_is_named(open_ground, seed):
    report = run(open_ground.measured(open_ground.fly(seed)))
    assert report["verdict"] == "none" and not report["effects"] and not report["remaining"]["structured"]
    assert report["error"]["before"]["rmse_db"] == pytest.approx(2.0, rel=0.06)
    assert report["error"]["before"] == report["error"]["after"]


def test_a_receiver_that_reads_too_much_is_named_and_measured(open_ground):
    world = open_ground.fly(2)
    world.gain_db[world.receiver == 1] += 5.0
    report = run(open_ground.measured(world))
    assert named(report) == ["receiver_gain_offset"]
    assert value(report, "receiver_gain_offset", "offset_db[r1]") == pytest.approx(5.0, abs=0.5)  # of all others
    assert report["error"]["after"]["rmse_db"] < 1.05 * 2.0 < report["error"]["before"]["rmse_db"]


def cardioid(world):
    """Of a device that is seen from all sides; it is not the pattern that is fitted."""
    mine = world.device == np.abs(world.device_m[:, :2] - 250).max(axis=1).argmin()
    azimuth_deg = np.degrees(np.arctan2(world.offset_m[:, 0], world.offset_m[:, 1]))
    world.gain_db[mine] += 20 * np.log10(0.08 + 0.46 * (1 + np.cos(np.radians(azimuth_deg[mine] - 70))))
    return f"azimuth_deg[d{world.device[mine][0]}]"


def anchor_elsewhere(world):
    """Declared 45 m too far west."""
    world.device_m[1, 0] += 45.0


def clock(world):
    """Each level of a receiver is written beside the position of three seconds before."""
    there = np.flatnonzero((world.receiver == 1) & (world.slot >= 3))
    world.receiver_m[there] = world.receiver_m[there - 3 * len(world.device_m)].copy()


def raised(change_db):
    def change(world):
        world.gain_db += change_db(world)
    return change


FAULTS = (  # seed, change of a world, effect, values with their tolerance
    (3, raised(lambda w: 7.0 * 0.5 ** (w.slot / 10.0) * (w.receiver == 0)), "receiver_drift",
     {"warm_up_each_flight_db[r0]": (7.0, 1.5)}),
    (4, raised(lambda w: -6.0 * ((w.receiver == 1) & (w.time_s > 530))), "receiver_drift", {"step_db[r1]": (-6.0, 1.0)}),
    # The other flights do not show it.
    (7, raised(lambda w: 12.0 * ((w.receiver == 1) & (w.flight == 0))), "receiver_drift",
     {"step_db[r1]": (-12.0, 1.0), "step_time_s[r1]": (130.0, 71.0)}),
    (7, raised(lambda w: -12.0 * np.exp(-w.time_s / 40.0) * (w.receiver == 1)), "receiver_drift",
     {"warm_up_db[r1]": (-12.0, 2.0), "time_constant_s[r1]": (40.0, 10.0)}),
    (10, raised(lambda w: -7.0 * ((w.device == 2) & (w.time_s > 530))), "device_drift", {"step_db[d2]": (-7.0, 1.0)}),
    (11, clock, "receiver_clock_offset", {"positions_late_by_s[r1]": (3.0, 0.7)}),
    (5, cardioid, "antenna_pattern", {"": (70.0, 20.0)}),
    (6, anchor_elsewhere, "device_position_error", {}))

FIRST_OF_SEVERAL = ("antenna_pattern", "device_position_error")  # what the fitted form leaves is described beside them


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "change", "effect", "values"), FAULTS, ids=[each[2] for each in FAULTS])
def test_what_was_done_to_a_world_is_named_and_measured(open_ground, seed, change, effect, values):
    world = open_ground.fly(seed)
    position_m = world.device_m.copy()
    parameter = change(world)
    report = run(open_ground.measured(world))
    assert named(report)[0] == effect
    if effect not in FIRST_OF_SEVERAL:
        assert len(named(report)) == 1
    for name, (expected, within) in values.items():
        assert value(report, effect, name or parameter) == pytest.approx(expected, abs=within)
    if "step_time_s[r1]" in values:  # the flights beside the change are told by no other
        learnable = report["error"]["learnable"]
        assert learnable["before"]["n"] == 3000 - 1 and learnable["after"]["rmse_db"] == pytest.approx(2.0, rel=0.06)
    if effect == "device_position_error":
        found_m = [value(report, effect, f"{axis}_m[d1]") for axis in "xy"]
        assert found_m == pytest.approx(position_m[1, :2], abs=10)


@pytest.mark.slow
def test_flights_that_differ_anyhow_are_no_step(open_ground):
    world = open_ground.fly(9)
    each_db = np.array([[2.0, -2, 2, -2, 2, -2], [-3.0, 3, 0, 0, 3, -3]])
    world.gain_db += each_db[world.receiver, world.flight]
    assert not {"receiver_drift", "device_drift"} & set(named(run(open_ground.measured(world))))


def test_what_no_effect_explains_is_filled_in_over_the_variable_that_it_depends_on(open_ground):
    world = open_ground.fly(8)
    world.gain_db += 6.0 * np.exp(-(((world.slot - 30) / 8.0) ** 2))  # no effect of the catalogue rises and falls like that
    report = run(open_ground.measured(world))
    assert report["verdict"] in ("located", "undecided") and named(report) == ["unexplained_trend"]
    assert report["effects"][0]["variant"] == "over time_in_flight_s"
    assert "time_in_flight_s" in [each["variable"] for each in report["remaining"]["drivers"]]
    assert value(report, "unexplained_trend", "rise_and_fall_db[time_in_flight_s]") == pytest.approx(6.0, abs=1.0)
    assert report["error"]["after"]["rmse_db"] < 1.1 * 2.0 < report["error"]["before"]["rmse_db"]


@pytest.mark.slow
def test_what_no_effect_explains_is_called_unexplained_and_what_it_depends_on_is_named(open_ground):
    world = open_ground.fly(7)
    world.gain_db += 3.0 * np.sign(np.sin(2 * np.pi * world.receiver_m[:, 0] / 160)
                                   * np.sin(2 * np.pi * world.receiver_m[:, 1] / 160))
    report = run(open_ground.measured(world))
    assert report["verdict"] in ("located", "undecided") and named(report) == ["correlated_shadowing"]
    assert report["error"]["after"]["rmse_db"] < 0.92 * report["error"]["before"]["rmse_db"]
    assert "place_of_receiver" in [each["variable"] for each in report["remaining"]["drivers"]]


def test_the_same_seed_gives_the_same_report(open_ground):
    world = open_ground.fly(8)
    world.gain_db[world.receiver == 1] += 3.0
    measurements = open_ground.measured(world).select(world.slot % 4 == 0)
    assert run(measurements, 4) == run(measurements, 4)


def test_bad_data_is_one_message(open_ground):
    measurements = open_ground.measured(open_ground.fly(0))
    with pytest.raises(BadInput, match="allowed are auto, twin, raytrace, log-distance"):
        close_loop(measurements, base="oracle")
    with pytest.raises(BadInput, match="give --scene"):
        close_loop(measurements, base="raytrace")
    measurements.table["gain_db"] = -80.0
    with pytest.raises(BadInput, match="always reads -80|at least 60|all levels are"):
        close_loop(measurements, base="log-distance")


def test_devices_can_be_held_out(open_ground):
    world = open_ground.fly(9)
    world.gain_db[world.receiver == 1] += 4.0
    loop = close_loop(open_ground.measured(world), base="log-distance", hold_out="device")
    for fold in range(loop.folds.count):  # whole devices
        mine = loop.folds.index == fold
        assert not set(loop.links.device[mine]) & set(loop.links.device[~mine])
    report = make_report(loop)
    assert named(report)[0] == "receiver_gain_offset" and report["heldout"]["by"] == "device"
    with pytest.raises(BadInput, match="allowed are auto, flight, block, quadrant, device"):
        close_loop(open_ground.measured(world), base="log-distance", hold_out="colour")


@pytest.mark.slow
def test_when_a_receiver_changed_a_flight_that_is_held_out_does_not_tell(open_ground):
    world = open_ground.fly(4)
    world.gain_db[(world.receiver == 1) & (world.flight >= 3)] -= 6.0
    loop = close_loop(open_ground.measured(world), base="log-distance", hold_out="flight")
    whole, *folds = ([each.params.receivers[1].number for each in model.effects if each.name == "receiver_drift"]
                     for model in loop.for_twin.fits)
    (when_s,) = whole
    assert 459 <= when_s <= 600  # between the ends of the third flight and the beginning of the fourth
    without_fourth_s = folds[int(loop.folds.index[world.flight == 3][0])]
    assert without_fourth_s and without_fourth_s[0] > when_s + 50  # half-way to the fifth
    assert all(each == whole for number, each in enumerate(folds)
               if number not in loop.folds.index[(world.flight == 2) | (world.flight == 3)])


class Predicts(SimpleNamespace):
    """A base of which only held-out predictions are known."""

    rmse_db = CrossFit.rmse_db


def test_a_base_does_not_win_by_links_that_it_cannot_predict():
    error_db = np.where(np.arange(1000) < 300, 3.0, 8.0)
    level_db = SimpleNamespace(level_db=np.zeros(1000))
    some = Predicts(links=level_db, held_out_mean_db=np.where(np.arange(1000) < 300, error_db, np.nan))
    all_ = Predicts(links=level_db, held_out_mean_db=0.8 * error_db)
    none = Predicts(links=level_db, held_out_mean_db=np.full(1000, np.nan))
    assert some.rmse_db() < all_.rmse_db()
    assert best_base({"twin": some, "raytrace": all_}) == "raytrace"
    assert best_base({"twin": none, "raytrace": all_}) == "raytrace"
