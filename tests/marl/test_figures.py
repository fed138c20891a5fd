"""Figures of a run."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from PIL import Image

from marl.environment import Environment
from marl.figures import (
    MAX_IMAGES,
    curve_figure,
    draw_curve,
    save,
    save_animation,
    trajectories_figure,
)
from marl.flights import fly
from marl.heuristics import HeuristicPolicy
from marl.mission import Known

ROWS = [{"real_episodes": real, "truth_ratio": ratio, "truth_ratio_std": 0.02} for real, ratio in
        ((0, 0.1), (1, 0.5), (10, 0.8))]


def flown(mission, flights=3):
    rng = np.random.default_rng(0)
    return fly(Environment(mission, flights, rng), HeuristicPolicy("greedy", rng))


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def test_trajectories_have_a_panel_a_uav_and_a_segment_a_slot(small_scene, city_mission, tmp_path):
    flights, known = flown(city_mission), Known.truth(small_scene)
    figure = trajectories_figure(small_scene, city_mission, flights, 1, known)
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title().split(",")[0] for axes in panels] == ["uav0", "uav1"]
    for u, axes in enumerate(panels):
        segments = next(artist for artist in axes.collections if isinstance(artist, LineCollection)).get_segments()
        assert len(segments) == (flights.frames.battery[1, :, u] > 0).sum() - 1
        start = small_scene.config.uavs[u]
        assert np.hypot(*(segments[0][0] - [start.start_x_m, start.start_y_m])) < city_mission.step_m / 2
    save(figure, tmp_path / "trajectories.png")
    assert is_png(tmp_path / "trajectories.png")


@pytest.mark.parametrize("located", ["all", "none"])
def test_estimates_are_drawn_for_located_unknown_devices_only(small_scene, city_mission, located):
    known = Known.truth(small_scene) if located == "all" else Known.anchors(small_scene)
    axes = trajectories_figure(small_scene, city_mission, flown(city_mission), 0, known).axes[0]
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    unknown = sum(device.role == "unknown" for device in small_scene.config.devices)
    assert len(crosses) == (unknown if located == "all" else 0)


def test_the_curve_has_a_logarithmic_axis_and_every_curve_and_level(tmp_path):
    figure = curve_figure({"a": ROWS, "b": ROWS}, {"planner": 0.9, "random": 0.3})
    axes = figure.axes[0]
    assert axes.get_xscale() == "log"
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["a", "b", "planner: 0.90", "random: 0.30"]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1, 10])  # zero has no place on this axis
    draw_curve({"a": ROWS}, {}, tmp_path / "curve.png")
    assert is_png(tmp_path / "curve.png")


def test_the_curve_of_a_run_without_real_episodes_is_drawn(tmp_path):
    draw_curve({"a": ROWS[:1]}, {"planner": 0.9}, tmp_path / "curve.png")
    assert is_png(tmp_path / "curve.png")


def test_an_animation_has_an_image_every_few_slots(small_scene, city_mission, tmp_path):
    flights = flown(city_mission)
    save_animation(small_scene, city_mission, flights, 1, tmp_path / "flight.gif")
    with Image.open(tmp_path / "flight.gif") as film:
        length = flights.length[1]
        assert film.is_animated and film.n_frames == -(-length // -(-length // MAX_IMAGES))
