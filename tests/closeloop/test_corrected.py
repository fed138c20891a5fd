"""The corrected twin is used with the map that it was made with."""

import numpy as np
import pytest

from radiotwin.channel.censored_line import LogDistanceLine
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.closeloop.corrected import corrected_model
from radiotwin.errors import BadInput
from radiotwin.twin import Twin, TwinDevice

LINE = LogDistanceLine(-40.0, -2.5, 2.0)


def twin(channel, classes):
    """As the loop saves it, of a law with a level and a slope for each class of line of sight."""
    effects = {"base": "twin", "coefficients": [0.0, 0.0] * classes, "dof": 5.0, "scale_db": [2.0] * classes,
               "receivers": [], "parts": [], "first_s": None, "device_spread_db": 0.0, "temper": 1.0}
    devices = [TwinDevice("a", 10.0, 10.0, 1.5, "anchor", True, 0.0, None)]
    return Twin(channel, devices, "gain_db", -110.0, {}, effects)


def test_a_map_is_neither_forgotten_nor_added(small_scene):
    with_map, without = (twin(SegmentedLogDistance(LINE, LINE), classes) for classes in (2, 1))
    with pytest.raises(BadInput, match="made with a 3D map .* give it with --scene"):
        corrected_model(with_map, None)
    with pytest.raises(BadInput, match="made without a 3D map"):
        corrected_model(without, small_scene)
    with pytest.raises(BadInput, match="made without a 3D map"):
        without.radio_map(small_scene)
    for same, scene in ((with_map, small_scene), (without, None), (twin(LogDistance(LINE), 1), small_scene)):
        assert len(corrected_model(same, scene).solution.coefficients) == len(same.effects["coefficients"])
    assert np.isfinite(with_map.radio_map(small_scene).gain_db).all()
