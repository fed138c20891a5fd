"""A command that is given what a stranger sent: one message, and nothing read, run, written or fetched.

Each command runs in the sandbox of the fuzzer.
"""

import gzip
import json
import math
import os
import re
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import torch

from radiotwin.runtime import cuda
from tests.cli.conftest import FIT, MAP, SURVEY
from tests.command_line import run_planning
from tests.fuzz.cases import listen
from tests.fuzz.sandbox import run_watched

pytestmark = pytest.mark.usefixtures("drawn_preview")
HERE = Path(__file__).parents[1]
STORED, CLOSELOOP = HERE / "twin" / "stored", HERE / "closeloop" / "sample" / "closeloop.json"
SQUARE = [[8.001, 50.001], [8.002, 50.001], [8.002, 50.002], [8.001, 50.002], [8.001, 50.001]]
MAP_IN = "survey scene --truth map.nc --flights 1 -o out.csv"
PLANNING = "--scene scene --truth segmented --algorithm random --twin log-distance --real-episodes 1 --compare none --planner-iterations 50 " \
           "--flights 2 --out run"
LINKS = ("time_s,flight,receiver,receiver_x_m,receiver_y_m,receiver_z_m,device,gain_db\n", "0,f,r,1,2,60,d0,-80\n")
CASES = []


def stranger(command, message, status=2, **limits):
    """Register a function that prepares a folder.

    Lower limits save the time of coming near the real ones.
    """
    def register(prepare):
        CASES.append(pytest.param(prepare, command, message, status, limits, id=prepare.__name__))
        return prepare
    return register


def written(folder):
    return sorted([*folder.rglob("*"), *(folder.parent / "outside").rglob("*")])


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def write_town(path):
    feature = {"type": "Feature", "properties": {"building": "yes"}, "geometry": {"type": "Polygon", "coordinates": [SQUARE]}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))


EVIL = """#include <fcntl.h>
__attribute__((constructor)) static void run(void) {{ open("{}", O_CREAT | O_WRONLY, 0600); }}
"""


def plugin(folder, kind):
    (folder / "scene" / "plugins").mkdir()
    source = folder.parent / "evil.c"
    source.write_text(EVIL.format(folder.parent / "outside" / "ran"))
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
    assert run_planning(PLANNING.split(), folder).returncode == 0
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
VRT = ('<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>../outside/town.geojson</SrcDataSource><SrcLayer>town'
       "</SrcLayer></OGRVRTLayer></OGRVRTDataSource>")


def package(text):
    def a_package_that_is_a_request(folder):
        write_town(folder.parent / "outside" / "town.geojson")
        (folder / "town.gpkg").write_text(text)
    return a_package_that_is_a_request


for _text in (WFS, VRT):
    stranger("build-scene town.gpkg --check", "not a readable GeoPackage")(package(_text))


def run_folder(folder):
    (folder / "run").mkdir()
    for name in ("scene", "twin"):
        (folder / name).rename(folder / "run" / name)
    shutil.copy(CLOSELOOP, folder / "run" / "closeloop.json")
    return folder / "run"


@stranger("report run -o out.html", "waterfall.png.*leads out")
def a_picture_that_is_a_link(folder):
    (run_folder(folder) / "waterfall.png").symlink_to("../../canary")


@stranger("report run -o out.html", "closeloop.json.*rank")
def a_number_that_is_a_script(folder):
    path = run_folder(folder) / "closeloop.json"
    content = json.loads(path.read_text())
    content["effects"][0]["rank"] = "<img src=x onerror=alert(1)>"
    path.write_text(json.dumps(content))


def mesh(folder, position, data):
    path = folder / "scene" / "meshes" / "building_000.ply"
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n") + position
    content[start:start + 4] = data
    path.write_bytes(content)


@stranger(SURVEY, "building_000.ply")
def a_vertex_that_is_no_number(folder):
    mesh(folder, 0, np.float32(np.nan).tobytes())


@stranger(SURVEY, "building_000.ply")
def an_index_too_high(folder):
    mesh(folder, 48 * 12 + 1, np.int32(10**6).tobytes())


def effects(name, change):
    def prepare(folder):
        shutil.rmtree(folder / "twin")
        shutil.copytree(STORED / "raytrace", folder / "twin")
        record = json.loads((folder / "twin" / "twin.json").read_text())
        change(record)
        (folder / "twin" / "twin.json").write_text(json.dumps(record))
    prepare.__name__ = f"effects_that_are_{name}"
    return prepare


for _name, _change in {
        "null": lambda record: record["fitted"].update(effects=None), "text": lambda record: record.update(fitted="none"),
        "a_list": lambda record: record["fitted"].update(effects=[[1]]),
        "without_freedom": lambda record: record["fitted"].update(dof=-1),
        "texts_for_numbers": lambda record: record["fitted"].update(scale_db=["nan", "inf"]),
        "null_inside": lambda record: record["fitted"].update(receivers=None)}.items():
    stranger(MAP, "twin.json")(effects(_name, _change))


