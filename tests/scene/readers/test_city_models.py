"""CityJSON and CityGML: houses of known size become solids of that size at their places."""

import gzip
import json

import numpy as np
import pandas as pd
import pytest
import shapely
import trimesh
from pyproj import Transformer

from radiotwin.errors import BadInput
from radiotwin.geo import to_local
from radiotwin.io.budgets import TAG_BYTES, VERTICES
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.scene.readers.citygml import read_citygml
from radiotwin.scene.readers.gis_files import read_json_map
from tests.scene.readers import city_models as made

HOUSES = [(0, 0, 1.2), (10, 0, 1.5), (40, 0, 1.2)]  # the first two share a wall


def write(folder, content, name="a.city.json"):
    (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))
    return folder / name


def gml_houses(houses, **more):
    return [made.house(691_000 + x, 5_336_000 + y, 500 + z, f"H{number}", **more)
            for number, (x, y, z) in enumerate(houses)]


def solids(report):
    return {path.stem: trimesh.load(path, process=False) for path in (report.folder / "meshes").glob("*.ply")
            if path.stem != "ground"}


@pytest.mark.parametrize("kind", ["CityJSON 2.0", "sequence", "gz", "LoD 1", "names surfaces", "holds surfaces"])
def test_houses_become_solids(tmp_path, kind):
    if "surfaces" in kind:
        path = write(tmp_path, made.citygml(gml_houses(HOUSES, refer=kind == "names surfaces")), "a.gml")
    elif kind == "sequence":
        whole = made.cityjson(HOUSES)
        lines = [whole | {"CityObjects": {}, "vertices": []}]
        for number in range(3):
            keys = [f"B{number}", f"B{number}-0"]
            lines.append({"type": "CityJSONFeature", "id": keys[0], "vertices": whole["vertices"],
                          "CityObjects": {key: whole["CityObjects"][key] for key in keys}})
        path = write(tmp_path, "\n".join(map(json.dumps, lines)), "a.city.jsonl")
    elif kind == "gz":
        path = tmp_path / "a.city.json.gz"
        path.write_bytes(gzip.compress(json.dumps(made.cityjson(HOUSES)).encode()))
    else:
        path = write(tmp_path, made.cityjson(HOUSES, lod="1.3" if kind == "LoD 1" else "2.2"))
    report = build_scene_from_map(path, tmp_path / "out")
    found = solids(report)
    assert len(found) == 2 and all(mesh.is_volume for mesh in found.values())
    # Each projection has a scale of its own: UTM 0.9996 at its meridian, RD 0.9999
    assert sum(mesh.volume for mesh in found.values()) == pytest.approx(3 * made.VOLUME_M3, rel=2e-3)
    assert max(mesh.bounds[1, 2] for mesh in found.values()) == pytest.approx(made.RIDGE_M, abs=1e-3)
    assert min(mesh.bounds[0, 2] for mesh in found.values()) == pytest.approx(0, abs=1e-3)
    facts = dict(report.facts)
    assert facts["buildings"] == "3 in 2 blocks" and facts["heights from"].startswith("model: 3, default: 0")
    assert "begin at " in facts["elevations"] and not report.problems
    table = pd.read_csv(report.folder / "buildings.csv")
    assert table["area_m2"].tolist() == pytest.approx([120] * 3, rel=2e-3) and set(table["height_from"]) == {"model"}


def test_a_house_lies_where_the_model_says(tmp_path):
    report = build_scene_from_map(write(tmp_path, made.cityjson(HOUSES)), tmp_path / "out")
    scene = Scene.load(report.folder)
    degrees = Transformer.from_crs("EPSG:28992", "EPSG:4326", always_xy=True).transform(
        np.array([85_045.0, 85_042.5]), np.array([446_006.0, 446_006.0]))
    x_m, y_m = to_local(scene.config.origin, *degrees)  # the ridge of the third house, and half way to its eaves
    assert scene.city.height_at(x_m, y_m) == pytest.approx([9.0, 7.5], abs=0.01)


