"""A campus with its OpenStreetMap extract, through the command line: one frame, whatever the origins are."""

import gzip
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from radiotwin.links.measurements import read_measurements
from radiotwin.scene import Scene

COMMAND = Path(sys.executable).with_name("radiotwin")
MAP = "build-scene map.osm --height-default 14 --frequency-hz 3.6e9"
BBOX = "--bbox=35.9924,-78.9427,36.0078,-78.9288"
FIT = "fit measured/measurements.csv --model log_distance --scene"


def run(line, cwd):
    return subprocess.run([str(COMMAND), *line.split()], cwd=cwd, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def campus(folder, tmp_path_factory):
    """The files as they were logged, imported, and the map built as it is and cut to a box."""
    source, here = folder("duke_cbrs"), tmp_path_factory.mktemp("campus")
    for name in ("sites.csv", "import.toml", "map.osm"):
        shutil.copy(source / name, here / name)
    (here / "raw.csv").write_bytes(gzip.decompress((source / "raw.csv.gz").read_bytes()))
    for line in ("import raw.csv --columns import.toml -o measured", f"{MAP} -o own", f"{MAP} {BBOX} -o same"):
        done = run(line, here)
        assert done.returncode == 0, done.stderr
    return here


def test_two_origins_are_94_m_apart_and_converted(campus):
    done = run(f"{FIT} own -o twin", campus)
    said = " ".join(done.stderr.split())
    assert done.returncode == 0, done.stderr
    assert "moved by +19.3 m east, +91.7 m north" in said
    inside = int(re.search(r"([\d,]+) of 28,682 links have their receiver inside a building", said)[1].replace(",", ""))
    assert inside / 28_682 == pytest.approx(0.037, abs=0.002)  # 21 % in the wrong frame


def test_the_same_origin_is_not_converted(campus):
    done = run(f"{FIT} same -o twin", campus)
    assert done.returncode == 0 and "converted" not in done.stderr


def test_without_an_origin_the_right_translation_is_proposed(campus):
    (campus / "bare").mkdir()
    for name in ("measurements.csv", "devices.csv"):
        shutil.copy(campus / "measured" / name, campus / "bare" / name)
    done = run(f"{FIT} own -o twin3".replace("measured", "bare"), campus)
    said = " ".join(done.stderr.split())
    east_m, north_m = map(float, re.search(r"--shift=([-\d.]+),([-\d.]+) would", said).groups())
    assert done.returncode == 2 and "21.2% of the receivers are inside buildings" in said
    assert (east_m, north_m) == (pytest.approx(19.3, abs=4), pytest.approx(91.7, abs=4))


def test_the_map_has_woods_and_half_of_its_heights_are_guesses(campus):
    scene = Scene.load(campus / "same")
    kinds = [each.kind for each in scene.config.vegetation]
    assert kinds.count("wood") == 9 and kinds.count("park") == 5
    assert "default 69" in scene.config.provenance["heights_from"]
    measured = read_measurements(campus / "measured" / "measurements.csv")
    assert measured.origin.latitude_deg == scene.config.origin.latitude_deg == 36.0001
