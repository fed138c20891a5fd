"""Every format of a city through the real command line: into a scene, out of it and in again, and damaged ones."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh

from tests.scene.readers import city_models as made

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
SQUARE = np.array([[0, 0], [20, 0], [20, 20], [0, 20]]) + [691_000, 5_336_000]
HOUSES = [(0, 0, 1.2), (40, 0, 1.2)]


def write(folder, name):
    """Write a small made-up file of the format that its name says."""
    path = folder / name
    if name.endswith(".json"):
        path.write_text(json.dumps(made.cityjson(HOUSES)))
    elif name.endswith(".gml"):
        path.write_text(made.citygml([made.house(691_000 + x, 5_336_000, 500, f"H{x}") for x, _, _ in HOUSES]))
    elif name.endswith(".shp"):
        pyogrio.raw.write(path, shapely.to_wkb([shapely.Polygon(SQUARE), shapely.Polygon(SQUARE + 50)]),
                          [np.array([9.0, 12.0]), np.array([3, 4])], ["HGT", "SHAPE_ID"], geometry_type="Polygon",
                          crs="EPSG:25832", driver="ESRI Shapefile")
    else:
        boxes = [trimesh.creation.box(bounds=[[x, 0, 0], [x + 10, 12, 9]]) for x in (0, 40)]
        ground = trimesh.Trimesh([[-50, -50, 0], [90, -50, 0], [90, 90, 0], [-50, 90, 0]], [[0, 1, 2], [0, 2, 3]])
        mesh = trimesh.util.concatenate([ground, *boxes])
        if name.endswith(".glb"):
            mesh.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        mesh.export(path)
    return path


CITIES = {"a.city.json": "", "a.gml": "", "a.shp": "--height-column HGT", "a.obj": "--origin 48.1,11.5", "a.glb": "", "a.stl": "",
          "a.ply": ""}


@pytest.mark.parametrize("name", CITIES)
def test_a_file_becomes_a_scene(run, tmp_path, name):
    write(tmp_path, name)
    result = run(f"build-scene {name} -o scene {CITIES[name]}", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "wrote scene: " in result.stdout
    tallest = "12.0 m" if name == "a.shp" else "9.0 m"
    assert tallest in result.stdout
    config = tomllib.loads((tmp_path / "scene" / "scene.toml").read_text())
    where = {"a.city.json": (52.0, 4.37), "a.gml": (48.15, 11.57), "a.shp": (48.15, 11.57), "a.obj": (48.1, 11.5)}.get(name)
    if where is None:
        assert "origin" not in config
    else:
        origin = config["origin"]
        assert (origin["latitude_deg"], origin["longitude_deg"]) == pytest.approx(where, abs=0.01)


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


BAD = {
    "no known column": ("a.shp", "", ["none of its columns is known to hold heights", "'hgt', 'shape_id'"]),
    "another column": ("a.shp", "--height-column ROOF", ["has no column 'roof'; its columns are: ", "'hgt'"]),
    "ground only": ("a.shp", "--ground-column HGT", ["--ground-column is subtracted", "--height-column, too"]),
    "scale of a map": ("a.gml", "--scale 2", ["a.gml is a map: --scale cannot be used"]),
    "heights of a model": ("a.stl", "--height-column HGT", ["a.stl is not a map", "--height-column cannot be used"]),
    "an axis": ("a.glb", "--up w", ["up axis 'w' is not possible"]),
    "elsewhere": ("a.city.json", "--bbox 4,51,5,53", ["no building reaches into --bbox", "seem to be swapped: --bbox is LAT_MIN,LON_MIN"]),
    "another material": ("a.obj", "--material roof=metal", ["'roof' is to be replaced, but the city does not use it"]),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_options_are_one_message(run, tmp_path, what):
    name, options, parts = BAD[what]
    write(tmp_path, name)
    check(run(f"build-scene {name} -o scene {options}", cwd=tmp_path), tmp_path, parts)


@pytest.mark.parametrize("name", CITIES)
def test_a_file_that_is_cut_off_is_one_message(run, tmp_path, name):
    path = write(tmp_path, name)
    path.write_bytes(path.read_bytes()[:int(0.7 * path.stat().st_size)])
    if name == "a.obj":  # a text that may end anywhere
        path.write_bytes(path.read_bytes().rpartition(b"\n")[0] + b"\nf 1 2 999999\n")
    check(run(f"build-scene {name} -o scene {CITIES[name]}", cwd=tmp_path), tmp_path, [name])


def check(result, folder, parts):
    assert result.returncode == 2 and "Traceback" not in result.stderr, result.stderr
    assert result.stderr.count("radiotwin:") == 1
    for part in parts:
        assert part in " ".join(result.stderr.split()), result.stderr
    assert not (folder / "scene").exists()


def test_a_box_in_a_map_leaves_out_what_is_told_of_the_rest(run, tmp_path):
    result = run(f"build-scene {TOWN} -o scene", cwd=tmp_path)
    assert "way/116" in result.stdout and "not closed" in " ".join(result.stdout.split())
    result = run(f"build-scene {TOWN} -o part --bbox 47.49979,8.69962,47.49985,8.69985", cwd=tmp_path)
    assert result.returncode == 0 and "No problems found." in result.stdout, result.stdout
