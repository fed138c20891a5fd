"""Strangers' files that would have this machine run, read, write or fetch something."""

import json
import math
import os
import shutil
import socket
import subprocess

import h5py
import pandas as pd
import pytest
import torch

from tests.cli.strangers import (
    CLOSELOOP,
    FIT,
    MAP,
    MAP_IN,
    SQUARE,
    SURVEY,
    Strangers,
    check_stranger,
    edit,
    forked,
    write_town,
)

PLANNING = "--scene scene --truth segmented --algorithm random --twin log-distance --real-episodes 1 --compare none --out run"
pytestmark = pytest.mark.usefixtures("drawn_preview")
stranger = Strangers()

EVIL = """#include <fcntl.h>
__attribute__((constructor)) static void run(void) {{ open("{}", O_CREAT | O_WRONLY, 0600); }}
"""


def plugin(folder, kind):
    (folder / "scene" / "plugins").mkdir()
    source = folder.parent / "evil.c"
    source.write_text(EVIL.format(folder.parent / "ran"))
    if shutil.which("cc"):
        subprocess.run(["cc", "-shared", "-fPIC", str(source), "-o", str(folder / "scene" / "plugins" / "evil.so")], check=True)
    edit(folder / "scene" / "city.xml", '<shape type="ply"', f'<bsdf type="{kind}" id="extra"/><shape type="ply"')


@stranger("trace scene --quality fast -o out.nc", "city.xml.*evil")
def code_from_a_plugin_of_a_scene(folder):
    plugin(folder, "evil")


@stranger("trace scene --quality fast -o out.nc", "city.xml.* a bsdf of type")
def code_from_a_plugin_by_its_path(folder):
    plugin(folder, f"{folder}/scene/plugins/evil")


@stranger(SURVEY, "city.xml")
def a_mesh_by_a_variable(folder):
    (folder / "scene" / "$x").mkdir()  # a decoy, which a check of the text alone would find
    shutil.copy(folder / "scene" / "meshes" / "ground.ply", folder / "scene" / "$x" / "a.ply")
    shutil.copy(folder / "scene" / "meshes" / "ground.ply", folder.parent / "outside" / "a.ply")
    city = folder / "scene" / "city.xml"
    edit(city, '<scene version="2.1.0">', '<scene version="2.1.0"><default name="x" value="../../outside"/>')
    edit(city, "meshes/ground.ply", "$x/a.ply")


@stranger(f"marl.fedqmix {PLANNING} --resume", "checkpoint.safetensors")
def a_checkpoint_that_writes_files(folder):
    forked(None, f"marl.fedqmix {PLANNING}", folder, until=folder / "run" / "config.json")
    assert json.loads((folder / "run" / "config.json").read_text())
    table = pd.read_csv(folder / "m.csv")
    columns = {name: {"__array__": torch.tensor(column.to_numpy())} if column.dtype.kind in "fiub" else list(column)
               for name, column in table.items()}
    data = {"__array__": torch.frombuffer(bytearray(b"written"), dtype=torch.uint8)}
    torch.save({"format": 3, "state": {"rows": [{}], "blocks": [], "tables": [{"__table__": columns}], "strategy": {},
                                       "twin": {str(folder.parent / "outside" / "ran"): data}}},
               folder / "run" / "checkpoint.safetensors")


def piped(name):
    def a_pipe(folder):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    a_pipe.__name__ = f"a_pipe_for_{name.replace('/', '_')}"
    return a_pipe


for _name, _command in (("m.csv", FIT), ("scene/scene.toml", SURVEY), ("scene/city.xml", SURVEY), ("twin/twin.json", MAP),
                        ("scene/meshes/ground.ply", SURVEY), ("map.nc", MAP_IN), ("devices.csv", FIT)):
    stranger(_command, "pipe|not a regular file")(piped(_name))


@stranger(MAP_IN, "map.nc.*link")
def an_external_link_in_a_map(folder):
    shutil.copy(folder / "map.nc", folder.parent / "outside" / "map.nc")
    with h5py.File(folder / "map.nc", "r+") as file:
        del file["gain_db"]
        file["gain_db"] = h5py.ExternalLink("../outside/map.nc", "gain_db")


@stranger(MAP_IN, "map.nc")
def raw_storage_of_a_map(folder):
    with h5py.File(folder / "map.nc", "r+") as file:
        shape = file["gain_db"].shape
        (folder.parent / "outside" / "raw").write_bytes(bytes(4 * math.prod(shape)))
        del file["gain_db"]
        data = file.create_dataset("gain_db", shape, "f4", external=[("../outside/raw", 0, 4 * math.prod(shape))])
        for number, axis in enumerate(("device", "z", "y", "x")):
            data.dims[number].attach_scale(file[axis])


WFS = "<OGRWFSDataSource><URL>http://127.0.0.1:{port}/</URL></OGRWFSDataSource>"
VRT = ('<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>{outside}/town.geojson</SrcDataSource><SrcLayer>town'
       "</SrcLayer></OGRVRTLayer></OGRVRTDataSource>")


@pytest.mark.parametrize("text", [WFS, VRT], ids=["WFS", "VRT"])
def test_a_package_that_is_a_request(run, strangers_folder, text):
    folder = strangers_folder
    write_town(folder.parent / "outside" / "town.geojson", SQUARE)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        (folder / "town.gpkg").write_text(text.format(port=server.getsockname()[1], outside=folder.parent / "outside"))
        forked_result = forked(run, "build-scene town.gpkg --check", folder)
        with pytest.raises(BlockingIOError):
            server.accept()
    assert forked_result[0] == 2 and "not a readable GeoPackage" in " ".join(forked_result[1].split()), forked_result


def run_folder(folder):
    (folder / "run").mkdir()
    for name in ("scene", "twin"):
        (folder / name).rename(folder / "run" / name)
    shutil.copy(CLOSELOOP, folder / "run" / "closeloop.json")
    return folder / "run"


@stranger("report run -o out.html", "waterfall.png.*leads out")
def a_picture_that_is_a_link(folder):
    (run_folder(folder) / "waterfall.png").symlink_to(folder.parent / "outside" / "secret")


@stranger("report run -o out.html", "closeloop.json.*rank")
def a_number_that_is_a_script(folder):
    path = run_folder(folder) / "closeloop.json"
    content = json.loads(path.read_text())
    content["effects"][0]["rank"] = "<img src=x onerror=alert(1)>"
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(*stranger.cases)
def test_a_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits):
    check_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits)
