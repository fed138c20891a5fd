import json

import osmium
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.readers import build_scene
from radiotwin.scene.readers.features import left_out_problems
from radiotwin.scene.readers.gis_files import read_json_map
from radiotwin.scene.readers.osm import assemble, read_osm_pbf, read_osm_xml, stitch


def features(tmp_path, text):
    """The buildings of a file in OpenStreetMap's XML, by name."""
    (tmp_path / "a.osm").write_text(text)
    return {one.name: one for one in assemble(read_osm_xml(tmp_path / "a.osm")).features}


@pytest.mark.parametrize(("chains", "rings"), [
    ([[1, 2, 3, 1]], 1), ([[1, 2, 3], [1, 4, 3]], 1), ([[1, 2], [3, 2], [3, 4, 1]], 1),
    ([[1, 2, 3, 1], [5, 6], [6, 7, 5]], 2), ([], 0), ([[1, 2, 1]], 0), ([[1, 2, 3]], None), ([[1, 2, 3], [3, 4]], None)])
def test_ways_make_rings(chains, rings):
    found = stitch(chains)
    assert found is None if rings is None else len(found) == rings and all(ring[0] == ring[-1] for ring in found)


def test_the_town(town_osm):
    found = assemble(read_osm_xml(town_osm))
    names = {feature.name for feature in found.features}
    assert names == {f"way/{n}" for n in (*range(101, 115), 118, 119)} | {"relation/201", "relation/202"}
    areas = {feature.name: feature.area for feature in found.features}
    assert len(areas["relation/201"].interiors) == 1 and areas["relation/202"].geom_type == "MultiPolygon"
    messages = "\n".join(problem.message for problem in left_out_problems(found.left_out, None))
    assert "'way/116'" in messages and "not closed: left out ('way/115')" in messages


def test_pbf_holds_the_same_buildings(town_osm, tmp_path):
    path = tmp_path / "town.osm.pbf"
    with osmium.SimpleWriter(str(path)) as writer:
        for element in osmium.FileProcessor(str(town_osm)):
            if not (element.is_way() and element.id == 129):  # deleted: the XML reader of osmium keeps it
                writer.add(element)
    xml, pbf = assemble(read_osm_xml(town_osm)), assemble(read_osm_pbf(path))
    assert [(f.name, dict(f.tags)) for f in pbf.features] == [(f.name, dict(f.tags)) for f in xml.features]
    for a, b in zip(xml.features, pbf.features):
        assert shapely.equals_exact(a.area, b.area, 1e-9)
    assert {p.message for p in pbf.problems} == {p.message for p in xml.problems}


def relation(role, way_tags="", relation_tags='<tag k="type" v="multipolygon"/>'):
    nodes = "".join(f'<node id="{i}" lat="{i % 2}" lon="{i // 2}"/>' for i in range(4))
    return (f'<osm>{nodes}<way id="1"><nd ref="0"/><nd ref="1"/><nd ref="3"/><nd ref="2"/><nd ref="0"/>{way_tags}</way>'
            f'<relation id="1"><member type="way" ref="1" role="{role}"/>{relation_tags}</relation></osm>')


def test_a_relation_without_its_ways_is_cut(tmp_path):
    path = tmp_path / "a.osm"
    path.write_text(relation("outer", relation_tags='<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
                             '<member type="way" ref="5" role="outer"/>'))
    found = assemble(read_osm_xml(path))
    assert not found.features and "lack nodes or ways" in found.left_out[0].reason


def test_old_multipolygons_have_their_tags_at_the_outer_way(tmp_path):
    found = features(tmp_path, relation("outer", '<tag k="building" v="yes"/><tag k="height" v="7"/>'))
    assert list(found) == ["relation/1"] and found["relation/1"].tags["height"] == "7"


@pytest.mark.parametrize(("text", "message"), [
    ("", "line 1, column 1: malformed XML"), ("<osm><node", "malformed XML"), ("<html/>", "begins with <html>"),
    ('<osm>\n<node id="1" lat="91" lon="0"/></osm>', "line 2: a node has lon='0', lat='91'; allowed are"),
    ('<osm><node id="1" lat="nan" lon="0"/></osm>', "lat='nan'"),
    ('<osm><node id="1" lon="0"/></osm>', "lat=None"),
    ('<osm><node id="x" lat="1" lon="0"/></osm>', "id='x' is not a whole number"),
    ('<osm><way id="1"><nd/></way></osm>', "ref=None is not a whole number"),
])
def test_broken_xml_names_line_and_value(tmp_path, text, message):
    (tmp_path / "a.osm").write_text(text)
    with pytest.raises(BadInput, match=message) as error:
        read_osm_xml(tmp_path / "a.osm")
    assert str(tmp_path / "a.osm") in str(error.value)


