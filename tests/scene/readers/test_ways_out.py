"""Every refusal of `build-scene` says what to do, and the options that it names exist.

Rationale: a message that only says what is wrong leaves a user with a file that somebody else made.
Expected: each message in the source of the readers has a word of advice, and no option that `build-scene` lacks.
"""

import ast
import re
from pathlib import Path

import pytest
import typer

import radiotwin.scene.readers as readers
from radiotwin.cli.scenes import build_scene
from radiotwin.errors import BadInput
from tests.scene.readers.test_published_schemas import geojson

ADVICE = re.compile(r"--[a-z]|\b(give|export|correct|choose|remove|declare|make|install|keep|leave|download|name|convert|"
                    r"pack|close|fetch|build|say|may|begin|write|take|add|must|ask|allowed|its (layers|columns) are|as \w+ is)\b")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def texts(node):
    """Return the constant texts below a node of the syntax tree, without how values are formatted."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    parts = [] if isinstance(node, ast.FormattedValue) else ast.iter_child_nodes(node)
    return "".join(texts(part) for part in parts)


def messages():
    for path in sorted(Path(readers.__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "BadInput":
                yield pytest.param(texts(node.args[0]), id=f"{path.name}:{node.lineno}")


@pytest.fixture(scope="module")
def options():
    app = typer.Typer()
    app.command()(build_scene)
    return {name for one in typer.main.get_command(app).params for name in one.opts}


@pytest.mark.parametrize("message", list(messages()))
def test_a_refusal_says_what_to_do(message, options):
    assert ADVICE.search(message) or message in (": ", ""), message
    assert set(OPTION.findall(message)) <= options, message


def test_options_that_problems_name_exist(options):
    for path in Path(readers.__file__).parent.glob("*.py"):
        named = {name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)
                 and isinstance(node.value, str) for name in OPTION.findall(node.value)}
        assert named <= options, path.name


@pytest.mark.parametrize(("row", "option"), [
    ({"roof_z": 412.5}, {"height_column": "roof_z"}), ({"roof_z": 9.5}, {"default_height_m": 8.0}),
    ({"HOEHE_MM": 12500, "height": 12500}, {"height_column": "height:mm"})])
def test_following_the_advice_helps(tmp_path, row, option):
    source = geojson(tmp_path, [(0, row)])
    with pytest.raises(BadInput, match="--height-column NAME"):
        readers.build_scene(source, tmp_path / "out")
    assert readers.build_scene(source, tmp_path / "out", **option).folder


def test_declaring_a_system_helps(tmp_path):
    corners = [[691_000 + x, 5_336_000 + y] for x, y in ((0, 0), (20, 0), (20, 9), (0, 9), (0, 0))]
    source = geojson(tmp_path, [])
    source.write_text('{"type": "Feature", "properties": {"height": 9}, "geometry": {"type": "Polygon", '
                      f'"coordinates": [{corners}]}}}}')
    with pytest.raises(BadInput, match="no longitude and latitude in degrees.* declare it with --crs"):
        readers.build_scene(source, tmp_path / "out")
    report = readers.build_scene(source, tmp_path / "out", crs="EPSG:25832")
    assert re.search(r"latitude_deg = 48\.1\d+\nlongitude_deg = 11\.5", (report.folder / "scene.toml").read_text())