@pytest.mark.seconds
def test_an_outline_of_citygml(tmp_path):
    points = made.corners(691_000, 5_336_000, 500)[:4]
    for name, dimension, attributes, top_m in (
            ("flat", 2, '<bldg:measuredHeight uom="m">7.5</bldg:measuredHeight>', 7.5),
            ("feet", 3, '<bldg:measuredHeight uom="ft">30</bldg:measuredHeight>', 9.144),
            ("AdV", 3, "".join(f'<gen:stringAttribute name="{key}"><gen:value>{value}</gen:value></gen:stringAttribute>'
                               for key, value in (("HoeheGrund", "500.1"), ("HoeheDach", "508.6"))), 8.5),
            ("storeys", 3, "<bldg:storeysAboveGround>4</bldg:storeysAboveGround>", 12),
            ("3.0", 3, '<con:height><con:Height><con:value uom="m">6.5</con:value></con:Height></con:height>', 6.5)):
        outline = ("<bldg:lod0FootPrint><gml:MultiSurface><gml:surfaceMember>" + made.polygon(points, "p", dimension)
                   + "</gml:surfaceMember></gml:MultiSurface></bldg:lod0FootPrint>")
        path = write(tmp_path, made.citygml([made.building(outline, "H", attributes)]).replace(
            "xmlns:bldg", 'xmlns:con="c" xmlns:bldg'), "a.gml")
        report = build_scene_from_map(path, tmp_path / name)
        assert pd.read_csv(report.folder / "buildings.csv")["top_m"].tolist() == [pytest.approx(top_m, abs=1e-3)], name


def outlines_of_citygml(footprint, edge):
    """Names of the elements around a footprint of 10 x 12 m and a roof edge half a metre beyond it; "": without one."""
    (x0, y0, _), _, (x1, y1, z), _ = made.corners(691_000, 5_336_000, 500)[:4]
    found = ""
    for names, beyond_m in ((footprint, 0.0), (edge, 0.5)):
        if names:
            points = [(x, y, z) for x, y in shapely.box(x0 - beyond_m, y0 - beyond_m, x1 + beyond_m, y1 + beyond_m)
                      .exterior.coords[:-1]]
            tags = [f"bldg:{name}" for name in names.split()] + ["gml:MultiSurface", "gml:surfaceMember"]
            found += "".join(f"<{tag}>" for tag in tags) + made.polygon(points, f"p{beyond_m}") + "".join(
                f"</{tag}>" for tag in reversed(tags))
    return found


@pytest.mark.parametrize(("footprint", "edge", "area_m2"), [
    ("lod0FootPrint", "lod0RoofEdge", 120), ("", "lod0RoofEdge", 143), ("lod0FootPrint", "", 120),
    ("boundary GroundSurface lod0MultiSurface", "boundary RoofSurface lod0MultiSurface", 120),
    ("", "boundary RoofSurface lod0MultiSurface", 143)])
def test_the_footprint_counts_before_the_edge_of_the_roof(tmp_path, footprint, edge, area_m2):
    content = made.building(outlines_of_citygml(footprint, edge), "H",
                            '<bldg:measuredHeight uom="m">12</bldg:measuredHeight>')
    report = build_scene_from_map(write(tmp_path, made.citygml([content]), "a.gml"), tmp_path / "out")
    assert pd.read_csv(report.folder / "buildings.csv")["area_m2"].tolist() == [pytest.approx(area_m2, rel=2e-3)]
    assert not report.problems


def test_parts_of_a_building_stand_on_its_ground(tmp_path):
    part = made.house(691_010, 5_336_000, 503, "P").removeprefix("<core:cityObjectMember>").removesuffix(
        "</core:cityObjectMember>").replace("bldg:Building", "bldg:BuildingPart")
    whole = made.house(691_000, 5_336_000, 500, "H").replace(
        "</bldg:Building>", f"<bldg:consistsOfBuildingPart>{part}</bldg:consistsOfBuildingPart></bldg:Building>")
    report = build_scene_from_map(write(tmp_path, made.citygml([whole]), "a.gml"), tmp_path / "out")
    table = pd.read_csv(report.folder / "buildings.csv")
    assert table["building"].tolist() == ["H", "H"] and sorted(table["bottom_m"]) == [0, 3] and max(table["top_m"]) == 12


