"""Devices are found by the corrected model: where they are, how surely, and better than by the uncorrected one."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.inference.censored_line import LogDistanceLine
from radiotwin.channel.log_distance import LogDistance
from radiotwin.closeloop.bases import FittedChannel
from radiotwin.twin.corrected import corrected_twin
from radiotwin.localize.without_map import Corrected, locate
from radiotwin.links.link_data import prepare_links
from radiotwin.inference.censored_regression import FitResult
from radiotwin.closeloop.run import close_loop
from radiotwin.effects.gain_offsets import DeviceGainOffset
from radiotwin.measurements import Measurements

COMMAND = Path(sys.executable).with_name("radiotwin")
AREA_M = (-200.0, 700.0, -200.0, 700.0)


def run(*words):
    return subprocess.run([str(word) for word in (COMMAND, *words)], capture_output=True, text=True, timeout=300)


def loop_of(world, open_ground):
    return close_loop(open_ground.measured(world), None, "log-distance", 0, lambda text: None)


def off_m(model, links, truth_m):
    places = list(locate(model, links, AREA_M))
    return np.array([[np.hypot(p.x_m - truth_m[p.device, 0], p.y_m - truth_m[p.device, 1]), p.radius_m]
                     for p in places])


def few_links(links, rng, links):
    """Every device with links of its own only, few of them."""
    rows = [rng.choice(np.flatnonzero(links.device == device), links, replace=False)
            for device in range(len(links.device_names))]
    return links.select(np.concatenate(rows))


class Counting(FittedChannel):
    """The law of the open ground, which is asked for so many links at once."""

    def __init__(self):
        super().__init__(LogDistance(LogDistanceLine(-35.0, -2.6, 2.0)), np.zeros((3, 3)))
        self.links = []

    def mean_db(self, links):
        self.links.append(len(links))
        return super().mean_db(links)


def alone(open_ground, seed):
    """40 links of one device, in a file that lists no other; and where it is."""
    world = open_ground.fly(seed)
    links = prepare_links(open_ground.measured(world), None)
    mine = links.select(np.flatnonzero(links.device == 4)[::18])
    return replace(mine, device=np.zeros(40, int), device_m=world.device_m[4:], device_names=["d4"]), world.device_m[4]


def test_effects_of_devices_that_the_file_does_not_list_do_not_matter(open_ground):
    links, there_m = alone(open_ground, 14)
    offsets = DeviceGainOffset(), {"members": [0, 1, 2], "spread_db": 0.5}
    model = Corrected(Counting(), [offsets], FitResult(np.array([0.0, 0, 9, -9, 9]), np.array([2.0]), np.nan), 5.0,
                      np.zeros((3, 3)), 0.0, 0.0)
    (place,) = locate(model, links, AREA_M)
    assert np.hypot(place.x_m - there_m[0], place.y_m - there_m[1]) <= place.radius_m < 40


def test_few_links_at_once_find_the_same_place(open_ground, monkeypatch):
    links, places = alone(open_ground, 15)[0], []
    for most in (10**9, 1000):
        monkeypatch.setattr("radiotwin.localize.without_map.LINKS_AT_ONCE", most, raising=False)
        model = Corrected(Counting(), [], FitResult(np.zeros(2), np.array([2.0]), np.nan), 5.0, np.zeros((3, 3)), 0.0,
                          3.0)
        places += list(locate(model, links, AREA_M))
        assert max(model.base.links) <= most
    assert (places[1].x_m, places[1].y_m) == pytest.approx((places[0].x_m, places[0].y_m))
    assert places[1].radius_m == pytest.approx(places[0].radius_m)


def test_what_is_known_of_receivers_brings_devices_nearer_and_the_radii_hold_nine_in_ten(open_ground):
    world = open_ground.fly(11)
    world.gain_db[world.receiver == 1] += 12.0
    loop = loop_of(world, open_ground)
    before = Corrected.of(loop.before.whole, loop.before.fits[0])
    after = Corrected.of(loop.after.whole, loop.after.fits[0])
    rng, results = np.random.default_rng(0), {"before": [], "after": []}
    for _ in range(12):
        part = few_links(loop.links, rng, 20)
        for name, model in (("before", before), ("after", after)):
            results[name].append(off_m(model, part, world.device_m))
    before_m, after_m = (np.vstack(results[name]) for name in ("before", "after"))
    assert np.median(after_m[:, 0]) < 0.6 * np.median(before_m[:, 0])
    assert 0.75 <= (after_m[:, 0] <= after_m[:, 1]).mean() <= 1.0  # 60 places: 0.9 +- 2 * 0.04, and the grid
    assert np.median(after_m[:, 1]) < 60.0


def test_the_command_finds_an_unknown_device_and_says_how_far_off_it_is(tmp_path, open_ground):
    world = open_ground.fly(12)
    world.gain_db[world.receiver == 0] -= 6.0
    data = open_ground.measured(world)
    hidden = data.devices.copy()
    hidden.loc[4, ["x_m", "y_m"]] = np.nan
    hidden.loc[4, "role"] = "unknown"
    Measurements(data.table, hidden).write(tmp_path / "flight" / "measurements.csv")
    data.devices.to_csv(tmp_path / "truth.csv", index=False)
    done = run("close-loop", tmp_path / "flight" / "measurements.csv", "-o", tmp_path / "loop")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "loop" / "closeloop.json").read_text())
    assert report["effects"][0]["name"] == "receiver_gain_offset"
    done = run("locate", tmp_path / "flight" / "measurements.csv", "--twin", tmp_path / "loop" / "twin",
                   "--truth", tmp_path / "truth.csv", "-o", tmp_path / "located.csv")
    assert done.returncode == 0, done.stderr
    place = pd.read_csv(tmp_path / "located.csv").iloc[0]
    assert place["device"] == "d4" and place["links"] == 720
    assert np.hypot(place["x_m"] - world.device_m[4, 0], place["y_m"] - world.device_m[4, 1]) < 15.0
    assert "wrote" in done.stdout and "How far off" in done.stdout


@pytest.mark.parametrize("role, twin, message", [
    ("anchor", "loop/twin", "role unknown"), ("unknown", "nowhere", "not a twin")])
def test_bad_input_is_one_message(tmp_path, open_ground, role, twin, message):
    data = open_ground.measured(open_ground.fly(13))
    data.write(tmp_path / "flight" / "measurements.csv")
    if role == "anchor":
        loop = close_loop(data, None, "log-distance", 0, lambda text: None)
        corrected_twin(loop, None).save(tmp_path / "loop" / "twin")
    done = run("locate", tmp_path / "flight" / "measurements.csv", "--twin", tmp_path / twin,
                   "-o", tmp_path / "located.csv")
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "located.csv").exists()
