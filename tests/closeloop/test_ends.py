"""Whom a candidate belongs to."""

import numpy as np
import pytest

from radiotwin.closeloop.search.scoring import ends_of
from radiotwin.effects import registry
from radiotwin.effects.antennas import SectorPattern
from radiotwin.links import prepare_links


@pytest.mark.parametrize("effect, params, coefficients, devices, receivers", [
    (registry.DeviceGainOffset(), {"members": [0, 1, 2], "offsets_sd_db": 3.0}, [0.1, -4.0, 0.3], ["d1"], []),
    (registry.ReceiverGainOffset(), {"members": [0], "offsets_sd_db": 3.0}, [2.0], [], ["r0"]),
    (registry.DevicePositionError(), {"device": 2, "move_m": (3.0, 4.0)}, [], ["d2"], []),
    (registry.ReceiverClockOffset(), {"receiver": 1, "offset_s": 2.0, "speed_m_s": 10.0}, [], [], ["r1"]),
    (registry.SectorAntenna(), {"devices": {0: SectorPattern(), 2: SectorPattern()}}, [0.0, 0.0], ["d0", "d2"], []),
    (registry.Foliage(), {"box": (0.0, 0.0, 9.0, 9.0, 9.0, 0.0)}, [], [], [])])
def test_names_are_of_the_ends_that_parameters_belong_to(open_ground, effect, params, coefficients, devices, receivers):
    links = prepare_links(open_ground.measured(open_ground.fly(0)), None)
    names = {"d": list(links.device_names), "r": list(links.receiver_names)}
    expected = [tuple(names[each[0]][int(each[1:])] for each in ends) for ends in (devices, receivers)]
    assert list(ends_of(effect.with_params(effect.Params(**params)), np.array(coefficients), links)) == expected
