"""A scene that can be traced without LLVM: a law in place of Sionna RT."""

import shutil
from typing import ClassVar

import numpy as np
import pytest

from radiotwin.scene import Scene
from radiotwin.trace.solver import IMPOSSIBLE_DB


@pytest.fixture
def own_scene(small_scene, tmp_path):
    """A copy of `preset:small` whose cache belongs to one test."""
    folder = tmp_path / "scene"
    shutil.copytree(small_scene.folder, folder, ignore=shutil.ignore_patterns("cache"))
    return Scene.load(folder)


@pytest.fixture
def law(monkeypatch, small_scene):
    """Stands in for `PathGains`: free space, 25 dB less without LoS, no path there beyond 250 m. Counts its calls."""

    class Law:
        calls = 0
        offset_db = 0.0
        impossible_m: ClassVar[list] = []  # receivers of links that stay above what their paths carry

        def __init__(self, xml_path, frequency_hz, settings):
            self.settings = settings
            self.step = settings.batch_receivers
            self.wavelength_m = 299_792_458.0 / frequency_hz

        def batches(self, n):
            return [slice(start, min(start + self.step, n)) for start in range(0, n, self.step)]

        def solve(self, device_m, points_m, antennas=(None, None)):
            Law.calls += 1
            distance_m = np.linalg.norm(points_m - device_m, axis=1)
            los = small_scene.city.line_of_sight(device_m[None], points_m)
            gain_db = 20 * np.log10(self.wavelength_m / (4 * np.pi * distance_m)) - 25 * ~los + Law.offset_db
            gain_db = np.where(~los & (distance_m > 250), np.nan, gain_db)
            return np.where([point_m.tolist() in Law.impossible_m for point_m in points_m], IMPOSSIBLE_DB, gain_db)

        def gains(self, device_m, points_m, antennas=(None, None)):
            return np.concatenate([self.solve(device_m, points_m[part], antennas)
                                   for part in self.batches(len(points_m))])

    monkeypatch.setattr("radiotwin.trace.link_job.PathGains", Law)
    return Law
