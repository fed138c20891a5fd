"""Strangers' numbers and names that no formula and no terminal can take."""

import gzip
import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from tests.cli.strangers import FIT, MAP, STORED, SURVEY, Strangers, check_stranger

pytestmark = pytest.mark.usefixtures("drawn_preview")
stranger = Strangers()


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
def an_index_of_minus_one(folder):
    mesh(folder, 48 * 12 + 1, np.int32(-1).tobytes())


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


@stranger("import log.csv --columns import.toml -o out", "", status=0)
def names_that_are_formulas(folder):
    (folder / "log.csv").write_text("when,x,y,z,cell,rsrp\n" + "".join(
        f"{n},{n},{2 * n},60,\"=cmd|' /C calc'!A0\",{-80 - n % 7}\n" for n in range(50)))
    (folder / "sites.csv").write_text("device,x,y,z\n=cmd|' /C calc'!A0,1,2,3\n")
    (folder / "import.toml").write_text(
        'devices = "sites.csv"\ntime_format = "epoch s"\nlevel_unit = "dBm"\nlength_unit = "m"\n[columns]\ntime = "when"\n'
        'x = "x"\ny = "y"\nz = "z"\ndevice = "cell"\nlevel = "rsrp"\n')

    def check():
        for path in (folder / "out").glob("*.csv*"):
            data = path.read_bytes()
            text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
            assert not re.search(r'(^|,)"?=', text, re.M), path
    return check


@stranger(FIT, "anchor.*km")
def an_anchor_10_000_km_away(folder):
    devices = pd.read_csv(folder / "devices.csv")
    devices.loc[devices.index[devices["role"] == "anchor"][0], "x_m"] = 1e7
    devices.to_csv(folder / "devices.csv", index=False)


@stranger(SURVEY + " --noise-db 1e308", "noise_db")
def noise_of_1e308_db(folder):
    pass


@stranger("close-loop m.csv --devices devices.csv --base log-distance -o out", "time_s")
def a_time_of_1e308_s(folder):
    table = pd.read_csv(folder / "m.csv")
    table["time_s"] = table["time_s"].astype(float)
    table.loc[3, "time_s"] = 1e308
    table.to_csv(folder / "m.csv", index=False)


@stranger("map twin --scene scene -o " + "o" * 300 + ".nc", "")
def an_output_of_300_characters(folder):
    pass


@pytest.mark.parametrize(*stranger.cases)
def test_a_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits):
    check_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits)
