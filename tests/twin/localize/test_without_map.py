"""Devices are located by a channel with effects: where they are, how surely, and better than without the effects."""


import numpy as np
import pytest

from radiotwin.closeloop.run import close_loop
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.links import prepare_links
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.localize.without_map import locate
from radiotwin.twin.model.model import FittedModel
from tests.worlds import shortened

AREA_M = (-200.0, 700.0, -200.0, 700.0)


def errors_m(model, links, truth_m):
    found = locate(model, links, AREA_M)
    true_m = dict(zip(links.device_names, truth_m))
    return np.array([[np.hypot(each.x_m - true_m[each.device][0], each.y_m - true_m[each.device][1]), each.credible_radius_m]
                     for each in found])


def few_links(links, rng, count):
    rows = [rng.choice(np.flatnonzero(links.device == device), count, replace=False)
            for device in range(len(links.device_names))]
    return links.select(np.concatenate(rows))


class Counting(LogDistance):
    """The law of the open ground, and how many links it was asked for at once."""

    def __init__(self):
        super().__init__(LogDistanceLine(-35.0, 2.6, 2.0))
        self.asked = []

    def predict(self, links):
        self.asked.append(len(links))
        return super().predict(links)


def model_of(channel, effects=(), coefficients=(), device_sd_db=0.0):
    return FittedModel(channel, effects, coefficients, np.zeros(2), np.array([2.0]), 5.0, np.zeros((3, 3)), ("r0", "r1"), 0.0,
                       device_sd_db)


def alone(open_ground, seed):
    world = open_ground.fly(seed)
    links = prepare_links(open_ground.measured(world), None)
    own = links.select(np.flatnonzero(links.device == 4)[::18])
    return own.of_devices(np.zeros(40, int), world.device_m[4:], ["d4"], own.anchors), world.device_m[4]


def test_effects_of_devices_that_the_file_does_not_list_do_not_matter(open_ground):
    links, true_m = alone(open_ground, 14)
    offsets = DeviceGainOffset().with_params(DeviceGainOffset.Params(members=[0, 1, 2], offsets_sd_db=0.5))
    model = model_of(Counting(), (offsets,), (np.array([9.0, -9.0, 9.0]),))
    (found,) = locate(model, links, AREA_M)
    assert np.hypot(found.x_m - true_m[0], found.y_m - true_m[1]) <= found.credible_radius_m < 40


def test_few_links_at_once_find_the_same_position(open_ground, monkeypatch):
    links, found = alone(open_ground, 15)[0], []
    for most in (10**9, 1000):
        monkeypatch.setattr("radiotwin.twin.localize.without_map.LINKS_AT_ONCE", most)
        model = model_of(Counting(), device_sd_db=3.0)
        found += list(locate(model, links, AREA_M))
        assert max(model.channel.asked) <= most
    assert (found[1].x_m, found[1].y_m) == pytest.approx((found[0].x_m, found[0].y_m))
    assert found[1].credible_radius_m == pytest.approx(found[0].credible_radius_m)


@pytest.mark.slow
def test_what_is_known_of_receivers_brings_devices_nearer_and_the_radii_hold_nine_in_ten(open_ground):
    world = open_ground.fly(11)
    world.gain_db[world.receiver == 1] += 12.0
    with shortened():
        loop = close_loop(open_ground.measured(world), base="log-distance")
    before, after = (each.whole.learnt for each in (loop.before, loop.after))
    rng, results = np.random.default_rng(0), {"before": [], "after": []}
    for _ in range(12):
        part = few_links(loop.links, rng, 20)
        for name, model in (("before", before), ("after", after)):
            results[name].append(errors_m(model, part, world.device_m))
    before_m, after_m = (np.vstack(results[name]) for name in ("before", "after"))
    assert np.median(after_m[:, 0]) < 0.6 * np.median(before_m[:, 0])
    assert 0.75 <= (after_m[:, 0] <= after_m[:, 1]).mean() <= 1.0  # 60 positions: 0.9 +- 2 * 0.04, and the grid
    assert np.median(after_m[:, 1]) < 60.0
