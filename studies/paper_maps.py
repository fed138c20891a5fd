"""Write scene folders of the paper's published maps, which are not in this repository.

    python -m studies.paper_maps MAP.json FOLDER    # runs/paper_rbm, runs/paper_rdm

The maps come with the code of Chen et al. (github.com/Cirrick/Multi_UAV_Data_Harvesting, BSD-3), as
JSON with `extent_m`, `buildings_xmin_ymin_xmax_ymax_height_m`, `device_xy`, `anchor_index`,
`data_units`, `start`, `terminal` (metres) and `battery`. Radio as published: 43 dB transmit power,
-60 dB noise, 10 dB threshold. Devices are 1.5 m high. The sensitivity is so low that every link is
measured.
"""

import json
import sys
from pathlib import Path

import numpy as np
import trimesh

from radiotwin.io.files import atomic_folder
from radiotwin.scene.config import parse_config, write_config
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material
from radiotwin.scene.presets import building_meshes

MARGIN_M = 100.0  # of ground around the extent


def build_paper_scene(path: Path, folder: Path) -> None:
    """Write the scene folder of one map."""
    published = json.loads(path.read_text(encoding="utf-8"))
    width_m, depth_m = published["extent_m"]
    config = parse_config({
        "schema": "radiotwin.scene/1", "name": published["name"],
        "radio": {"tx_power_dbm": 43.0, "noise_dbm": -60.0, "sensitivity_dbm": -120.0,
                  "snr_threshold_db": 10.0},
        "extent": {"x_min_m": 0.0, "x_max_m": width_m, "y_min_m": 0.0, "y_max_m": depth_m},
        "lattice": {"step_m": 20.0,
                    "altitudes_m": sorted({float(z_m) for *_, z_m in published["start"]})},
        "devices": [{"device": f"d{i}", "x_m": float(x_m), "y_m": float(y_m), "z_m": 1.5,
                     "role": "anchor" if i in published["anchor_index"] else "unknown"}
                    for i, (x_m, y_m) in enumerate(published["device_xy"])],
        "uavs": [{"uav": f"uav{i}", "altitude_m": float(start[2]), "start_x_m": float(start[0]),
                  "start_y_m": float(start[1]), "terminal_x_m": float(end[0]),
                  "terminal_y_m": float(end[1]), "battery": float(published["battery"])}
                 for i, (start, end) in enumerate(zip(published["start"], published["terminal"]))],
        "mission": {"data_units": float(published["data_units"]), "rate_scale": 100.0},
    }, path)
    corners = [[-MARGIN_M, -MARGIN_M, 0], [width_m + MARGIN_M, -MARGIN_M, 0],
               [width_m + MARGIN_M, depth_m + MARGIN_M, 0], [-MARGIN_M, depth_m + MARGIN_M, 0]]
    ground = trimesh.Trimesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)
    boxes = np.array(published["buildings_xmin_ymin_xmax_ymax_height_m"])
    concrete = Material("concrete", itu="concrete")
    shapes = [CityShape("ground", ground, concrete)]
    shapes += [CityShape(f"building_{i:03d}", mesh, concrete)
               for i, mesh in enumerate(building_meshes(boxes))]
    with atomic_folder(folder) as temporary:
        write_city(temporary, shapes)
        write_config(config, temporary / "scene.toml")


if __name__ == "__main__":
    build_paper_scene(Path(sys.argv[1]), Path(sys.argv[2]))