def test_what_is_inside_of_a_building_and_placed_copies_are_left_out(tmp_path):
    room = ("<bldg:interiorRoom><bldg:Room><bldg:lod2Solid>" + made.polygon(made.corners(0, 0, 0)[:4], "r")
            + "</bldg:lod2Solid></bldg:Room></bldg:interiorRoom><bldg:lod2ImplicitRepresentation><core:ImplicitGeometry>"
            + made.polygon(made.corners(0, 0, 0)[:4], "i") + "</core:ImplicitGeometry></bldg:lod2ImplicitRepresentation>")
    whole = made.house(691_000, 5_336_000, 500, "H").replace("</bldg:Building>", f"{room}</bldg:Building>")
    (one,) = read_citygml(write(tmp_path, made.citygml([whole]), "a.gml")).features
    assert len(one.shell.polygons) == len(made.FACES)


TEMPLATE = {"type": "GeometryInstance", "template": 0, "boundaries": [0], "transformationMatrix": [1] * 16}


@pytest.mark.parametrize("geometry", [[], [TEMPLATE]])
def test_what_is_no_building_is_told(tmp_path, geometry):
    model = made.cityjson(HOUSES)
    del model["CityObjects"]["B0-0"]
    model["CityObjects"]["B0"] = {"type": "Building", "geometry": geometry}
    for name, kind in (("T", "TINRelief"), ("X", "+Fence")):
        model["CityObjects"][name] = {"type": kind, "geometry": [
            {"type": "CompositeSurface", "lod": "1", "boundaries": [[[0, 1, 2]]]}]}
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "scene")
    said = "\n".join(one.message for one in report.problems)
    assert len(pd.read_csv(report.folder / "buildings.csv")) == 2
    assert "1 object(s) have no surfaces" in said and "'B0'" in said
    assert "2 objects are neither buildings nor bridges" in said and "'TINRelief: 1'" in said


def test_each_building_of_a_group_stands_on_its_own_ground(tmp_path):
    model = made.cityjson([(0, 0, 1.0), (40, 0, 31.0)])
    for name in ("B0", "B1"):
        model["CityObjects"][name]["parents"] = ["street"]
    model["CityObjects"]["street"] = {"type": "CityObjectGroup", "children": ["B0", "B1"], "geometry": []}
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "scene")
    rows = pd.read_csv(report.folder / "buildings.csv")
    assert rows["building"].tolist() == ["B0", "B1"]
    assert (rows["bottom_m"] == 0).all() and rows["top_m"].tolist() == pytest.approx([9, 9], abs=0.01)


@pytest.mark.parametrize("lost", [0, 5])
def test_an_open_shell_is_kept_and_told(tmp_path, lost):
    model = made.cityjson([(0, 0, 0)])
    part = model["CityObjects"]["B0-0"]["geometry"][0]
    del part["boundaries"][0][lost], part["semantics"]["values"][0][lost]
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "out")
    assert "1 building(s) are not closed, or cross themselves" in report.problems[0].message
    (mesh,) = solids(report).values()
    assert not mesh.is_watertight and mesh.bounds[1, 2] == pytest.approx(9, abs=1e-3)
    up = mesh.face_normals[:, 2] > 0.5  # roofs face outwards
    assert up.sum() == 4 if lost == 0 else up.any()


def test_a_wall_with_a_hole(tmp_path):
    """A tunnel through the house, from wall to wall: 4 x 3 x 10 m less."""
    model = made.cityjson([(0, 0, 0)])
    hole = [[[x, y, z] for y, z in ((4, 1), (8, 1), (8, 4), (4, 4))] for x in (0, 10)]
    first = len(model["vertices"])
    model["vertices"] += [[round(1000 * value) for value in corner] for ring in hole for corner in ring]
    shell = model["CityObjects"]["B0-0"]["geometry"][0]["boundaries"][0]
    shell[4].append([first + i for i in (0, 1, 2, 3)])  # x = 0
    shell[2].append([first + 4 + i for i in (3, 2, 1, 0)])  # x = 10
    shell += [[[first + i, first + (i + 1) % 4, first + 4 + (i + 1) % 4, first + 4 + i][::-1]] for i in range(4)]
    del model["CityObjects"]["B0-0"]["geometry"][0]["semantics"]
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "out")
    (mesh,) = solids(report).values()
    assert mesh.is_volume and mesh.volume == pytest.approx(made.VOLUME_M3 - 120, rel=2e-3)