@pytest.mark.parametrize("data", [b"", b"<osm/>", b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18\xff\xff\xff\x7f", b"x" * 999])
def test_broken_pbf(tmp_path, data):
    (tmp_path / "a.osm.pbf").write_bytes(data)
    with pytest.raises(BadInput, match="not a readable .osm.pbf file|holds no"):
        if not assemble(read_osm_pbf(tmp_path / "a.osm.pbf")).features:
            raise BadInput("holds no")


def test_missing_package_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "osmium", None)
    with pytest.raises(BadInput, match=r"pip install 'radiotwin\[gis\]'"):
        read_osm_pbf(tmp_path / "a.osm.pbf")


def ring(first, x0, x1):
    """Return nodes and the closed way `first` of a square (x0, x1) by (x0, x1) degrees."""
    corners = [(x0, x0), (x1, x0), (x1, x1), (x0, x1)]
    nodes = "".join(f'<node id="{first * 10 + i}" lon="{x}" lat="{y}"/>' for i, (x, y) in enumerate(corners))
    return nodes, f'<way id="{first}">' + "".join(f'<nd ref="{first * 10 + i % 4}"/>' for i in range(5))


@pytest.mark.parametrize(("roles", "area"), [
    (("outer", "inner", ""), 100 - 36 + 4), (("", "", ""), 100 - 36 + 4), (("outer", "", "outer"), 100 - 36 + 4),
    (("outer", "inner", "inner"), 100 - 36), (("outer", "outer", "outer"), 100),
    (("outline", "", ""), 100 - 36 + 4)])
def test_rings_without_a_role_are_courtyards_by_where_they_lie(tmp_path, roles, area):
    """Three squares of 10, 6 and 2 degrees within each other; the second has a tower of its own."""
    rings = [ring(1, 0, 10), ring(2, 2, 8), ring(3, 4, 6)]
    tower = '<tag k="building" v="tower"/>'
    ways = "".join(way + (tower if number == 2 else "") + "</way>" for number, (_, way) in enumerate(rings, 1))
    members = "".join(f'<member type="way" ref="{number}" role="{role}"/>' for number, role in enumerate(roles, 1))
    found = features(tmp_path, "<osm>" + "".join(nodes for nodes, _ in rings) + ways + f'<relation id="9">{members}'
                     '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation></osm>')
    assert found["relation/9"].area.area == pytest.approx(area)
    assert ("way/2" in found) == (roles[1] != "outer")


def overpass(geometry):
    """Return a house with a courtyard whose ring is two ways, and a shed, as Overpass answers."""
    tagged = {"type": "relation", "id": 7, "tags": {"type": "multipolygon", "building": "yes", "height": "9"}}
    ways = {1: [1, 2, 3], 2: [3, 4, 1], 3: [5, 6, 7, 8, 5], 4: [2, 9, 10, 2]}
    places = {1: (0, 0), 2: (9, 0), 3: (9, 9), 4: (0, 9), 5: (3, 3), 6: (6, 3), 7: (6, 6), 8: (3, 6), 9: (19, 0), 10: (9, 8)}
    def points(way):
        return [{"lon": places[node][0], "lat": places[node][1]} for node in ways[way]]
    members = [{"type": "way", "ref": way, "role": role} | ({"geometry": points(way)} if geometry else {})
               for way, role in ((1, "outer"), (2, "outer"), (3, "inner"))]
    shed = {"type": "way", "id": 4, "nodes": ways[4], "tags": {"building": "shed", "building:levels": "1"}}
    if geometry:
        return [tagged | {"members": members}, shed | {"geometry": points(4)}]
    nodes = [{"type": "node", "id": node, "lon": x, "lat": y} for node, (x, y) in places.items()]
    return [*nodes, *({"type": "way", "id": way, "nodes": ways[way]} for way in (1, 2, 3)), shed, tagged | {"members": members}]


@pytest.mark.parametrize("geometry", [True, False])
def test_answers_of_overpass_in_json(tmp_path, geometry):
    (tmp_path / "a.json").write_text(json.dumps({"version": 0.6, "osm3s": {}, "elements": overpass(geometry)}))
    found = {one.name: one for one in read_json_map(tmp_path / "a.json").features}
    assert found["relation/7"].area.area == pytest.approx(81 - 9) and found["relation/7"].tags["height"] == "9"
    assert found["way/4"].area.area == pytest.approx(40) and len(found) == 2


def test_places_in_xml_as_overpass_answers(tmp_path):
    """As of `[out:xml]` with `out geom;`: no nodes, but places in ways and in members."""
    def places(way):
        return "".join(f'<nd ref="{ref}" lat="{at["lat"]}" lon="{at["lon"]}"/>'
                       for ref, at in zip(way.get("nodes", range(99)), way["geometry"]))
    relation, shed = overpass(True)
    members = "".join(f'<member type="way" ref="{one["ref"]}" role="{one["role"]}">' + places(one).replace("ref", "x")
                      + "</member>" for one in relation["members"])
    found = features(
        tmp_path, f'<osm><way id="4">{places(shed)}<tag k="building" v="shed"/></way><relation id="7"><bounds/>{members}'
        '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation></osm>')
    assert {name: one.area.area for name, one in found.items()} == {
        "relation/7": pytest.approx(81 - 9), "way/4": pytest.approx(40)}


@pytest.mark.parametrize(("elements", "message"), [
    ([{"type": "way", "id": 1, "tags": {"building": "yes"}, "center": {"lat": 1, "lon": 2}}], "out geom"),
    ([{"type": "way", "id": 1, "tags": {"building": "yes"}, "geometry": [{"lat": 91, "lon": 2}]}], "lat=91; allowed"),
    ([{"type": "way", "id": "x"}], "element 1: 'x' is no whole number"), ([7], "element 1 is not an object"),
    ([{"type": "way", "id": 1, "nodes": 5}], "element 1: its nodes are no list"),
    ([{"type": "node", "id": 1, "lat": 1e999, "lon": None}], "element 1 has lon=None")])
def test_answers_of_overpass_that_cannot_be_used(tmp_path, elements, message):
    (tmp_path / "a.json").write_text(json.dumps({"elements": elements}).replace("Infinity", "1e999"))
    with pytest.raises(BadInput, match=message):
        build_scene(tmp_path / "a.json", tmp_path / "out")


@pytest.mark.parametrize(("name", "text"), [
    ("a.json", '{"type": "FeatureCollection", "features": [%s]}'), ("a.geojsonl", "%s\n\n"), ("b.ndjson", "%s\n%s\n"),
    ("a.geojsonseq", "\x1e%s\n\x1e%s\n"), ("a.json", "%s")])
def test_geojson_under_other_endings(tmp_path, name, text):
    house = ('{"type": "Feature", "properties": {"height": 7}, "geometry": {"type": "Polygon", "coordinates": '
             '[[[8, 47], [8.001, 47], [8.001, 47.001], [8, 47]]]}}')
    (tmp_path / name).write_text(text.replace("%s", house))
    found = read_json_map(tmp_path / name).features
    assert len(found) == text.count("%s") and found[0].tags["height"] == "7"


def test_ways_that_overpass_gives_twice_keep_their_tags(tmp_path):
    """As of `out body; >; out skel qt;`, which the page of Overpass proposes."""
    nodes, way = ring(1, 0, 10)
    (one,) = features(
        tmp_path, f'<osm>{way}<tag k="building" v="yes"/><tag k="height" v="7"/></way>{nodes}{way}</way></osm>').values()
    assert one.tags["height"] == "7" and one.area.area == pytest.approx(100)
    elements = overpass(False)
    elements.append({key: value for key, value in elements[-2].items() if key != "tags"})  # the shed
    (tmp_path / "a.json").write_text(json.dumps({"elements": elements}))
    assert {one.name for one in read_json_map(tmp_path / "a.json").features} == {"relation/7", "way/4"}


@pytest.mark.parametrize("remark", [True, False])
@pytest.mark.parametrize("name", ["a.osm", "a.json"])
def test_an_answer_of_overpass_that_is_not_whole_is_told(tmp_path, name, remark):
    """Overpass ends an answer that ran out of time with a remark, after what it had found."""
    text = "runtime error: Query timed out in &quot;query&quot; at line 3 after 26 seconds."
    if name == "a.osm":
        content = f"<osm>{f'<remark> {text} </remark>' if remark else ''}</osm>"
    else:
        content = json.dumps({"elements": []} | ({"remark": text} if remark else {}))
    (tmp_path / name).write_text(content)
    with pytest.raises(BadInput, match="holds no buildings") as told:
        build_scene(tmp_path / name, tmp_path / "scene")
    assert ("[timeout:600]" in str(told.value)) == remark
