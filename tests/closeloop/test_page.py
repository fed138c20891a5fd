"""The report's page and pictures: right for each verdict, and never stopped by what a file may hold."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.drawing import bins, means
from radiotwin.closeloop.effect_figures import draw_effects
from radiotwin.closeloop.figures import draw_figures
from radiotwin.closeloop.map_figures import Ground, draw_residual_map
from radiotwin.closeloop.page import lead, write_page
from radiotwin.closeloop.report import make_report
from radiotwin.closeloop.run import Loop, close_loop
from radiotwin.closeloop.selection import Model, Search
from radiotwin.closeloop.words import listed, parameter, variable
from radiotwin.effects.body_shadowing import BodyShadowing
from radiotwin.effects.clock_offset import ReceiverClockOffset
from radiotwin.effects.detection_limit import DetectionLimit
from radiotwin.effects.excess_attenuation import ExcessAttenuation
from radiotwin.effects.foliage import Foliage
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.effects.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.interference import Interference
from radiotwin.effects.lock_loss import LockLoss
from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.effects.noise_floor import NoiseFloor
from radiotwin.effects.path_strength import WallReflection
from radiotwin.effects.position_errors import DevicePositionError, ReceiverPositionError
from radiotwin.effects.receiver_saturation import ReceiverSaturation
from radiotwin.effects.removed_obstacle import RemovedObstacle
from radiotwin.effects.sector_antenna import SectorAntenna
from radiotwin.effects.tilted_dipole import TiltedDipole
from radiotwin.measurements import Measurements

SCORES = {"n": 900, "bias_db": 0.04, "std_db": 3.0, "correlation": 0.9, "rmse_db": 3.0, "mae_db": 2.2, "nll": 2.5}
NOTHING = {"n": 0} | dict.fromkeys(["bias_db", "std_db", "correlation", "rmse_db", "mae_db", "nll"])
DRIFT = {"name": "receiver_drift", "variant": "", "rank": 1, "params": {}, "confused_with": ["interference"],
         "indistinguishable_from": ["receiver_gain_offset"],
         "parameters": {"step_db[r<0>]": {"value": -6.0, "low": -6.5, "high": -5.5, "unit": "dB"},
                        "step_time_s[r<0>]": {"value": 500.0, "low": None, "high": None, "unit": "s"}},
         "evidence": {"heldout_nll_gain": 210.0, "p_value": 1e-9}}


def report(verdict="effect", **changes):
    """The content of a `closeloop.json`."""
    found = verdict == "effect"
    after = SCORES | {"rmse_db": 2.0, "std_db": 2.0} if found else SCORES
    drivers = [{"variable": "time_in_flight_s", "p_value": 0.0004, "effect_db": 1.5}]
    return {
        "schema": "radiotwin.closeloop/1", "radiotwin_version": "0", "base": "twin", "verdict": verdict,
        "effects": [DRIFT] if found else [],
        "candidates": [{"name": "receiver_drift", "step": 1, "heldout_rmse_db": 2.0, "heldout_nll_gain": 210.0,
                        "p_value": 1e-9, "kept": found, "reason": "" if found else "gains nothing"},
                       {"name": "foliage", "step": 1, "heldout_rmse_db": None, "heldout_nll_gain": None,
                        "p_value": None, "kept": False, "reason": "nothing in the residual looks like it"}],
        "heldout": {"by": "flight", "folds": 6, "n": 900},
        "error": {"before": SCORES, "after": after, "noise_floor_db": None,
                  "by_device": {"<b>": {"before": SCORES, "after": after},
                                "d1": {"before": NOTHING, "after": NOTHING}}},
        "baselines": {"log_distance": SCORES | {"rmse_db": 7.0},
                      "regression_kriging": {"rmse_db": 5.5, "median_db": 1}},
        "structure_before": drivers,
        "remaining": {"structured": verdict == "unexplained", "drivers": drivers if verdict == "unexplained" else []},
        "notes": ["receiver <i> has 3 only"]} | changes


def page(content, folder):
    write_page(content, folder, "What the model of <x> unavailable")
    return (folder / "closeloop.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("verdict, sentence, badge", [
    ("effect", "The model lacked receiver drift. With it the error on held-out links falls from 3.00 to 2.00 dB",
     "found: receiver drift"),
    ("none", "Nothing is missing: what the model leaves over (3.00 dB)", "nothing is missing"),
    ("unexplained",
     "none of the effects in the catalogue is_cause it: the error (3.00 dB) depends on time in the flight",
     "unexplained")])
def test_each_verdict_is_told_first(tmp_path, verdict, sentence, badge):
    text = page(report(verdict), tmp_path)
    assert sentence in text and f"<b>{badge}</b>" in text
    assert text.index(sentence) < text.index("<h2>")
    assert "http" not in text and "<script" not in text  # one file, no network


def test_names_from_the_data_are_no_markup(tmp_path):
    text = page(report(), tmp_path)
    for written in ("device &lt;b&gt;", "step (r&lt;0&gt;)", "receiver &lt;i&gt; has 3 only", "the model of &lt;x&gt;"):
        assert written in text
    assert "<i>" not in text and "<x>" not in text


def test_the_figures_that_planners_judge_by_stand_in_one_table_with_the_other_models(tmp_path):
    text = page(report(), tmp_path)
    table = text[text.index("Error before and after"):text.index("by device, receiver and flight")]
    for words in ("mean [dB]", "standard deviation [dB]", "correlation", "log-distance law", "7.00",
                  "regression kriging", "5.50", "median db"):
        assert words in table


def test_what_an_effect_may_be_taken_for_is_said(tmp_path):
    text = page(report(), tmp_path)
    assert "The data cannot tell it from receiver gain offset." in text
    assert "Others that may look alike: interference." in text
    assert "−6.50 to −5.50" in text
    assert "nothing in the residual looks like it" in text


def test_numbers_that_are_not_known_are_dashes(tmp_path):
    unknown = report("none", baselines={"log_distance": NOTHING}, structure_before=[])
    unknown["error"] |= {"before": NOTHING, "after": NOTHING}
    assert "(– dB)" in lead(unknown)
    assert "None" not in page(unknown, tmp_path) and "nan" not in page(unknown, tmp_path)


def test_a_last_resort_is_not_called_an_explanation(tmp_path):
    shadowing = DRIFT | {"name": "correlated_shadowing", "rank": 2}
    filled = report("unexplained", effects=[shadowing])
    assert "which is_cause nothing, brings it to 3.00 dB" in lead(filled)
    filled = report("effect", effects=[DRIFT, shadowing])
    filled["error"]["after"] |= {"rmse_db": 1.5}
    assert "lacked receiver drift. With it the error on held-out links falls from 3.00 to 2.00 dB" in lead(filled)
    assert "brings it to 1.50 dB" in lead(filled) and "found: receiver drift<" in page(filled, tmp_path)


def measured(device_m, receiver_m, index, odd=0.0):
    """Measurements by one law; index: flight, receiver, device and slot of each link. Receiver 0 is off by `odd` dB."""
    flight, receiver, device, slot = index
    rng = np.random.default_rng(0)
    distance_m = np.linalg.norm(receiver_m - device_m[device], axis=1)
    level_db = -35 - 26 * np.log10(distance_m) + rng.normal(0, 1.0, len(slot)) + odd * (receiver == 0)
    names = np.array([f"{name} no {i}" for i, name in enumerate(["<b>", "$x$", "a name that is long"] * 4)])
    table = pd.DataFrame({
        "time_s": 100.0 * flight + slot, "flight": [f"f{i}" for i in flight], "receiver": [f"r${i}" for i in receiver],
        **{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")}, "device": names[device],
        "gain_db": np.where(level_db < -105, np.nan, level_db), "heading_deg": 12.0 * slot})
    devices = pd.DataFrame({"device": names[:len(device_m)], **dict(zip(("x_m", "y_m", "z_m"), device_m.T)),
                            "role": "anchor", "frequency_hz": 2.4e9})
    return Measurements(table, devices)


def links(devices):
    """Flight, receiver, device and slot of each link."""
    sizes = pd.MultiIndex.from_product([range(4), range(2), range(devices), range(30)])
    return sizes.to_frame(index=False).to_numpy().T


@pytest.fixture(scope="module")
def loop():
    """Open ground, no map, blanks, names that are hard to write, and a receiver that is off."""
    index = links(3)
    flight, receiver, _, slot = index
    receiver_m = np.column_stack([100 + 10 * slot + 30 * flight, 60.0 * flight + 5 * slot, 50.0 + 10 * receiver])
    device_m = np.array([(0, 0, 1.5), (400, 50, 1.5), (200, 350, 1.5)])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radiotwin.closeloop.run.CATALOGUE", (ReceiverGainOffset,))  # the others take their time
        return close_loop(measured(device_m, receiver_m, index, -6.0), None, "log-distance", 0, lambda text: None)


def with_model(loop, model):
    """A loop that found something else."""
    return Loop(loop.base, loop.links, loop.folds, loop.before, Search(model), loop.dependences_before, [])


def with_effect(model, effect, params):
    """A model with an effect that nobody asked for."""
    whole = model.whole.with_parts([model.whole.part(effect(), params)])
    return Model(whole, model.folds, [whole.fit(), *model.fits[1:]], model.index)


def test_every_picture_is_written_without_a_map(loop, tmp_path):
    content = make_report(loop)
    assert [effect["name"] for effect in content["effects"]] == ["receiver_gain_offset"]
    (tmp_path / "effect_7_of_an_earlier_run.png").write_bytes(b"")
    draw_figures(loop, None, content, tmp_path)
    found = sorted(path.name for path in tmp_path.glob("*.png"))
    assert found == ["drivers.png", "effect_1_receiver_gain_offset.png", "level_map.png", "residual_map.png",
                     "waterfall.png"]
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in found)
    assert page(content, tmp_path).count("data:image/png;base64,") == 5


def test_pictures_where_nothing_was_found_and_nothing_could_be_tested(loop, tmp_path):
    nothing = with_model(loop, loop.before)
    nothing.dependences_before = []
    content = make_report(nothing)
    assert content["verdict"] == "none" and not content["effects"]
    draw_figures(nothing, None, content, tmp_path)
    text = page(content, tmp_path)
    assert text.count("data:image/png;base64,") == 4 and "No structure" in text


@pytest.mark.parametrize("effect, params", [
    (DeviceGainOffset, {"members": [0, 1, 2], "spread_db": 4.0}), (ExcessAttenuation, {"scale_height_m": 100.0}),
    (BodyShadowing, {"members": [0, 1]}),
    (ReceiverDrift, {"receivers": {"0": ["warm_up_each_flight", 8.0], "1": ["step", 150.0]}}),
    (DeviceDrift, {"devices": {"1": ["step", 150.0]}, "span_s": [0.0, 300.0]}),
    (ReceiverClockOffset, {"receiver": 0, "offset_s": 3.0, "speed_m_s": 10.0}),
    (ReceiverSaturation, {"receivers": {"0": [-85.0, 1.0]}}), (NoiseFloor, {"receivers": {"1": -95.0}}),
    (SectorAntenna, {"devices": {"1": [30.0, 65.0, 15.0, 0.0, 360.0, -35.0]}}),
    (TiltedDipole, {"receivers": {"0": [20.0, 90.0, -35.0]}}),
    (DevicePositionError, {"device": 1, "move_m": [30.0, -20.0]}),
    (ReceiverPositionError, {"receiver": 0, "move_m": [0.0, 0.0, 30.0]}),
    (MissingObstacle, {"box": [250.0, 120.0, 30.0, 20.0, 60.0, 20.0], "scattered_db": 0.0}),
    (MissingObstacle, {"box": [-900.0, 0.0, 30.0, 20.0, 60.0, 20.0], "scattered_db": 0.0}),  # in no link's way
    (Interference, {"place_m": [150.0, 200.0], "level_db": -80.0, "within_m": [0.0, 0.0, 500.0, 500.0]}),
    (DetectionLimit, {"receivers": {"0": -95.0}}),
    (LockLoss, {"receivers": {"0": 0.1, "1": 0.02}}),
    (Foliage, {"box": [250.0, 120.0, 30.0, 20.0, 20.0, 20.0], "law": [0.6, 15.0]})])
def test_an_effect_is_drawn_in_its_own_terms(loop, tmp_path, effect, params):
    changed = with_model(loop, with_effect(loop.before, effect, params))
    draw_effects(changed, Ground(loop.links, None), tmp_path)
    assert (tmp_path / f"effect_1_{effect.name}.png").stat().st_size > 5000


def test_effects_of_the_map_are_drawn_on_it(small_scene, tmp_path):
    index, rng = links(len(small_scene.device_m)), np.random.default_rng(1)
    x_min, x_max, y_min, y_max = small_scene.config.extent.bounds
    receiver_m = np.column_stack([rng.uniform(x_min, x_max, len(index[0])), rng.uniform(y_min, y_max, len(index[0])),
                                  np.full(len(index[0]), 60.0)])
    data = measured(small_scene.device_m, receiver_m, index)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radiotwin.closeloop.run.CATALOGUE", ())
        loop = close_loop(data, small_scene, "log-distance", 0, lambda text: None)
    ground = Ground(loop.links, small_scene)
    for effect, params in ((RemovedObstacle, {"building": 0, "centre_m": [0.0, 0.0, 9.0]}),
                            (WallReflection, {"strength_db": 0.0, "level_db": 0.0})):
        changed = with_model(loop, with_effect(loop.before, effect, params))
        draw_residual_map(changed, ground, tmp_path / "residual_map.png")
        draw_effects(changed, ground, tmp_path)
        assert (tmp_path / f"effect_1_{effect.name}.png").stat().st_size > 5000


def test_means_of_bins_and_their_errors():
    rng = np.random.default_rng(0)
    value = rng.uniform(0, 100, 4000)
    level = bins(value, 10)
    assert np.bincount(level).min() >= 399 and level.max() == 9
    found = means(level, value, 0.1 * value + rng.normal(0, 1.0, 4000), np.arange(4000))
    assert found.mean == pytest.approx(0.1 * found.at, abs=0.25)
    assert found.error == pytest.approx(np.hypot(1.0, 1 / np.sqrt(12)) / 20, rel=0.15)
    # Links that err as one: no more is known from ten times as many.
    alike = np.repeat(rng.normal(0, 1.0, 400), 10)
    zeros = np.zeros(4000, dtype=int)
    assert means(zeros, value, alike, np.repeat(np.arange(400), 10)).error[0] == pytest.approx(1 / 20, rel=0.15)
    assert list(bins(np.array([50.0, 70.0, 50.0, 60.0]), 10)) == [0, 2, 0, 1]


def test_names_in_words():
    assert parameter("tilt_deg[uav1]") == "tilt (uav1)" and parameter("odd_thing_db") == "odd thing"
    assert variable("time_in_flight_s") == ("time in the flight", "s")
    assert variable("odd_length_m") == ("odd length", "m")
    assert listed(["a", "b", "a", "c"]) == "a, b and c"
