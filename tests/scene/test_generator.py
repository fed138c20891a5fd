"""Generated cities: published parameters kept, closed buildings, one seed one city."""

import numpy as np
import pytest

from radiotwin.scene.presets import PRESETS, building_meshes, draw_buildings, preset_boxes


@pytest.mark.parametrize("name", PRESETS)
def test_a_generated_city_keeps_its_parameters(name):
    preset = PRESETS[name]
    boxes, city = preset_boxes(name), preset.city
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2] <= city.width_m).all() and (boxes[:, 3] <= city.depth_m).all()
    assert (boxes[:, 2:4] - boxes[:, :2] >= city.side_kept_m - 0.02).all()
    assert boxes[:, 4].min() >= city.min_height_m and boxes[:, 4].max() <= city.max_height_m
    for x_m, y_m in preset.devices_m:
        gap_x = np.maximum(boxes[:, 0] - x_m, x_m - boxes[:, 2])
        gap_y = np.maximum(boxes[:, 1] - y_m, y_m - boxes[:, 3])
        assert np.maximum(gap_x, gap_y).min() >= city.clearance_m - 0.02


def test_generated_buildings_are_closed_and_a_seed_gives_them_again():
    preset = PRESETS["small"]
    free = np.array(preset.devices_m, dtype=float)
    first, again, other = (draw_buildings(preset.city, free, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)
    meshes = building_meshes(first)
    assert all(mesh.is_watertight and mesh.volume > 0 for mesh in meshes)


def test_mean_height_follows_its_law():
    """Mean of clip(min(Exp(15), |N| · 3 √35 + 15), 5, 50), integrated here, against 30 drawn cities."""
    rng = np.random.default_rng(5)
    drawn = np.clip(np.minimum(rng.exponential(15, 10**6),
                               np.abs(rng.normal(size=10**6)) * 3 * np.sqrt(35) + 15), 5, 50)
    heights = np.concatenate([draw_buildings(PRESETS["rbm"].city, np.empty((0, 2)), seed)[:, 4] for seed in range(30)])
    standard_error = heights.std() / np.sqrt(len(heights))
    assert abs(heights.mean() - drawn.mean()) < 4 * standard_error
