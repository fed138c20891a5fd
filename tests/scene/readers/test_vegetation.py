"""Woods, parks and rows of trees of OpenStreetMap become volumes of a scene."""

import pytest
import shapely

from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.config import read_config
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.scene.readers.features import left_out_problems
from radiotwin.scene.readers.osm import assemble, read_osm_xml

STEP_DEG = 0.001  # 111 m to the north, 75 m to the east at 47.5 degrees


def ring(first, west, south, size=1.0):
    """Nodes of a square, and the references to them; in units of `STEP_DEG` from 47.5, 8.7."""
    corners = [(0, 0), (size, 0), (size, size), (0, size)]
    nodes = "".join(f'<node id="{first + i}" version="1" lat="{47.5 + STEP_DEG * (south + y):.6f}" '
                    f'lon="{8.7 + STEP_DEG * (west + x):.6f}"/>' for i, (x, y) in enumerate(corners))
    return nodes, "".join(f'<nd ref="{first + i % 4}"/>' for i in range(5))


def way(number, refs, **tags):
    return f'<way id="{number}" version="1">{refs}' + "".join(
        f'<tag k="{key}" v="{value}"/>' for key, value in tags.items()) + "</way>"


@pytest.fixture
def area_osm(tmp_path):
    squares = {number: ring(10 * number, *at) for number, at in {
        1: (0, 0, 0.4), 2: (1, 0), 3: (3, 0, 2), 4: (3.5, 0.5), 5: (6, 0), 6: (0, 3), 7: (2, 3)}.items()}
    text = "".join(nodes for nodes, _ in squares.values()) + "".join([
        way(1, squares[1][1], building="yes"), way(2, squares[2][1], natural="wood", height="23 m"),
        way(3, squares[3][1]), way(4, squares[4][1]),
        way(5, squares[5][1], leisure="park"), way(6, squares[6][1], natural="water"),
        way(7, '<nd ref="70"/><nd ref="71"/><nd ref="72"/>', natural="tree_row"),
        way(8, '<nd ref="70"/><nd ref="71"/><nd ref="72"/>', natural="wood"),  # not closed
        way(9, squares[7][1], building="yes", natural="wood"),  # a building
        '<relation id="1" version="1"><member type="way" ref="3" role="outer"/><member type="way" ref="4" role="inner"/>'
        '<tag k="type" v="multipolygon"/><tag k="landuse" v="forest"/></relation>',
        '<relation id="2" version="1"><member type="way" ref="99" role="outer"/>'
        '<tag k="type" v="multipolygon"/><tag k="natural" v="wood"/></relation>'])
    path = tmp_path / "area.osm"
    path.write_text(f'<osm version="0.6">{text}</osm>')
    return path


def test_what_grows_is_found_and_what_is_incomplete_is_told(area_osm):
    found = assemble(read_osm_xml(area_osm))
    assert {feature.name for feature in found.vegetation} == {"way/2", "way/5", "way/7", "relation/1"}
    assert {feature.name for feature in found.features} == {"way/1", "way/9"}
    (problem,) = [each.message for each in left_out_problems(found.left_out, None) if "vegetation" in each.message]
    assert "2 area(s)" in problem and "'way/8'" in problem and "'relation/2'" in problem


def test_a_scene_declares_it(area_osm, tmp_path):
    report = build_scene_from_map(area_osm, tmp_path / "scene",
                                  BuildOptions(uavs=0, bbox=(47.499, 8.699, 47.505, 8.7065)))
    declared = {each.name: each for each in read_config(tmp_path / "scene" / "scene.toml").vegetation}
    assert {name: (each.kind, each.height_m) for name, each in declared.items()} == {
        "way/2": ("wood", 23.0), "way/5": ("park", 10.0), "way/7": ("tree_row", 10.0), "relation/1": ("wood", 16.0)}
    areas = {name: shapely.Polygon(each.rings_m[0], each.rings_m[1:]).area for name, each in declared.items()}
    square_m2 = 111.2 * 75.3  # by degrees of latitude and longitude there
    assert areas["way/2"] == pytest.approx(square_m2, rel=0.01)
    assert areas["relation/1"] == pytest.approx(3 * square_m2, rel=0.01)  # with its clearing
    x_max = read_config(tmp_path / "scene" / "scene.toml").extent.bounds[1]
    assert max(x for x, _ in declared["way/5"].rings_m[0]) == pytest.approx(x_max) and areas["way/5"] < 0.9 * square_m2
    assert areas["way/7"] == pytest.approx(6 * (111.2 + 75.3), rel=0.1)  # 6 m wide
    (fact,) = [text for name, text in report.facts if name == "vegetation"]
    assert fact.startswith("4 areas (wood: 3.4 ha, park: 0.")
    assert len(Scene.load(tmp_path / "scene").city.vegetation) == 4
