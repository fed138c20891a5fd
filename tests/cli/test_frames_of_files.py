"""Measurements and scenes of different frames, through the command line: converted, or refused with what helps."""

import json
from pathlib import Path

import pandas as pd
import pytest

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
