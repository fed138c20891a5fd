"""Generated missions: what is seen over the boxes is what is seen over their meshes."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.presets import CityParameters, building_meshes, draw_buildings
from studies.generated import _lowest_sight_m, generated_mission, redrawn


def test_sight_over_boxes_is_that_over_their_meshes():
    devices_m = np.array([[40.0, 60.0, 1.5], [151.0, 199.0, 1.5]])
    parameters = CityParameters(300.0, 300.0, avenue_width_m=60.0, avenue_spacing_m=200.0, street_width_m=20.0, block_mean_m=100.0,
                                block_min_m=80.0, side_min_m=60.0, mean_height_m=20.0, first_block_m=(-50.0, -50.0))
    boxes = draw_buildings(parameters, devices_m[:, :2], 1)
    solid = trimesh.util.concatenate(building_meshes(boxes))
    city = CityMap(solid.vertices, solid.faces)
    cells_m = np.random.default_rng(0).uniform(0, 300, (400, 2))
    for device_m in devices_m:
        lowest_m = _lowest_sight_m(boxes, cells_m, device_m)
        for altitude_m in (35.0, 60.0):
            ends_m = np.column_stack([cells_m, np.full(len(cells_m), altitude_m)])
            seen = city.line_of_sight(ends_m, device_m[None])
            above = ends_m[:, 2] > lowest_m
            assert 0.1 < seen.mean() and (above == seen).mean() > 0.995  # single precision at edges


@pytest.mark.parametrize("seed", range(4))
def test_a_mission_that_is_drawn_again_keeps_the_city(seed):
    city = generated_mission(2, devices=8, side_m=(300.0, 400.0))
    drawn = redrawn(city, np.random.default_rng(seed))
    rows, columns = drawn.snr_db.shape[2:]
    for k, device_m in enumerate(drawn.known_m):
        same = [j for j in range(8) if np.array_equal(np.sort(drawn.snr_db[0, k].ravel()), np.sort(city.snr_db[0, j].ravel()))]
        assert len(same) == 1
        at = np.unravel_index(drawn.snr_db[0, k].argmax(), (rows, columns))
        near = np.unravel_index(city.snr_db[0, same[0]].argmax(), city.snr_db.shape[2:])
        one = np.hypot(*(device_m - np.array(at[::-1]) * 20.0))
        other = np.hypot(*(city.known_m[same[0]] - np.array(near[::-1]) * 20.0))
        assert one == pytest.approx(other)
    assert 6 <= drawn.devices <= 8 and (drawn.steps_home[0][tuple(drawn.start[0])] * 2 <= drawn.battery).all()
