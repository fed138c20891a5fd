"""Bad input: one clear message, exit status 2, no traceback, and no partial file."""

import shutil

import pandas as pd
import pytest

from radiotwin.links.measurements import read_measurements
from radiotwin.runtime import cuda


@pytest.fixture(scope="module")
def good(run, tmp_path_factory):
    """A scene, and a survey of two flights in it."""
    folder = tmp_path_factory.mktemp("good")
    assert run("build-scene preset:small -o scene", cwd=folder).returncode == 0
    assert run("survey scene --truth segmented --flights 2 -o measurements.csv", cwd=folder).returncode == 0
    return folder


@pytest.fixture
def here(good, tmp_path):
    """A copy that a test may spoil."""
    shutil.copytree(good, tmp_path, dirs_exist_ok=True)
    return tmp_path


def refuse(run, arguments, folder, *parts):
    before = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    result = run(arguments, cwd=folder)
    assert result.returncode == 2, (result.returncode, result.stderr)
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in result.stderr
    assert sorted(path.relative_to(folder) for path in folder.rglob("*")) == before, "something was left behind"


def change(folder, edit):
    """Rewrite the measurements with `edit(table)`."""
    path = folder / "measurements.csv"
    table = pd.read_csv(path, dtype=object)
    edit(table).to_csv(path, index=False)


FIT = "fit measurements.csv --scene scene -o twin"


def test_a_missing_column(run, here):
    change(here, lambda table: table.drop(columns="receiver_z_m"))
    refuse(run, FIT, here, "measurements.csv", "receiver_z_m", "missing")


def test_no_anchor(run, here):
    devices = (here / "devices.csv").read_text().replace("anchor", "unknown")
    (here / "devices.csv").write_text(devices)
    refuse(run, FIT, here, "no anchor", "devices.csv")


def test_one_flight_only(run, here):
    change(here, lambda table: table[table["flight"] == "f0"])
    refuse(run, "compare measurements.csv --scene scene -o comparison", here, "1 flight", "at least 2")


def test_nothing_detected(run, here):
    change(here, lambda table: table.assign(gain_db=""))
    refuse(run, FIT, here, "nothing was detected")


def test_all_links_nlos(run, here):
    """Only links that the map says are blocked: what a survey with exchanged axes looks like."""
    measurements = read_measurements(here / "measurements.csv")
    from radiotwin.scene import Scene
    scene = Scene.load(here / "scene")
    seen = scene.city.line_of_sight(scene.device_m[measurements.device_index], measurements.receiver_m)
    measurements.select(~seen).save(here / "measurements.csv")
    refuse(run, FIT, here, "all links NLoS", "log_distance")


def test_a_negative_frequency(run, here):
    path = here / "scene" / "scene.toml"
    path.write_text(path.read_text().replace("frequency_hz = 2400000000.0", "frequency_hz = -2.4e9"))
    refuse(run, FIT, here, "scene.toml", "radio.frequency_hz = -2400000000.0")


def test_a_device_inside_a_building(run, here):
    path = here / "scene" / "scene.toml"
    path.write_text(path.read_text().replace("x_m = 160.0\ny_m = 120.0", "x_m = 130.0\ny_m = 170.0"))
    refuse(run, "survey scene --truth segmented -o s.csv", here, "scene.toml", "device 'd3'", "inside a building")


@pytest.mark.parametrize(("arguments", "parts"), [
    ("fit no.csv --scene scene -o twin", ["no.csv does not exist"]),
    ("fit measurements.csv --scene nowhere -o twin", ["nowhere is not a folder"]),
    ("fit measurements.csv --scene scene --model magic -o twin", ["'magic' is unknown; allowed are"]),
    ("fit measurements.csv --scene scene -o scene", ["scene holds city.xml, meshes, preview.png, scene.toml, and no twin.json"]),
    ("survey scene --truth traced -o s.csv", ["truth.nc does not exist", "radiotwin trace"]),
    ("survey scene --truth segmented --pattern spiral -o s.csv", ["'spiral' is unknown; allowed are"]),
    ("survey scene --truth segmented -o s.xlsx", ["unknown format"]),
    ("map nothing --scene scene", ["not a twin's folder"]),
    ("map nothing --scene scene -o map.bmp", ["unknown format '.bmp'; allowed are"]),
    ("compare measurements.csv --scene scene --held-out 0", ["at least 1 is needed"]),
    ("compare measurements.csv --scene scene --truth no.nc", ["no.nc does not exist"]),
    ("compare measurements.csv --scene scene -o scene", ["cannot write scene: it is the scene's folder"]),
    ("close-loop measurements.csv --scene scene -o ./scene", ["cannot write scene: it is the scene's folder"]),
    ("gains scene --points measurements.csv -o measurements.csv", ["reads measurements.csv, which would be lost"]),
    ("paths scene --points measurements.csv -o scene/city.xml", ["reads scene/city.xml, which would be lost"]),
    ("trace scene -o scene/scene.toml", ["reads scene/scene.toml, which would be lost"]),
    ("survey scene --truth segmented -o scene/buildings.csv", ["scene/buildings.csv, which would be lost"]),
    ("locate measurements.csv --twin t -o measurements.csv", ["reads measurements.csv, which would be lost"]),
    ("locate measurements.csv --twin t -o devices.csv", ["reads devices.csv, which would be lost"]),
    ("locate measurements.csv --twin t -o out.xlsx", ["unknown format; allowed are .csv and .csv.gz"]),
    ("report scene -o scene/scene.toml", ["unknown format; allowed are .html and .htm"]),
    ("build-scene preset:atlantis -o x", ["'atlantis' does not exist; allowed are rbm"]),
    ("build-scene no.xml -o x", ["no.xml"]),
    ("build-scene sionna:atlantis -o x", ["atlantis", "munich"]),
    ("build-scene preset:small -o measurements.csv", ["measurements.csv is a file"]),
    ("trace scene --quality best", ["quality 'best' is unknown; allowed are"]),
    ("trace scene --devices d99", ["d99"]),
    ("trace scene --plan --workers 0", ["--workers '0': allowed are auto"]),
    ("fit measurements.csv --scene scene -o twin --shift=1e308,0", ["a shift by 1e+308, 0 m is not possible"]),
    ("import measurements.csv -o new --average-m -5", ["--average-m: average_m: -5"]),
    ("trace scene --device d3", ["--device 'd3'", "auto, cpu, cuda", "--devices names radios"]),
    pytest.param("gains scene --points no.csv --device cuda", ["--device cuda", "radiotwin doctor"],
                 marks=pytest.mark.skipif(cuda.tracing_refusal() is None, reason="there is a GPU")),
])
def test_options_that_cannot_be(run, here, arguments, parts):
    refuse(run, arguments, here, *parts)