def turn_surfaces(model):
    for surface in model["CityObjects"]["B0-0"]["geometry"][0]["boundaries"][0][::2]:
        surface[0].reverse()


def own_part(model):
    model["CityObjects"]["B0"]["parents"] = ["B0-0"]


def in_feet(model):  # New York's model is in feet, its elevations, too
    model["metadata"]["referenceSystem"] = "https://www.opengis.net/def/crs/EPSG/0/2263"
    model["transform"]["translate"] = [987_000, 195_000, 0]


@pytest.mark.parametrize(("change", "unit_m"), [(turn_surfaces, 1.0), (own_part, 1.0), (in_feet, 0.3048003)])
def test_models_that_differ_make_the_same_solid(tmp_path, change, unit_m):
    model = made.cityjson([(0, 0, 0)])
    change(model)
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "out")
    (mesh,) = solids(report).values()
    assert mesh.is_volume and mesh.volume == pytest.approx(made.VOLUME_M3 * unit_m**3, rel=2e-3)


def test_neighbours_of_other_materials_are_apart(tmp_path):
    model = made.cityjson(HOUSES[:2])
    model["CityObjects"]["B1"]["attributes"] = {"building_material": "brick"}
    report = build_scene_from_map(write(tmp_path, model), tmp_path / "out")
    found = solids(report)
    assert len(found) == 2 and all(mesh.is_volume for mesh in found.values())
    assert {use.name: use.shapes for use in report.materials}["brick"] == 1
    assert sum(mesh.volume for mesh in found.values()) == pytest.approx(2 * made.VOLUME_M3, rel=4e-3)
    first, second = found.values()
    assert trimesh.boolean.intersection([first, second], engine="manifold").is_empty  # between them is a slot


def test_a_box_keeps_all_parts_of_a_building(tmp_path):
    """Their heights count from the lowest point of all: the part in the box would else stand in the air."""
    path = write(tmp_path, made.in_one_building(made.cityjson([(0, 0, 500), (50, 0, 505)])))
    west, south = Transformer.from_crs("EPSG:28992", "EPSG:4326", always_xy=True).transform(85_040, 445_990)
    report = build_scene_from_map(path, tmp_path / "out", BuildOptions(bbox=(south, west, south + 0.001, west + 0.001)))
    table = pd.read_csv(report.folder / "buildings.csv")
    assert table["building"].tolist() == ["B0", "B0"] and sorted(table["bottom_m"]) == [0, 5]


def broken(change):
    model = made.cityjson([(0, 0, 0)])
    change(model)
    return json.dumps(model)


def set_at(*keys, value):
    def change(model):
        for key in keys[:-1]:
            model = model[key]
        model[keys[-1]] = value
    return change


SOLID = ("CityObjects", "B0-0", "geometry", 0)
BAD_JSON = {
    "{": "not readable JSON", "[]": "is neither CityJSON", "{}": "is neither CityJSON", "": "not readable JSON",
    broken(set_at("type", value="FeatureCollection")): "is not a GeoJSON",
    broken(set_at("transform", value={"scale": [1]})): "transform is not a scale",
    broken(set_at("transform", "scale", value=[1, float("inf"), 1])): "not readable JSON|transform is not",
    broken(set_at("vertices", value=[[1, 2]])): "no vertices of three numbers",
    broken(set_at("vertices", value={"a": 1})): "no vertices of three numbers",
    broken(set_at("CityObjects", value=[1])): "no vertices of three numbers",
    broken(set_at("CityObjects", "B0-0", value=7)): "object 'B0-0' is not as CityJSON has it",
    broken(set_at(*SOLID, "boundaries", value=[[[[0, 1, 99]]]])): "object 'B0-0' is not as CityJSON",
    broken(set_at(*SOLID, "boundaries", value=[[[[0, 1, -1]]]])): "object 'B0-0' is not as CityJSON",
    broken(set_at(*SOLID, "boundaries", value=[0, 1])): "object 'B0-0' is not as CityJSON",
    broken(set_at(*SOLID, "boundaries", value=[[[[10**30] * 4]]])): "object 'B0-0' is not as CityJSON",
    broken(set_at(*SOLID, "lod", value="high")): "object 'B0-0' is not as CityJSON",
    broken(set_at("metadata", value={})): "names no coordinate reference system",
    broken(set_at("metadata", "referenceSystem", value="EPSG:25832")): "not in the area of 'ETRS89 / UTM zone 32N'",
    broken(set_at("metadata", "referenceSystem", value="+init=/etc/passwd")): "is unknown",
    broken(set_at("vertices", value=[[1e30] * 3] * 10)): "not in the area of|km wide",
    broken(set_at("CityObjects", value={})): "holds no buildings",
    '{"type": "CityJSON", "vertices": [], "CityObjects": ' + "[" * 10_000: "levels of nesting",
}


