"""Cities as OBJ, glTF, STL and PLY: read as trimesh writes them, and refused where they are damaged."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.io.budgets import SHAPES, VERTICES
from radiotwin.scene import meshes, models
from radiotwin.scene.build import build_scene
from radiotwin.scene.importer import import_city
from radiotwin.scene.models import read_model

BOXES = {"tower": ((0, 0, 0), (20, 30, 40)), "shed": ((100, 0, 0), (110, 8, 4))}


def box(low, high):
    return trimesh.creation.box(bounds=[low, high])


@pytest.fixture
def city():
    """Two buildings on a ground of 300 x 200 m, z up."""
    scene = trimesh.Scene()
    ground = trimesh.Trimesh([[-100, -100, 0], [200, -100, 0], [200, 100, 0], [-100, 100, 0]], [[0, 1, 2], [0, 2, 3]])
    for name, material, mesh in (("ground", "itu_wet_ground", ground), ("tower", "mat-itu_metal", box(*BOXES["tower"])),
                                 ("shed", "Wood.001", box(*BOXES["shed"]))):
        mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name=material))
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    return scene


def y_up(scene):
    return scene.copy().apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write(folder, name, scene):
    """Write the city as trimesh does; OBJ by hand, as trimesh joins its objects."""
    path = folder / name
    if path.suffix == ".glb":
        path.write_bytes(y_up(scene).export(file_type="glb"))
    elif path.suffix == ".gltf":
        for file, data in y_up(scene).export(file_type="gltf").items():
            (folder / (name if file == "model.gltf" else file)).write_bytes(data)
    elif path.suffix == ".obj":
        lines, first = ["mtllib ../../etc/passwd"], 1
        for key, mesh in scene.geometry.items():
            mesh = mesh.copy().apply_transform(scene.graph[key][0])
            lines += [f"o {key}", f"usemtl {mesh.visual.material.name}", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices),
                      *(f"f {a}//1 {b}//1 {c}//1" for a, b, c in mesh.faces + first)]
            first += len(mesh.vertices)
        path.write_text("\n".join(lines))
    else:
        path.write_bytes(b"")
        trimesh.util.concatenate(list(scene.geometry.values())).export(path)
    return path


@pytest.mark.parametrize("name", ["a.obj", "a.glb", "a.gltf"])
def test_objects_with_their_materials(tmp_path, city, name):
    report = build_scene(write(tmp_path, name, city), tmp_path / "out")
    assert {use.name: use.shapes for use in report.materials} == {"wet_ground": 1, "metal": 1, "wood": 1}
    assert report.tallest == "tower" and report.tallest_m == pytest.approx(40) and not report.problems
    for key, (low, high) in BOXES.items():
        mesh = trimesh.load(tmp_path / "out" / "meshes" / f"{key}.ply", process=False)
        assert mesh.is_volume and np.allclose(mesh.bounds, (low, high), atol=1e-4)


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "ascii.stl"])
def test_formats_without_objects_are_taken_apart(tmp_path, city, name):
    path = write(tmp_path, name, city)
    if name == "ascii.stl":
        path.write_text(trimesh.load(path).export(file_type="stl_ascii"))
    found = import_city(path, {"default": "brick"})
    assert [material.name for material in found.materials] == ["brick"] * 3 and not found.problems
    assert found.surfaces.vertices[:, 2].max() == pytest.approx(40)


def test_materials_of_other_names(tmp_path, city):
    path = write(tmp_path, "a.stl", city)
    (problem,) = import_city(path, {}).problems
    assert "1 material(s) have no name of an ITU material ('(no material)'): concrete was taken" in problem.message
    with pytest.raises(BadInput, match="material 'roof' is to be replaced, but the city does not use it"):
        import_city(path, {"roof": "metal"})
    found = import_city(write(tmp_path, "a.obj", city), {"Wood.001": "glass"})
    assert {material.name for material in found.materials} == {"wet_ground", "metal", "glass"}


def test_the_axis_of_a_model_can_be_declared(tmp_path, city):
    path = write(tmp_path, "a.obj", y_up(city))
    assert "the axis y seems to point up, not z" in import_city(path, {}).problems[0].message
    assert not import_city(write(tmp_path, "b.glb", city), {}).problems, "a rule of the format"
    found = import_city(path, {}, up="y")
    assert not found.problems and found.surfaces.vertices[:, 2].max() == pytest.approx(40)


def test_warnings_are_about_what_is_in_the_box(tmp_path, city):
    text = write(tmp_path, "a.obj", city).read_text() + (
        "\no far away\nusemtl Glass.Panel\nv 150 50 0\nv 160 50 0\nv 160 60 0\nv 150 60 9\n"
        "f -4 -3 -2 -1\nf -4 -4 -3\n")
    (tmp_path / "a.obj").write_text(text)
    said = " ".join(problem.message for problem in import_city(tmp_path / "a.obj", {}).problems)
    for part in ("Glass.Panel", "far away -> far_away", "more than three corners", "degenerate"):
        assert part in said
    found = import_city(tmp_path / "a.obj", {}, bbox=(-50, -50, 120, 50))
    assert not found.problems and found.names == ["ground", "tower", "shed"]
    with pytest.raises(BadInput, match="is empty; the city lies in x -100 to 200 m"):
        import_city(tmp_path / "a.obj", {}, bbox=(1000, 1000, 1100, 1100))


def test_transforms_of_objects(tmp_path):
    """Matrix above rotation, translation and scale, one of them mirrored: boxes where the arithmetic puts them."""
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    scene.add_geometry(box((0, 0, 0), (2, 4, 6)), node_name="a", transform=turn)
    data = scene.export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20:20 + length])
    node = next(node for node in document["nodes"] if "mesh" in node)
    node.pop("matrix", None)
    node |= {"rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)], "translation": [100, 0, 0], "scale": [1, 2, -1]}
    (tmp_path / "a.glb").write_bytes(packed(document, data[20 + length:]))
    (part,) = read_model(tmp_path / "a.glb")
    mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False)
    # Scale: z becomes 0 … -6; a quarter turn about y takes z to x; then 100 m along x
    assert np.allclose(mesh.bounds, [[94, 0, -2], [100, 8, 0]], atol=1e-5)
    assert mesh.volume == pytest.approx(2 * 8 * 6)  # still outwards


def packed(document, rest=b""):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def gltf(**changes):
    """A `.gltf` of one triangle, with changes at `a__b__0`."""
    data = base64.b64encode(np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]], "<f4").tobytes()).decode()
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
                "bufferViews": [{"buffer": 0, "byteLength": 36}],
                "buffers": [{"byteLength": 36, "uri": f"data:application/octet-stream;base64,{data}"}]}
    for path, value in changes.items():
        *keys, last = (int(key) if key.isdigit() else key for key in path.split("__"))
        place = document
        for key in keys:
            place = place[key]
        place[last] = value
    return document


CORNERS = [[0, 0, 0], [9, 0, 0], [0, 9, 0], [9, 9, 0], [5, 20, 0], [0, 20, 0]]


@pytest.mark.parametrize(("mode", "faces"), [(4, [[0, 1, 2], [3, 4, 5]]), (5, [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]]),
                                             (6, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])])
def test_triangles_strips_and_fans(tmp_path, mode, faces):
    data = base64.b64encode(np.array(CORNERS, "<f4").tobytes()).decode()
    (tmp_path / "a.gltf").write_text(json.dumps(gltf(
        meshes__0__primitives__0__mode=mode, accessors__0__count=6, bufferViews__0__byteLength=72,
        buffers__0={"byteLength": 72, "uri": f"data:application/octet-stream;base64,{data}"})))
    (part,) = read_model(tmp_path / "a.gltf")
    assert [sorted(face) for face in part.mesh.faces.tolist()] == [sorted(face) for face in faces]
    assert part.mesh.vertices.tolist() == CORNERS


BAD_GLTF = {
    "asset__version": ("1.0", "its version is '1.0'"), "accessors__0__count": (10**9, "claims 1000000000 values"),
    "accessors__0__byteOffset": (-12, "more than the buffer holds"), "bufferViews__0__byteStride": (0.5, "more than the buffer holds"),
    "accessors__0__sparse": ({}, "is sparse"), "accessors__0__componentType": (5125, "component type 5125"),
    "nodes__0__children": ([0], "node 0 stands in its graph twice"), "scenes__0__nodes": ([0, 0], "twice"),
    "scenes__0__nodes__0": (-1, "is no index of nodes"), "nodes__0__mesh": (7, "not a readable glTF"),
    "nodes__0__matrix": ([1, 2], "not a readable glTF"), "nodes__0__scale": ([1e300, 1, 1], "finite|from the origin"),
    "buffers__0__uri": ("http://127.0.0.1/a.bin", "is no file beside it"), "nodes": (7, "nodes is no list"),
    "extensionsRequired": (["KHR_draco_mesh_compression"], "compressed .KHR_draco"),
    "meshes__0__primitives__0__mode": (1, "holds no triangles"), "meshes": ([], "not a readable glTF"),
}


@pytest.mark.parametrize("path", BAD_GLTF)
def test_damaged_gltf(tmp_path, path):
    value, message = BAD_GLTF[path]
    (tmp_path / "a.gltf").write_text(json.dumps(gltf(**{path: value})))
    with pytest.raises(BadInput, match=message):
        import_city(tmp_path / "a.gltf", {})


@pytest.mark.parametrize("uri", ["/etc/passwd", "../secret.bin", "%2e%2e/secret.bin", "link.bin"])
def test_buffers_outside_of_the_folder(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(bytes(36))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "secret.bin")
    (tmp_path / "in" / "a.gltf").write_text(json.dumps(gltf(buffers__0__uri=uri)))
    with pytest.raises(BadInput, match="leads out of"):
        read_model(tmp_path / "in" / "a.gltf")


@pytest.mark.parametrize(("name", "data", "message"), [
    ("a.glb", b"glTF", "has no JSON chunk"), ("a.glb", b"", "not readable JSON"), ("a.glb", b"\xff" * 40, "not a readable"),
    ("a.glb", packed({})[:-1], "cut off"), ("a.glb", packed([]), "not a readable glTF"), ("a.glb", packed({}), "not a readable"),
    ("a.stl", b"", "cut off"), ("a.stl", bytes(80) + b"\xff\xff\xff\x7f", "cut off .84 bytes for 2,147,483,647 triangles"),
    ("a.stl", b"solid x\nvertex 1 2\nendsolid", "row 2: 'vertex 1 2' is not a vertex"),
    ("a.stl", b"solid x\nvertex 1 2 3\n", "cut off in row 2"), ("a.stl", b"solid x\nendsolid", "holds no triangles"),
    ("a.stl", b"solid x\n" + b"vertex 1 nan 3\n" * 3 + b"endsolid", "not finite"),
    ("a.obj", b"v 1 2\n", "row 1: 'v 1 2' is not a vertex"), ("a.obj", b"v 1 2 3\nf 1 2 3", "names vertex 1, there are 1"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\no a\nf 1 2 3\no b\nf 1 2 9\n", "names vertex 8, there are 3"),
    ("a.obj", b"", "holds no triangles"), ("a.ply", b"ply", "a.ply")])
def test_damaged_models(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(BadInput, match=message):
        read_model(tmp_path / name)


def test_budgets(tmp_path, city, monkeypatch):
    paths = [write(tmp_path, name, city) for name in ("a.obj", "a.glb", "a.stl", "a.ply")]
    for budget in (VERTICES, SHAPES):
        with monkeypatch.context() as patch:
            patch.setenv(budget.variable, "1")
            for path in paths:
                with pytest.raises(BadInput, match="at most 1 are read"):
                    read_model(path)


def test_each_object_of_an_obj_file_is_cut_on_its_own_vertices(tmp_path, monkeypatch):
    """With all of them for each, a city of 20,000 houses took a quarter of an hour."""
    lines = []
    for house in range(30):
        corners = [(10 * house + x, y, z) for x, y, z in ((0, 0, 0), (5, 0, 0), (5, 5, 0), (0, 5, 0))]
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        lines += [f"o house{house}", "f " + " ".join(str(4 * house + corner) for corner in (1, 2, 3, 4))]
    (tmp_path / "city.obj").write_text("\n".join(lines) + "\n")
    counts = []
    monkeypatch.setattr(models, "cut_polygons", lambda path, vertices, polygons: (
        counts.append(len(vertices)), meshes.cut_polygons(path, vertices, polygons))[1])
    parts = read_model(tmp_path / "city.obj")
    assert counts == [4] * 30 and [part.name for part in parts][:2] == ["house0", "house1"]
    assert all(len(part.mesh.faces) == 2 and part.mesh.vertices[:, 0].min() == 10 * number for number, part in enumerate(parts))
