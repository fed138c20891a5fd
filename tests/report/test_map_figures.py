"""Figures whose names come from a file."""

import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import map_figures


@pytest.mark.parametrize("name", [r"$\frac{$", "$$", "a\x1b[2J\u202e\0b", "x" * 100_000, "\ufeff", "\n\n"])
def test_any_name_can_be_drawn(small_scene, tmp_path, name):
    step = small_scene.lattice
    level_db = np.full((1, *step.shape), -80.0)
    radio_map = RadioMap.build([name], step, level_db, level_db < 0)
    radio_map.dataset.attrs["source"] = name
    map_figures.write_picture(radio_map, small_scene, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_full_disk_is_one_error(tmp_path):
    code = ("from radiotwin.report import labels; from radiotwin.errors import RunFailed\n"
            "figure = labels.new_figure(4, 4); figure.add_subplot().plot([1, 2])\n"
            "try:\n    labels.save(figure, 'figure.png')\nexcept RunFailed as error:\n    print(error)")
    (tmp_path / "figure.png").write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=os.environ,
                          preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)))
    assert "cannot write figure.png" in done.stdout, done.stderr
    assert (tmp_path / "figure.png").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