@stranger(FIT, "control characters")
def names_that_clear_the_screen(folder):
    for name in ("m.csv", "devices.csv"):
        path = folder / name
        path.write_text(re.sub(r"\bd0\b", "d0\x1b[2J\x1b]0;title\x07", path.read_text()))


@stranger(FIT, "anchor.*km")
def an_anchor_10_000_km_away(folder):
    devices = pd.read_csv(folder / "devices.csv")
    devices.loc[devices.index[devices["role"] == "anchor"][0], "x_m"] = 1e7
    devices.to_csv(folder / "devices.csv", index=False)


@stranger("close-loop m.csv --devices devices.csv --base log-distance -o out", "time_s")
def a_time_of_1e308_s(folder):
    table = pd.read_csv(folder / "m.csv")
    table["time_s"] = table["time_s"].astype(float)
    table.loc[3, "time_s"] = 1e308
    table.to_csv(folder / "m.csv", index=False)


@stranger("fit bomb.csv.gz --scene scene --model log_distance -o out", "RADIOTWIN_MAX_FILE_BYTES",
          FILE_BYTES=100 * 2**20)
def a_bomb_of_gzip(folder):
    block = gzip.compress(LINKS[1].encode() * 2**20, 9)
    (folder / "bomb.csv.gz").write_bytes(gzip.compress(LINKS[0].encode()) + block * 200)


@stranger("fit bomb.parquet --scene scene --model log_distance -o out", "RADIOTWIN_MAX_ROWS")
def a_bomb_of_parquet(folder):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = 3_000_000
    part = pyarrow.table({name: pyarrow.nulls(rows, pyarrow.float64()) for name in LINKS[0].strip().split(",")})
    with parquet.ParquetWriter(folder / "bomb.parquet", part.schema) as writer:
        for _ in range(20):
            writer.write_table(part)
    assert (folder / "bomb.parquet").stat().st_size < 5e6


@stranger(MAP_IN, "map.nc.*RADIOTWIN_MAX_")
def a_sparse_map(folder):
    with h5py.File(folder / "map.nc", "r+") as file:
        for name in ("gain_db", "los", "sigma_db"):
            if name in file:
                del file[name]
        for axis, size in (("y", 60_000), ("x", 60_000)):
            del file[axis]
            file.create_dataset(axis, data=np.arange(size, dtype=float)).make_scale(axis)
        data = file.create_dataset("gain_db", (1, 1, 60_000, 60_000), "f4", chunks=(1, 1, 1000, 1000), compression="gzip")
        for number, axis in enumerate(("device", "z", "y", "x")):
            data.dims[number].attach_scale(file[axis])


@stranger(SURVEY, "RADIOTWIN_MAX_NESTING")
def a_key_of_20_000_parts(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        file.write("\n[x]\n" + "a." * 20_000 + "b = 1\n")


@stranger(SURVEY, "RADIOTWIN_MAX_NESTING")
def lists_in_lists(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        file.write("\n[x]\na = " + "[" * 100_000 + "]" * 100_000 + "\n")


@stranger(MAP, "RADIOTWIN_MAX_NESTING|readable")
def lists_in_lists_of_a_twin(folder):
    (folder / "twin" / "twin.json").write_text("[" * 100_000 + "]" * 100_000)


@stranger(SURVEY, "scene.toml")
def a_number_of_5_000_digits(folder):
    edit(folder / "scene" / "scene.toml", "frequency_hz = 2400000000.0", "frequency_hz = " + "9" * 5000)


@stranger("fit wide.csv --scene scene --model log_distance -o out", "RADIOTWIN_MAX_COLUMNS")
def names_of_100_000_columns(folder):
    columns = [*LINKS[0].strip().split(","), *(f"c{number}" for number in range(100_000))]
    (folder / "wide.csv").write_text(",".join(columns) + "\n" + ",".join("1" for _ in columns) + "\n")


@stranger("export-scene scene -o out.obj", "", status=0)
def devices_by_the_ten_thousand(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        for number in range(20_000):
            file.write(f'\n[[devices]]\ndevice = "n{number}"\nx_m = {number % 300}.0\ny_m = 1.0\nz_m = 1.5\nrole = "anchor"\n')


@pytest.mark.parametrize("prepare, command, message, status, limits", CASES)
def test_a_stranger(strangers_folder, monkeypatch, prepare, command, message, status, limits):
    folder = strangers_folder
    cuda.tracing_refusal()  # asked once in a process, and may start another one
    for name, limit in limits.items():
        monkeypatch.setenv(f"RADIOTWIN_MAX_{name}", str(limit))
    with listen() as listener:
        prepare(folder)
        for path in folder.glob("*.gpkg"):  # that would call this server
            path.write_text(path.read_text().replace("{port}", str(listener.getsockname()[1])))
        before = written(folder)
        done = run_watched(command if command.startswith("marl.") else f"radiotwin {command}", folder.parent, listener)
    assert (done.status, done.breaches) == (status, ()), done.output[-2000:]
    assert "\x1b" not in done.output and re.search(message, " ".join(done.output.split())), done.output[-2000:]
    if status:
        assert written(folder) == before and len(done.output) < 4000
