"""The figures of a close-loop: one for each effect, whatever was found and however names are written."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.search.stages import SearchState
from radiotwin.effects import registry
from radiotwin.links.measurements import Measurements
from radiotwin.report.closeloop_data import bin_index, bin_means, collect
from radiotwin.report.closeloop_figures import (
    dependence_figure,
    effect_figure,
    waterfall_figure,
    write_closeloop_figures,
)
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.folders import write_closeloop_folder
from radiotwin.report.labels import save
from radiotwin.report.map_figures import MapBackground, residual_map_figure


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
        patch.setattr("radiotwin.closeloop.run.catalogue", lambda: (registry.ReceiverGainOffset,))  # the others take long
        return close_loop(measured(device_m, receiver_m, index, -6.0), base="log-distance")


def with_model(loop, model):
    """Return a loop that found something else."""
    return dataclasses.replace(loop, explained=model, found=SearchState(model), dependences_after=[])


def with_effect(model, effect, params):
    """Return a model with an effect of given parameters."""
    plain = model.whole.model
    return model.with_fits(plain.with_effects([effect().with_params(effect.Params(**params))]).fit(), model.folds)


def drawn(loop, scene=None):
    """Return the figure of the first effect of a loop."""
    data = collect(loop)
    return effect_figure(data.effects[0], MapBackground(data.links, scene))


def test_every_figure_is_written_without_a_map(loop, tmp_path):
    content = make_report(loop)
    assert [effect["name"] for effect in content["effects"]] == ["receiver_gain_offset"]
    for name in ("closeloop.json", "effect_7_of_an_earlier_run.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    write_closeloop_folder(loop, None, tmp_path)
    assert (tmp_path / "notes.txt").exists()
    found = sorted(path.name for path in tmp_path.glob("*.png"))
    assert found == ["drivers.png", "effect_1_receiver_gain_offset.png", "groups.png", "level_map.png",
                     "residual_map.png", "waterfall.png"]
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in found)
    assert (tmp_path / "closeloop.html").read_text().count("data:image/png;base64,") == 6


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_legend_of_the_dependences_is_not_cut_off(loop, count):
    data = collect(loop)
    names = ["altitude_m", "distance_m", "elevation_deg"][:count]
    figure = dependence_figure(dataclasses.replace(data, drivers=names))
    figure.canvas.draw()
    [legend], whole = figure.legends, figure.bbox
    assert len(figure.axes) == count and len(legend.get_texts()) == 3
    assert whole.x0 <= legend.get_window_extent().x0 and legend.get_window_extent().x1 <= whole.x1


def test_figures_where_nothing_was_found_and_nothing_could_be_tested(loop, tmp_path):
    nothing = with_model(loop, loop.before)
    nothing.dependences_before = []
    content = make_report(nothing)
    assert content["verdict"] == "undecided" and not content["effects"]  # no step has been looked at
    write_closeloop_figures(nothing, None, content, tmp_path)
    write_closeloop_page(content, tmp_path, "page")
    text = (tmp_path / "closeloop.html").read_text()
    assert text.count("data:image/png;base64,") == 4 and "No structure" in text


@pytest.mark.parametrize("effect, params", [
    (registry.DeviceGainOffset, {"members": [0, 1, 2], "offsets_sd_db": 4.0}), (registry.ExcessAttenuation, {"scale_height_m": 100.0}),
    (registry.BodyShadowing, {"receivers": {"0": {"depth_db": 8.0, "azimuth_deg": 60.0}, "1": {"depth_db": 3.0}}}),
    (registry.ReceiverDrift, {"receivers": {"0": ["warm_up_each_flight", 8.0], "1": ["step", 150.0]}}),
    (registry.DeviceDrift, {"devices": {"1": ["step", 150.0]}, "span_s": [0.0, 300.0]}),
    (registry.ReceiverClockOffset, {"receiver": 0, "offset_s": 3.0, "speed_m_s": 10.0}),
    (registry.ReceiverSaturation, {"receivers": {"0": [-85.0, 1.0]}}), (registry.NoiseFloor, {"receivers": {"1": -95.0}}),
    (registry.SectorAntenna, {"devices": {"1": {"azimuth_deg": 30.0, "front_to_back_db": 15.0}}}),
    (registry.TiltedDipole, {"receivers": {"0": {"tilt_deg": 20.0, "lean_azimuth_deg": 90.0}}}),
    (registry.DevicePositionError, {"device": 1, "move_m": [30.0, -20.0]}),
    (registry.ReceiverPositionError, {"receiver": 0, "move_m": [0.0, 0.0, 30.0]}),
    (registry.MissingObstacle, {"box": [250.0, 120.0, 30.0, 20.0, 60.0, 20.0], "scattered_db": 0.0}),
    (registry.MissingObstacle, {"box": [-900.0, 0.0, 30.0, 20.0, 60.0, 20.0], "scattered_db": 0.0}),  # in no link's way
    (registry.Interference, {"place_m": [150.0, 200.0], "level_db": -80.0, "within_m": [0.0, 0.0, 500.0, 500.0]}),
    (registry.DetectionLimit, {"receivers": {"0": -95.0}}),
    (registry.LockLoss, {"receivers": {"0": 0.1, "1": 0.02}}),
    (registry.Foliage, {"box": [250.0, 120.0, 30.0, 20.0, 20.0, 20.0], "law": [0.6, 15.0]})])
def test_an_effect_is_drawn_in_its_own_terms(loop, tmp_path, effect, params):
    changed = with_model(loop, with_effect(loop.before, effect, params))
    save(drawn(changed), tmp_path / "effect.png")
    assert (tmp_path / "effect.png").stat().st_size > 5000


class OwnEffect(registry.ExcessAttenuation):
    """An effect that the report does not know."""

    name = "own_effect"


def test_an_effect_without_a_figure_of_its_own_is_drawn_over_what_explains_it(loop, monkeypatch):
    changed = with_model(loop, with_effect(loop.before, OwnEffect, {"scale_height_m": 100.0}))
    labels = [ax.get_xlabel() for ax in drawn(changed).axes]
    assert labels and all(label.endswith("]") for label in labels), "a variable with its unit"
    monkeypatch.setattr(OwnEffect, "figure", "histogram", raising=False)
    assert [ax.get_ylabel() for ax in drawn(changed).axes] == ["links"]
    monkeypatch.setattr(OwnEffect, "figure", "no such figure")
    assert [ax.get_xlabel() for ax in drawn(changed).axes] == labels


def test_effects_of_the_map_are_drawn_on_it(small_scene, tmp_path):
    index, rng = links(len(small_scene.device_m)), np.random.default_rng(1)
    x_min, x_max, y_min, y_max = small_scene.config.extent.bounds
    receiver_m = np.column_stack([rng.uniform(x_min, x_max, len(index[0])), rng.uniform(y_min, y_max, len(index[0])),
                                  np.full(len(index[0]), 60.0)])
    data = measured(small_scene.device_m, receiver_m, index)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radiotwin.closeloop.run.catalogue", tuple)
        loop = close_loop(data, small_scene, "log-distance")
    for effect, params in ((registry.RemovedObstacle, {"building": 0, "centre_m": [0.0, 0.0, 9.0]}),
                            (registry.WallReflection, {"strength_db": 0.0, "level_db": 0.0})):
        changed = with_model(loop, with_effect(loop.before, effect, params))
        data = collect(changed)
        place = {"family": "place", "members": {"device": data.links.device_names[1:2]}, "ranges": {"x_m": [25.0, 50.0], "y_m": [0.0, 25.0]}}
        figure = residual_map_figure(data, MapBackground(data.links, small_scene), {"effects": [], "anomalies": [place]})
        before, after, *_ = figure.axes  # then colour bars
        assert [part.bbox.width for part in figure.subfigs] == [figure.bbox.width / 2] * 2, "a page shows one half of it"
        frames = [[line.get_xydata() for line in ax.lines if line.get_linestyle() == "--"] for ax in (before, after)]
        assert [len(each) for each in frames] == [1, 1]
        rings = [each for each in before.collections if each.get_label() == "device that it is about"]
        assert rings[0].get_offsets().tolist() == data.links.device_m[1:2, :2].tolist()
        assert frames[0][0].min(axis=0).tolist() == [25.0, 0.0] and frames[0][0].max(axis=0).tolist() == [50.0, 25.0]
        save(drawn(changed, small_scene), tmp_path / "effect.png")
        assert (tmp_path / "effect.png").stat().st_size > 5000


def test_errors_in_the_steps_are_of_the_links_that_the_base_predicts(loop):
    content = make_report(loop)
    content["error"]["after_same_links"] = content["error"]["after"] | {"rmse_db": 0.5}
    title = waterfall_figure(content).axes[0].get_title()
    assert f"{content['error']['before']['rmse_db']:.2f} → 0.50 dB" in title


def test_means_of_bins_and_their_errors():
    rng = np.random.default_rng(0)
    value = rng.uniform(0, 100, 4000)
    level = bin_index(value, 10)
    assert np.bincount(level).min() >= 399 and level.max() == 9
    found = bin_means(level, value, 0.1 * value + rng.normal(0, 1.0, 4000), np.arange(4000))
    assert found.mean == pytest.approx(0.1 * found.at, abs=0.25)
    assert found.error == pytest.approx(np.hypot(1.0, 1 / np.sqrt(12)) / 20, rel=0.15)
    # Links that err as one: no more is known from ten times as many.
    alike = np.repeat(rng.normal(0, 1.0, 400), 10)
    zeros = np.zeros(4000, dtype=int)
    assert bin_means(zeros, value, alike, np.repeat(np.arange(400), 10)).error[0] == pytest.approx(1 / 20, rel=0.15)
    assert list(bin_index(np.array([50.0, 70.0, 50.0, 60.0]), 10)) == [0, 2, 0, 1]