GOOD_GML = made.citygml(gml_houses([(0, 0, 0)]))
BAD_GML = {
    "": "malformed XML", GOOD_GML[:3000]: "malformed XML", "<gpx/>": "begins with <gpx>, not <CityModel>",
    GOOD_GML.replace("691000.000", "east"): "line 1: 'east .* is no list of positions of 3 numbers",
    GOOD_GML.replace("691000.000 ", "", 1): "no list of positions of 3 numbers",
    GOOD_GML.replace("691000.000", "nan"): "corners are not finite",
    GOOD_GML.replace('"urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH"', '"EPSG:28992"'): "not in the area of",
    GOOD_GML.replace("srsName", "srs"): "names no coordinate reference system",
    GOOD_GML.replace("<gml:lowerCorner", '<gml:lowerCorner srsName="EPSG:31468"'): "names several coordinate reference",
    GOOD_GML.replace("?>", '?><!DOCTYPE a [<!ENTITY x "y">]>', 1): "declares the entity",
    made.citygml([]): "holds no buildings", "<a>" * 200: "begins with <a>",
    "<CityModel>" + "<a>" * 200: "levels of nesting",
}


@pytest.mark.parametrize(("name", "text", "message"), [
    *(("a.city.json", *row) for row in BAD_JSON.items()), *(("a.gml", *row) for row in BAD_GML.items())])
def test_broken_models(tmp_path, name, text, message):
    with pytest.raises(BadInput, match=message):
        build_scene_from_map(write(tmp_path, text, name), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_budgets(tmp_path, monkeypatch):
    monkeypatch.setenv(VERTICES.variable, "20")
    with pytest.raises(BadInput, match="vertices; at most 20"):
        read_json_map(write(tmp_path, made.cityjson(HOUSES)))
    with pytest.raises(BadInput, match="vertices; at most 20"):
        read_citygml(write(tmp_path, GOOD_GML, "a.gml"))


def test_roofs_of_a_material_of_their_own(tmp_path):
    options = BuildOptions(materials={"roof": "metal"})
    report = build_scene_from_map(write(tmp_path, made.cityjson(HOUSES)), tmp_path / "out", options)
    assert {use.name: use.shapes for use in report.materials} == {"concrete": 2, "metal": 2, "asphalt_concrete": 1}
    assert dict(report.facts)["buildings"] == "3 in 2 blocks"
    found = solids(report)
    roofs = [mesh for name, mesh in found.items() if name.endswith("_roof")]
    # Two slopes a house, of 5 m to 3 m of height: sqrt(34) wide and 12 m long
    assert sum(mesh.area for mesh in roofs) == pytest.approx(3 * 2 * 34**0.5 * 12, rel=2e-3)
    assert any("nothing diffracts there" in problem.message for problem in report.problems)


def test_a_text_without_an_end(tmp_path, monkeypatch):
    monkeypatch.setenv(TAG_BYTES.variable, "10_000")
    text = GOOD_GML.replace("691000.000", "1 " * 6_000, 1)
    with pytest.raises(BadInput, match="a.gml, line 1: 12,.* bytes in one tag; at most 10,000"):
        read_citygml(write(tmp_path, text, "a.gml"))
