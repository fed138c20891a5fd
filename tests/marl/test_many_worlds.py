"""Flights side by side, each in a world of its own: the same as one environment for each."""

import numpy as np
import pytest

from marl.environment import Environment, ManyWorlds, observe
from radiotwin.errors import BadInput
from studies.generated import redrawn


def test_many_worlds_are_as_many_environments(city):
    rng = np.random.default_rng(0)
    missions = [redrawn(city, rng) for _ in range(5)]
    calm = [each._replace(sigma_db=np.zeros_like(each.sigma_db)) for each in missions]
    worlds = ManyWorlds([calm[0], *calm[:4]], 5, rng)
    worlds.put(0, calm[4])
    alone = [Environment(each, 1, rng) for each in (calm[4], *calm[:4])]
    for each in alone:
        each.reset()
    for _ in range(max(each.longest for each in calm)):
        action = np.full((5, 5), 5)
        for world, each in enumerate(alone):
            _, mask = observe(each.mission, each.frame)
            chance = rng.random(mask[0].shape) * mask[0]
            action[world, :each.mission.uavs] = chance.argmax(axis=1)
        together = worlds.step(action)
        for world, each in enumerate(alone):
            uavs = each.mission.uavs
            np.testing.assert_array_equal(together[world, :uavs], each.step(action[world:world + 1, :uavs])[0])
            np.testing.assert_array_equal(worlds.battery[world, :uavs], each.frame.battery[0])
            assert not together[world, uavs:].any() and not worlds.battery[world, uavs:].any()
            for one, other in zip(worlds.frames[world], each.frame):
                np.testing.assert_array_equal(one, other)
    assert not worlds.battery.any()


def test_a_mission_whose_shadowing_lasts_is_refused(city):
    with pytest.raises(BadInput, match="shadowing_share = 0.5"):
        ManyWorlds([redrawn(city, np.random.default_rng(0))._replace(shadowing_share=0.5)], 5, np.random.default_rng(0))
