"""Measurements and scenes of different frames, through the command line: converted, or refused with what helps."""

import json
from pathlib import Path

import pandas as pd
import pytest

from radiotwin.geo import to_geographic
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import read_measurements

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
ELSEWHERE = Origin(latitude_deg=47.52, longitude_deg=8.72)
FIT = "fit {}/measurements.csv --scene scene --model log_distance -o {}"


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """A town, a survey of it, the same in another frame, and the same in no known one."""
    folder = tmp_path_factory.mktemp("frames")
    for line in (f"build-scene {TOWN} -o scene --devices 4 --uavs 1",
                 "survey scene --truth segmented --flights 2 -o here/measurements.csv"):
        result = run(line, cwd=folder)
        assert result.returncode == 0, result.stderr
    here = read_measurements(folder / "here" / "measurements.csv")
    here.in_frame(ELSEWHERE).save(folder / "there" / "measurements.csv")
    here.in_frame(ELSEWHERE).save(folder / "nowhere" / "measurements.csv")
    (folder / "nowhere" / "frame.toml").unlink()
    return folder


def positions(folder, twin):
    devices = json.loads((folder / twin / "twin.json").read_text())["devices"]
    return pd.DataFrame(devices)[["x_m", "y_m"]].to_numpy(dtype=float)


def test_a_known_frame_is_converted_and_told(run, folder):
    same, converted = run(FIT.format("here", "t1"), cwd=folder), run(FIT.format("there", "t2"), cwd=folder)
    assert same.returncode == 0 and converted.returncode == 0, converted.stderr
    assert "positions are converted" not in same.stderr
    said = " ".join(converted.stderr.split())
    assert "the measurements count x and y from 47.52, 8.72" in said and "positions are converted" in said
    assert positions(folder, "t2") == pytest.approx(positions(folder, "t1"), abs=0.1)


def test_an_unknown_frame_that_does_not_fit_is_refused(run, folder):
    result = run(FIT.format("nowhere", "t3"), cwd=folder)
    said = " ".join(result.stderr.split())
    assert result.returncode == 2 and "are not in one frame: 0.0% of the receivers are inside buildings" in said
    assert "is not known of the measurements" in said and "import with --origin" in said
    assert not (folder / "t3").exists()


@pytest.mark.parametrize("shift", ["3", "a,b", "1,inf"])
def test_a_shift_is_two_numbers(run, folder, shift):
    result = run(FIT.format("here", "t4") + f" --shift {shift}", cwd=folder)
    assert result.returncode == 2 and "give DX,DY in metres" in " ".join(result.stderr.split())


def test_a_scene_is_put_about_the_origin_that_is_given(run, folder):
    assert run(f"build-scene {TOWN} -o moved --origin 47.5,8.7,440", cwd=folder).returncode == 0
    text = (folder / "moved" / "scene.toml").read_text()
    assert "latitude_deg = 47.5\n" in text and "altitude_m = 440.0" in text
    for wrong in ("47.5", "95,8", "x,y"):
        refused = run(f"build-scene {TOWN} -o wrong --origin={wrong}", cwd=folder)
        assert refused.returncode == 2 and "--origin" in refused.stderr
    buildings = [pd.read_csv(folder / name / "buildings.csv") for name in ("scene", "moved")]
    assert len(buildings[0]) == len(buildings[1])


def test_an_import_keeps_its_origin(run, folder):
    here = read_measurements(folder / "here" / "measurements.csv")
    longitude, latitude = to_geographic(here.origin, *here.receiver_m[:, :2].T)
    pd.DataFrame({"lat": latitude, "lon": longitude, "h": here.receiver_m[:, 2], "db": here.level_db,
                  "device": here.table["device"]}).to_csv(folder / "log.csv", index=False)
    here.devices.rename(columns={"x_m": "x", "y_m": "y", "z_m": "z"}).to_csv(folder / "devices.csv", index=False)
    result = run("import log.csv --columns latitude=lat,longitude=lon,height=h,level=db,device=device "
                 "--level-unit dB --length-unit m --origin 47.52,8.72 -o imported", cwd=folder)
    assert result.returncode == 0, result.stderr
    there = read_measurements(folder / "imported" / "measurements.csv")
    assert there.origin == ELSEWHERE
    assert there.in_frame(here.origin).receiver_m == pytest.approx(
        here.receiver_m[here.table.index[:len(there.table)]], abs=0.01)
