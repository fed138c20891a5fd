"""Figures whose names come from a file."""

import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import map_figures
from radiotwin.twin import TwinDevice


@pytest.mark.parametrize("name", [r"$\frac{$", "$$", "a\x1b[2J\u202e\0b", "x" * 100_000, "\ufeff", "\n\n"])
def test_any_name_can_be_drawn(small_scene, tmp_path, name):
    step = small_scene.lattice
    level_db = np.full((1, *step.shape), -80.0)
    radio_map = RadioMap.build([name], step, level_db, level_db < 0)
    radio_map.dataset.attrs["source"] = name
    map_figures.write_picture(radio_map, small_scene, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_says_what_it_shows_in_the_unit_that_was_measured(small_scene):
    level_db = np.full((2, *small_scene.lattice.shape), -80.0)
    level_db[0, 0, 0, 0] = np.nan
    radio_map = RadioMap.build(["a", "b"], small_scene.lattice, level_db, level_db < 0)
    devices = [TwinDevice("a", 10.0, 20.0, 1.5, "anchor", True, 0.0, None),
               TwinDevice("b", 5.0, 5.0, 1.5, "unknown", True, 1e4, None)]
    gain = map_figures._radio_map_figure(radio_map, small_scene, ())
    assert gain.axes[-1].get_ylabel() == "channel gain [dB]"
    radio_map.dataset.attrs["tx_power_dbm"] = 20.0
    power = map_figures._radio_map_figure(radio_map, small_scene, devices)
    assert power.axes[-1].get_ylabel() == "received power [dBm]" and power.axes[0].images[0].get_array().max() == -60.0
    assert [text.get_text() for text in power.legends[0].get_texts()] == [
        "device, declared", "device, located", "holds it with 90 %", "building", "not detected"]
    assert power.axes[0].get_xlim() == power.axes[1].get_xlim(), "a large circle leaves the map as it is"


def test_a_full_disk_is_one_error(tmp_path):
    code = ("from radiotwin.report import labels; from radiotwin.errors import RunFailed\n"
            "figure = labels.new_figure(4, 4); figure.add_subplot().plot([1, 2])\n"
            "try:\n    labels.save(figure, 'figure.png')\nexcept RunFailed as error:\n    print(error)")
    (tmp_path / "figure.png").write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=os.environ,
                          preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)))
    assert "cannot write figure.png" in done.stdout, done.stderr
    assert (tmp_path / "figure.png").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
