"""Measurements and scene in one frame: converted, refused with the translation that fits, or told to be the same."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.geo import between_frames
from radiotwin.io.forms import Origin
from radiotwin.links.alignment import as_measurements, in_scene_frame, search_shift
from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene

RBM = Path(__file__).parents[2] / "scenes" / "rbm"
HERE = Origin(latitude_deg=36.0001, longitude_deg=-78.93575)
THERE = Origin(latitude_deg=35.999274, longitude_deg=-78.935964)


@pytest.fixture(scope="module")
def rbm():
    return Scene.load(RBM)


def walked(scene, seed, number=1500, indoors=0.02):
    """Receivers in the streets, a few indoors: uniform over the extent, those within walls mostly left out."""
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = scene.config.extent.bounds
    position_m = np.column_stack([rng.uniform(x0, x1, 4 * number), rng.uniform(y0, y1, 4 * number),
                                  np.full(4 * number, 1.5)])
    keep = ~scene.city.inside(position_m) | (rng.random(4 * number) < indoors)
    return position_m[keep][:number]


def measured(receiver_m, origin=None):
    table = pd.DataFrame({"flight": "f", "receiver": "r", "receiver_x_m": receiver_m[:, 0],
                          "receiver_y_m": receiver_m[:, 1], "receiver_z_m": receiver_m[:, 2], "device": "a",
                          "rssi_dbm": -90.0})
    devices = pd.DataFrame({"device": ["a"], "x_m": 0.0, "y_m": 0.0, "z_m": 30.0, "role": "anchor"})
    return Measurements(table, devices, origin)


def placed(scene, origin):
    """The scene with another origin."""
    config = scene.config.model_copy(update={"origin": origin, "crs": None})
    return Scene(scene.folder, config)


@pytest.mark.seconds
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wrong_m", [(60.0, -40.0), (-130.0, 20.0), (8.0, 210.0)])
def test_the_translation_is_found(rbm, seed, wrong_m):
    shift_m = search_shift(rbm, walked(rbm, seed) + [*wrong_m, 0.0]).proposed
    assert shift_m is not None
    assert np.hypot(shift_m[0] + wrong_m[0], shift_m[1] + wrong_m[1]) <= 4.0  # two cells


def test_none_is_proposed_above_the_roofs(rbm):
    assert search_shift(rbm, walked(rbm, 0) + [100.0, 0.0, 500.0]).proposed is None


def test_unknown_frames_that_fit_are_taken_for_one(rbm):
    right = measured(walked(rbm, 0))
    assert in_scene_frame(right, rbm) is right


def test_unknown_frames_that_do_not_fit_are_refused_with_the_translation(rbm):
    wrong = measured(walked(rbm, 1) + [60.0, -40.0, 0.0])
    with pytest.raises(BadInput, match="not in one frame.*--shift=-60,40 would make them fit") as said:
        in_scene_frame(wrong, rbm)
    assert "is not known of the measurements and of the scene" in str(said.value)
    moved = in_scene_frame(wrong, rbm, (-60.0, 40.0))
    np.testing.assert_allclose(moved.receiver_m, walked(rbm, 1), atol=1e-9)
    np.testing.assert_allclose(moved.device_m, [[-60.0, 40.0, 30.0]])


def test_receivers_indoors_in_a_frame_that_is_said_to_be_the_same(rbm):
    inside = measured(walked(rbm, 2, indoors=1.0))
    with pytest.raises(BadInput, match="--shift=0,0"):
        in_scene_frame(inside, rbm)
    np.testing.assert_array_equal(in_scene_frame(inside, rbm, (0.0, 0.0)).receiver_m, inside.receiver_m)


@pytest.mark.parametrize(("shift_m", "message"), [
    ((1e308, 0.0), r"a shift by 1e\+308, 0 m is not possible; allowed are -1e\+07 to 1e\+07 m"),
    ((1e7, 0.0), r"outside the 3D map, .*: the shift by 1e\+07, 0 m takes them there; correct its size")])
def test_a_shift_off_the_map(rbm, shift_m, message):
    with pytest.raises(BadInput, match=message):
        in_scene_frame(measured(walked(rbm, 1)), rbm, shift_m)


def test_known_frames_are_converted_and_told(rbm):
    receiver_m = walked(rbm, 3)
    there = placed(rbm, THERE)
    elsewhere = measured(between_frames(receiver_m, THERE, HERE), HERE)
    with pytest.warns(UserWarning, match=r"moved by \+19\.3 m east, \+91\.7 m north"):
        here = in_scene_frame(elsewhere, there)
    np.testing.assert_allclose(here.receiver_m, receiver_m, atol=1e-6)
    assert here.origin == THERE and in_scene_frame(here, there) is here


def test_known_frames_let_receivers_be_indoors(rbm):
    inside = measured(walked(rbm, 2, indoors=1.0), THERE)
    assert in_scene_frame(inside, placed(rbm, THERE)) is inside


def test_a_ride_with_gps_errors_is_in_the_frame(rbm):
    """Positions 5 m off and one phone 12 m: many are inside buildings, and a note says so; moved by 60 m they are refused."""
    rng = np.random.default_rng(4)
    receiver_m = walked(rbm, 4, 600, indoors=0.0)
    receiver_m[:, :2] += rng.normal(0, 5.0, (600, 2))
    receiver_m[:150, 0] += 12.0
    assert rbm.city.inside(receiver_m).mean() > 0.07
    with pytest.warns(UserWarning, match="receivers are inside buildings .* no translation fits clearly better"):
        ride = in_scene_frame(measured(receiver_m), rbm)
    np.testing.assert_array_equal(ride.receiver_m, receiver_m)
    with pytest.raises(BadInput, match="not in one frame"):
        in_scene_frame(measured(receiver_m + [60.0, 0.0, 0.0]), rbm)


@pytest.mark.parametrize(("terrain", "z_m"), [(None, 25.0), ("a hill", 425.0)])
@pytest.mark.parametrize("with_map", [True, False])
def test_heights_above_the_ground_count_in_an_object_as_in_a_table(rbm, with_map, terrain, z_m):
    city = SimpleNamespace(terrain=terrain, ground_height_m=lambda x_m, y_m: np.full(len(x_m), 400.0))
    scene = SimpleNamespace(config=rbm.config, city=city) if with_map else None
    table = measured(walked(rbm, 0, 30)).table.drop(columns="receiver_z_m").assign(receiver_above_ground_m=25.0)
    devices = measured(np.zeros((1, 3))).devices
    taken = as_measurements(Measurements(table, devices), scene)
    assert (taken.receiver_m[:, 2] == (z_m if with_map else 25.0)).all()
    assert "receiver_above_ground_m" not in taken.table
