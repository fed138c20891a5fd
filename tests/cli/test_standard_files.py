"""Exports through the real command line: scenes, maps, gains at points; and bad requests."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from tests.worlds import placed


@pytest.fixture
def folder(small_scene, tmp_path):
    """A folder with a scene that has an origin, and a radio map of it."""
    placed(small_scene).save(tmp_path / "scene")
    lattice = small_scene.lattice
    gain_db = -60 - np.arange(2 * np.prod(lattice.shape)) / 100
    radio_map = RadioMap.build(["d0", "d1"], lattice, gain_db, gain_db > -70, attributes={"source": "test"})
    radio_map.save(tmp_path / "map.nc")
    return tmp_path


def test_paths_out(run, folder):
    (folder / "points.csv").write_text("x_m,y_m,z_m\n40,40,55\n10,30,30\n")
    result = run("paths scene --points points.csv --devices d1 --velocity 0,5,0 --bandwidth-hz 1e7 -o out/paths.nc",
                 cwd=folder)
    assert result.returncode == 0 and "paths of 2 links" in result.stdout, result.stderr
    with xr.open_dataset(folder / "out" / "paths.nc") as listed:
        assert listed.sizes["link"] == 2 and listed["path_count"].sum() == listed.sizes["path"] > 2
        assert listed.attrs["bandwidth_hz"] == 1e7 and "doppler_hz" in listed


def test_a_part_of_a_map(run, folder):
    result = run("map map.nc --scene scene -o part.csv --devices d1 --altitudes 60", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "wrote part.csv: 1 device, 1 altitude of 16 by 16 positions" in result.stdout


def test_a_name_that_is_not_ascii(run, folder):
    result = run("export-scene scene -o 'Stadt Köln.obj'", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "mtllib Stadt Köln.mtl" in (folder / "Stadt Köln.obj").read_text("utf-8")


def test_a_map_of_another_scene_is_warned_of_and_one_of_another_place_is_refused(run, folder):
    radio_map = RadioMap.load(folder / "map.nc")
    for hash_, latitude_deg, status, arguments in (
            (Scene.load(folder / "scene").content_hash(), 47.5, 0, ""),
            ("another", 47.5, 0, "was made for another scene than scene"),
            ("another", 40.0, 2, "latitude_deg is 40, that of scene is 47.5")):
        radio_map.dataset.attrs |= {"scene_hash": hash_, "origin_latitude_deg": latitude_deg}
        radio_map.save(folder / "other.nc")
        result = run("map other.nc --scene scene -o other.tif", cwd=folder)
        assert result.returncode == status and arguments in " ".join(result.stderr.split()), result.stderr
        assert bool(result.stderr.strip()) == bool(arguments) and (folder / "other.tif").exists() == (status == 0)
        (folder / "other.tif").unlink(missing_ok=True)


@pytest.mark.llvm
def test_gains_at_points(run, folder):
    (folder / "points.csv").write_text("x_m,y_m,z_m\n80,60,30\n80,40,1.5\n80,60,-3\n80,60,200\n")
    base = "gains scene --points points.csv --devices d0 --quality fast"
    for way in ("power", "coherent"):
        result = run(f"{base} --sum {way} -o {way}.csv", cwd=folder)
        assert result.returncode == 0, result.stderr
        assert "4 links, 2 with a gain" in result.stdout and "1 below the ground" in result.stdout
    power, coherent = (pd.read_csv(folder / f"{way}.csv", keep_default_na=False) for way in ("power", "coherent"))
    assert power["reason"].tolist() == ["", "within a wavelength", "below the ground", ""]
    scene = Scene.load(folder / "scene")
    distance_m = np.linalg.norm(np.array([[80, 60, 30], [80, 60, 200]]) - scene.device_m[0], axis=1)
    free_db = 20 * np.log10(299_792_458 / (4 * np.pi * 2.4e9 * distance_m))
    gain_db = power.loc[[0, 3], "gain_db"].astype(float).to_numpy()
    assert (gain_db > free_db - 0.1).all() and (gain_db < free_db + 6).all()  # with the ground and walls
    assert (coherent["gain_db"] != power["gain_db"])[[0, 3]].all()
