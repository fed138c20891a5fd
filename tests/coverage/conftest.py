"""Open ground on the globe, and twins whose law is a formula that the tests know."""

import math

import numpy as np
import pytest
import trimesh

from radiotwin.propagation.laws.log_distance import LogDistance, LogDistanceLine
from radiotwin.scene import Scene
from radiotwin.scene.config import parse_config, write_config
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import itu_material
from radiotwin.twin import Twin
from radiotwin.twin.localize import TwinDevice
from radiotwin.twin.model.model import FittedModel
from tests.terrains import terrain_map

FREQUENCY_HZ = 2e9
FREE_SPACE_AT_1_M_DB = 20 * math.log10(299_792_458.0 / FREQUENCY_HZ / (4 * math.pi))


def write_scene(folder, shapes=(), devices=(), half_m=500.0, ground_z_m=lambda x, y: 0.0, terrain=False,
                ground="concrete", **radio):
    """Write a scene of flat or tilted ground, or of a terrain, with other shapes on it, about 47.5 N, 8.7 E."""
    corners = [(x, y, ground_z_m(x, y)) for x, y in ((-600, -600), (600, -600), (600, 600), (-600, 600))]
    mesh = trimesh.Trimesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)
    if terrain:
        hills = terrain_map(ground_z_m, half_m=600.0, tolerance_m=0.1)
        mesh = trimesh.Trimesh(hills.vertices, hills.faces, process=False)
    folder.mkdir(parents=True)
    write_city(folder, [CityShape("ground", mesh, itu_material(ground)),
                        *(CityShape(f"house{i}", shape, itu_material("concrete")) for i, shape in enumerate(shapes))])
    config = {"name": "open", "origin": {"latitude_deg": 47.5, "longitude_deg": 8.7},
              "radio": {"frequency_hz": FREQUENCY_HZ, "tx_power_dbm": 30.0, "bandwidth_hz": 10e6, "noise_dbm": -95.0} | radio,
              "extent": {"x_min_m": -half_m, "x_max_m": half_m, "y_min_m": -half_m, "y_max_m": half_m},
              "lattice": {"step_m": 50.0, "altitudes_m": [1.5]},
              "devices": [{"device": name, "x_m": x, "y_m": y, "z_m": z} for name, x, y, z in devices]}
    if terrain:
        config["terrain"] = {"shape": "ground"}
    write_config(parse_config(config, "scene.toml"), folder / "scene.toml")
    return Scene.load(folder)


def make_twin(devices, exponent=2.0, intercept_db=FREE_SPACE_AT_1_M_DB, sd_db=1e-6, level="gain_db"):
    return Twin(FittedModel.of_channel(LogDistance(LogDistanceLine(intercept_db, exponent, sd_db))),
                [TwinDevice.anchor(*device) for device in devices], level, None)


@pytest.fixture
def build(tmp_path):
    return lambda *shapes, **options: write_scene(tmp_path / "scene", shapes, **options)


@pytest.fixture
def twin_of():
    return make_twin


def box(x_min, y_min, x_max, y_max, height):
    mesh = trimesh.creation.box(bounds=[[x_min, y_min, 0], [x_max, y_max, height]])
    return trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)


@pytest.fixture
def house():
    return box
