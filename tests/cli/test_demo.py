"""`radiotwin demo` through the real command line, on a city small enough for a test."""

import re

import numpy as np
import pytest
import trimesh

from radiotwin.cli.demo import _middle
from radiotwin.trace import SolverSettings

MATERIAL = '<bsdf type="itu-radio-material" id="concrete"><string name="type" value="concrete"/></bsdf>'
SHAPE = ('<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
         '<ref id="concrete" name="bsdf"/></shape>')


@pytest.fixture
def city_xml(tmp_path):
    """Nine buildings of 10 to 26 m between streets of 30 m."""
    shapes = {"ground": trimesh.Trimesh([[-60, -60, 0], [260, -60, 0], [260, 260, 0], [-60, 260, 0]],
                                        [[0, 1, 2], [0, 2, 3]])}
    for number, (column, row) in enumerate(np.ndindex(3, 3)):
        x_m, y_m = 10 + 65 * column, 10 + 65 * row
        shapes[f"b{number}"] = trimesh.creation.box(bounds=[[x_m, y_m, 0], [x_m + 35, y_m + 35, 10 + 2 * number]])
    for name, mesh in shapes.items():
        mesh.export(tmp_path / f"{name}.ply")
    path = tmp_path / "city.xml"
    path.write_text(f"<scene version='2.1.0'>{MATERIAL}{''.join(SHAPE.format(name=n) for n in shapes)}</scene>")
    return path


@pytest.mark.llvm
def test_the_whole_chain_ends_in_a_page(run, city_xml, monkeypatch):
    monkeypatch.setattr("radiotwin.cli.demo.DEVICES", 4)
    monkeypatch.setattr("radiotwin.cli.demo.FLIGHTS", 3)
    monkeypatch.setattr("radiotwin.cli.demo.SolverSettings.of_quality", lambda _, **others: SolverSettings(samples_per_src=3_000, **others))
    folder = city_xml.parent
    result = run("demo --scene city.xml -o out", cwd=folder)
    assert result.returncode == 0, result.stderr
    page = (folder / "out" / "report.html").read_text()
    assert page.count("<img ") == 3 and not re.search(r'<[^>]*(src|href)="(?!data:)', page), "nothing from a network"
    assert 'id="radiotwin-data"' in page
    for model, label in (("log_distance", "log-distance"), ("segmented_nn", "segmented NN"), ("kriging", "kriging")):
        assert model in result.stdout and label in page
    for name in ("scene/truth.nc", "survey/devices.csv", "twin/twin.json", "comparison/compare.json"):
        assert (folder / "out" / name).is_file()

    again = run("demo --scene preset:small -o out", cwd=folder)
    assert again.returncode == 2 and "choose another folder" in again.stderr


def test_a_map_gives_the_square_in_its_middle_in_degrees(monkeypatch):
    monkeypatch.setattr("radiotwin.cli.demo.SIDE_M", 120.0)
    south, west, north, east = _middle("examples/campaign/town.geojson")
    across = np.radians([north - south, (east - west) * np.cos(np.radians(south))]) * 6_371_000
    assert across == pytest.approx([120, 120], rel=0.005)
    assert 47.0505 < south < north < 47.0533 and 8.3007 < west < east < 8.3048, "the town's"
    assert {type(each) for each in (south, west, north, east)} == {float}, "they are written to scene.toml"
