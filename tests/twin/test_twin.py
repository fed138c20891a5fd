"""One twin predicts links and maps, with the levels fitted upon its channel and the map that it was fitted with."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.twin import Twin, TwinDevice
from radiotwin.twin.compare import predict
from radiotwin.twin.model.model import FittedModel

LINE = LogDistanceLine(-40.0, 2.5, 2.0)


def twin(channel, classes):
    """Return a twin as close-loop makes it, of a law with a level and a slope for each class of line of sight."""
    device = TwinDevice.anchor("a", 10.0, 10.0, 1.5)
    fitted = FittedModel(channel, (), (), np.zeros(2 * classes), np.full(classes, 2.0), 5.0,
                         np.array([[10.0, 10.0, 1.5]]), (), np.nan, 0.0)
    return Twin(fitted, [device], "gain_db", -110.0)


def test_a_map_is_neither_forgotten_nor_added(small_scene):
    with_map, without = (twin(SegmentedLogDistance(LINE, LINE), classes) for classes in (2, 1))
    with pytest.raises(BadInput, match="made with a 3D map .* give it with --scene"):
        with_map.require_map(None)
    with pytest.raises(BadInput, match="made without a 3D map"):
        without.require_map(small_scene)
    with pytest.raises(BadInput, match="made without a 3D map"):
        without.radio_map(small_scene)
    for same, scene in ((with_map, small_scene), (without, None), (twin(LogDistance(LINE), 1), small_scene)):
        same.require_map(scene)
    assert np.isfinite(with_map.radio_map(small_scene).gain_db).all()


def test_fitted_levels_are_in_predictions_of_links_as_in_the_map(small_scene):
    flown = fly_survey(small_scene, segmented_truth(small_scene), flights=1, pattern="random-waypoint", seed=0,
                       noise_db=0.0)
    one = replace(twin(SegmentedLogDistance(LINE, LINE), 2), devices=[
        TwinDevice.anchor(row.device, row.x_m, row.y_m, row.z_m)
        for row in flown.devices.itertuples() if row.role == "anchor"], limit_db=None)
    shifted = replace(one, fitted=replace(one.fitted, level_coefficients=np.array([3.0, 0.0, -5.0, 0.0])))
    before_db, after_db = (predict(each, small_scene, flown) for each in (one, shifted))
    anchors = flown.is_anchor[flown.device_index]
    los = small_scene.city.line_of_sight(flown.device_m[flown.device_index], flown.receiver_m)
    np.testing.assert_allclose((after_db - before_db)[anchors], np.where(los, 3.0, -5.0)[anchors])
    lattice = small_scene.lattice
    cell = [np.abs(axis[:, None] - there).argmin(axis=0) for axis, there in
            zip((lattice.z_m, lattice.y_m, lattice.x_m), flown.receiver_m[anchors].T[::-1])]
    radio_map = shifted.radio_map(small_scene)
    names = flown.devices["device"].to_numpy()[flown.device_index[anchors]]
    at = np.array([radio_map.devices.index(name) for name in names]), *cell
    np.testing.assert_allclose(after_db[anchors], radio_map.gain_db[at], atol=1e-3)
