"""Every format of a city through the real command line: into a scene, out of it and in again."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from tests.fuzz.honest import write_maps
from tests.scene.readers import test_multipatches

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
SQUARE = (50.0015, 8.0015)  # the building of `write_maps`
CITIES = {
    **dict.fromkeys([f"town.{suffix}" for suffix in ("json", "geojson", "gpkg", "parquet", "shp", "zip")], ("", SQUARE)),
    "town.osm.pbf": ("", (47.5, 8.7)), "town.city.json": ("", (52.0, 4.37)), "town.gml": ("", (48.15, 11.57)),
    "multi.shp": ("", (47.5, 8.7)), "roof.obj": ("--origin 48.1,11.5", (48.1, 11.5)),
    **dict.fromkeys(["city.xml", "box.glb", "box.gltf", "box.stl", "box.ply"], ("", None)), }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    write_maps(folder)
    test_multipatches.write(folder, *test_multipatches.house())
    for path in folder.glob("a.*"):
        path.rename(path.with_stem("multi"))
    return folder


@pytest.mark.parametrize("name", CITIES)
def test_a_file_becomes_a_scene(run, folder, tmp_path, name):
    options, where = CITIES[name]
    result = run(f"build-scene {folder / name} -o scene {options}", cwd=tmp_path)
    assert result.returncode == 0 and "wrote scene: " in result.stdout, result.stderr
    config = tomllib.loads((tmp_path / "scene" / "scene.toml").read_text())
    if where is None:
        assert "origin" not in config
    else:
        assert (config["origin"]["latitude_deg"], config["origin"]["longitude_deg"]) == pytest.approx(where, abs=0.01)


def test_options_of_a_map(run, tmp_path):
    box = "--bbox 47.4998,8.699,47.5002,8.7001 --height-default 7 --material straw=wood --devices 1 --origin 47.5,8.7,440"
    result = run(f"build-scene {TOWN} -o scene {box}", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "heights from" in result.stdout and "default: 1 (7 m)" in result.stdout
    assert "wrote scene: buildings.csv, city.xml, meshes/, preview.png, scene.toml" in result.stdout
    text = (tmp_path / "scene" / "scene.toml").read_text()
    assert "latitude_deg = 47.5\n" in text and "altitude_m = 440.0" in text
    assert len(pd.read_csv(tmp_path / "scene" / "buildings.csv")) >= 1


def triangles(folder):
    """Each shape's triangles, in an order of their own [0.1 mm]."""
    found = {}
    for path in (folder / "meshes").glob("*.ply"):
        corners = np.round(trimesh.load(path, process=False).triangles, 4)
        turned = [np.roll(each, -np.lexsort(each.T[::-1])[0], axis=0) for each in corners]
        found[path.stem] = np.array(sorted(np.array(turned).reshape(-1, 9).tolist()))
    return found


def materials(folder):
    text = (folder / "city.xml").read_text()
    return dict(re.findall(r'<shape type="ply" id="mesh-([^"]+)">.*?<ref id="mat-([^"]+)"', text, re.DOTALL))


@pytest.mark.parametrize("out", ["again", "again.glb", "again.gltf", "again.obj"])
def test_what_is_exported_can_be_read_again(run, tmp_path, out):
    assert run(f"build-scene {TOWN} -o scene --height-default 9", cwd=tmp_path).returncode == 0
    assert run(f"export-scene scene -o {out}", cwd=tmp_path).returncode == 0
    config = tomllib.loads((tmp_path / "scene" / "scene.toml").read_text())
    origin = f"{config['origin']['latitude_deg']},{config['origin']['longitude_deg']}"
    city = f"{out}/city.xml" if out == "again" else out
    result = run(f"build-scene {city} -o scene2 --origin {origin}", cwd=tmp_path)
    assert result.returncode == 0 and "No problems found." in result.stdout, result.stdout + result.stderr
    first, second = triangles(tmp_path / "scene"), triangles(tmp_path / "scene2")
    assert first.keys() == second.keys() and len(first) > 10
    for name in first:
        assert first[name].shape == second[name].shape and np.abs(first[name] - second[name]).max() <= 2e-4, name
    assert materials(tmp_path / "scene") == materials(tmp_path / "scene2")
    again = tomllib.loads((tmp_path / "scene2" / "scene.toml").read_text())
    assert again["origin"] == config["origin"] and again["crs"] == config["crs"]


def test_a_box_in_a_map_leaves_out_what_is_told_of_the_rest(run, tmp_path):
    result = run(f"build-scene {TOWN} -o scene", cwd=tmp_path)
    assert "way/116" in result.stdout and "not closed" in " ".join(result.stdout.split())
    result = run(f"build-scene {TOWN} -o part --bbox 47.49979,8.69962,47.49985,8.69985", cwd=tmp_path)
    assert result.returncode == 0 and "No problems found." in result.stdout, result.stdout
