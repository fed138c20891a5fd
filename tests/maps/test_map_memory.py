"""Maps larger than memory: a process that takes less than a third of one writes, exports and shows it."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from radiotwin.maps.file import MapStream, write_parts
from radiotwin.scene import Scene

pytest.importorskip("zarr", reason="the package zarr is not installed")
DEVICES, LIMIT_BYTES = 100, 40 * 2**20
CHILD = r"""
import re, sys
from pathlib import Path
from radiotwin.maps.export import geotiff
from radiotwin.coverage import CoverageSettings, predict_coverage
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import export_map, folders, read_run, viewer_data
from radiotwin.scene import Scene

folders.OVERVIEW_LINKS = 500_000
geotiff._WHOLE_VALUES, geotiff.GDAL_OPTIONS["GDAL_CACHEMAX"] = 0, 2**23

def peak_bytes():  # of this program; getrusage has that of the one which started it, too
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])

def work(folder):
    scene = Scene.load(folder / "scene")
    with RadioMap.open(folder / "map.nc") as radio_map:
        export_map(radio_map, scene, folder / "map.tif", altitudes_m=[55.0])
        radio_map.save(folder / "again.zarr")
    with RadioMap.open(folder / "again.zarr") as radio_map:
        found = predict_coverage(radio_map, scene, settings=CoverageSettings(tx_power_dbm=20.0))
        assert found.summary["cells"] > 0
    run = read_run(folder, folder / "scene")
    assert viewer_data.map_layers(run) and set(run.maps) == {"again", "map"}

work(Path(sys.argv[1]))  # what libraries take is not the map's
before = peak_bytes()
work(Path(sys.argv[2]))
print(peak_bytes() - before)
"""


def make(folder, small_scene, devices, step_m):
    shutil.copytree(small_scene.folder, folder / "scene", ignore=shutil.ignore_patterns("cache", "truth*"))
    toml = folder / "scene" / "scene.toml"
    toml.write_text(toml.read_text().replace("step_m = 20.0", f"step_m = {step_m}"))
    lattice = Scene.load(folder / "scene").lattice

    def values(device, part):
        shape = part.shape
        return {"gain_db": np.full(shape, -80.0), "los": np.ones(shape, bool), "sigma_db": np.full(shape, 3.0)}

    stream = MapStream([f"m{i}" for i in range(devices)], lattice, {}, ("gain_db", "los", "sigma_db"), values)
    kinds = {"gain_db": np.dtype("f4"), "los": np.dtype(bool), "sigma_db": np.dtype("f4")}
    write_parts(stream.header, kinds, stream.blocks(), folder / "map.nc")
    return 9 * devices * int(np.prod(lattice.shape))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the unit of the peak of the memory is that of Linux")
def test_a_map_three_times_the_memory(small_scene, tmp_path):
    make(tmp_path / "small", small_scene, 2, 10.0)
    assert make(tmp_path / "large", small_scene, DEVICES, 1.0) > 3 * LIMIT_BYTES
    environment = os.environ | {"MALLOC_ARENA_MAX": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", CHILD, tmp_path / "small", tmp_path / "large"],
                          capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) < LIMIT_BYTES  # above what it had taken for a small map
