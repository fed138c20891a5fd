"""Maps that break what native libraries take for granted: surfaces of manifold3d, geometries of GEOS, names of SQLite.

Each of these ended, or could end, the process itself; a message or a scene is expected.
"""

import json
import shutil
import sqlite3
import struct

import numpy as np
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.readers import build_scene
from radiotwin.scene.readers.gis_files import area_of_wkb
from tests.scene.readers import city_models as made
from tests.scene.readers.conftest import write_table

SQUARE = shapely.box(8.7, 47.5, 8.7002, 47.5001)
RING = shapely.get_coordinates(SQUARE)


def city(tmp_path, model):
    path = tmp_path / "a.city.json"
    path.write_text(json.dumps(model))
    return build_scene(path, tmp_path / "out", check_only=True)


def surfaces(model):
    return model["CityObjects"]["B0-0"]["geometry"][0]["boundaries"][0]


def without_semantics():
    model = made.cityjson([(0, 0, 0)])
    del model["CityObjects"]["B0-0"]["geometry"][0]["semantics"]
    return model


def test_surfaces_without_their_neighbours(tmp_path):
    """Of a public model: walls and a roof share no corners, and no edge has a partner."""
    model = without_semantics()
    model["CityObjects"]["B0-0"]["geometry"] = [{
        "type": "MultiSurface", "lod": "2", "boundaries": [[ring] for ring in (
            [4, 5, 1, 0], [1, 5, 8, 9, 6, 2], [2, 6, 7, 3, 0], [8, 9, 7, 4], [0, 9, 4], [5, 9, 8])]}]
    report = city(tmp_path, model)
    assert "1 building(s) are not closed" in report.problems[0].message


def test_corners_in_a_row_stay_in_a_closed_shell(tmp_path):
    """The wall of the gable has a corner that, as seen from the side, lies on a straight line."""
    model = without_semantics()
    model["vertices"] += [[5_000, -800, 0]]  # in the middle of the bottom edge of a wall, 0.8 m out of it
    for surface in surfaces(model):
        ring = surface[0]
        for at in range(len(ring)):
            if {ring[at], ring[(at + 1) % len(ring)]} == {0, 1}:
                ring.insert(at + 1, 10)
                break
    report = city(tmp_path, model)
    assert not report.problems
    assert dict(report.facts)["buildings"] == "1 in 1 blocks"


@pytest.mark.parametrize("seed", range(20))
def test_broken_shells_end_in_a_message_or_a_scene(tmp_path, seed):
    rng, model = np.random.default_rng(seed), without_semantics()
    shell = surfaces(model)
    for _ in range(rng.integers(1, 4)):
        surface = shell[rng.integers(len(shell))]
        ring, what = surface[0], rng.integers(7)
        if what == 0:
            shell.remove(surface)
        elif what == 1:
            shell.append([list(ring)])
        elif what == 2:
            ring[rng.integers(len(ring))] = int(rng.integers(10))
        elif what == 3:
            ring.append(ring[0])
        elif what == 4:
            ring.reverse()
        elif what == 5:
            model["vertices"][rng.integers(10)] = model["vertices"][rng.integers(10)]
        else:
            surface.append([int(each) for each in rng.integers(0, 10, 3)])
    try:
        city(tmp_path, model)
    except BadInput:
        pass


@pytest.mark.parametrize("shell", [[], [[]], [[[]]], [[[0]]], [[[0, 1]]], [[[0, 0, 0]]], [[[0, 1, 2]]], [[[0, 1, 2]], [[0, 2, 1]]],
                                   [[[0, 1, 2, 3]]] * 5000, [[list(range(10)) * 50]], [[[0, 3, 2, 1], [0, 3, 2, 1]]]])
@pytest.mark.parametrize("more", [False, True])
def test_empty_flat_and_repeated_shells(tmp_path, shell, more):
    model = without_semantics()
    model["CityObjects"]["B0-0"]["geometry"][0]["boundaries"][0] = shell + more * surfaces(model)
    try:
        city(tmp_path, model)
    except BadInput:
        assert not more or len(shell) > 100


def test_surfaces_that_are_in_the_file_many_times_count_once(tmp_path):
    model = without_semantics()
    model["CityObjects"]["B0-0"]["geometry"][0]["boundaries"][0] = surfaces(model) * 2000
    report = city(tmp_path, model)
    assert not report.problems and dict(report.facts)["buildings"] == "1 in 1 blocks"


def test_surfaces_on_top_of_each_other(tmp_path):
    rng, model = np.random.default_rng(0), without_semantics()
    model["vertices"] = rng.integers(0, 10_000, (9000, 3)).tolist()
    model["CityObjects"]["B0-0"]["geometry"] = [{
        "type": "MultiSurface", "lod": "2", "boundaries": np.arange(9000).reshape(-1, 1, 3).tolist()}]
    with pytest.raises(BadInput, match="B0: .* pairs of a building, part or roof and one around it"):
        city(tmp_path, model)


def test_a_face_that_crosses_itself_everywhere(tmp_path):
    rng = np.random.default_rng(0)
    lines = [f"v {x:g} {y:g} 5" for x, y in 100 * rng.random((1000, 2))] + ["f " + " ".join(map(str, range(1, 1001)))]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    with pytest.raises(BadInput, match="a face of 1,000 corners: .* crossings of outlines with themselves; at most 2,000"):
        build_scene(tmp_path / "a.obj", tmp_path / "out", check_only=True)


def wkb(kind, *parts, order="<"):
    return (b"\1" if order == "<" else b"\0") + struct.pack(order + "II", kind, len(parts)) + b"".join(parts)


def line(kind, points=RING):
    return b"\1" + struct.pack("<II", kind, len(points)) + np.ascontiguousarray(points).tobytes()


def nested(kind, levels, order="<"):
    return wkb(kind, b"", order=order)[:9] * levels + shapely.to_wkb(SQUARE)


@pytest.mark.parametrize("data", [*(nested(kind, 100_000) for kind in (4, 5, 6, 7, 1007, 3007, 10, 12)),
                                  nested(7, 100_000, ">"), wkb(7, shapely.to_wkb(SQUARE), nested(7, 100_000))])
def test_geometries_within_geometries_without_end(data):
    with pytest.raises(BadInput, match="row 1: 101 levels of nesting; at most 100"):
        area_of_wkb(data, "row 1")


@pytest.mark.parametrize("data", [
    b"", b"\1", b"\1\3", wkb(3, b"")[:9], b"\1" + struct.pack("<II", 3, 2**32 - 1), b"\1" + struct.pack("<II", 6, 2**32 - 1),
    b"\1" + struct.pack("<III", 3, 1, 2**32 - 1), wkb(99), shapely.to_wkb(SQUARE)[:-3], wkb(6, shapely.to_wkb(shapely.Point(1, 2)))])
def test_damaged_geometries(data):
    with pytest.raises(shapely.errors.GEOSException):
        area_of_wkb(data, "row 1")


@pytest.mark.parametrize("dimensions", ["xy", "xyz", "xym", "xyzm"])
@pytest.mark.parametrize("flavor", ["iso", "extended"])
def test_levels_and_heights_of_geometries(dimensions, flavor):
    rows = np.column_stack([RING] + [RING[:, 0]] * (len(dimensions) - 2))
    more = {"xy": 0, "xyz": 1, "xym": 2, "xyzm": 3}[dimensions]
    kind = 3 + 1000 * more if flavor == "iso" else 3 | (more & 1) << 31 | (more >> 1) << 30
    polygon = b"\1" + struct.pack("<III", kind, 1, len(rows)) + rows.tobytes()
    for data in (polygon, wkb(6, polygon), wkb(7, wkb(7, wkb(7, polygon)))):
        area = area_of_wkb(data, "row 1")
        assert shapely.get_parts(area)[0].area == pytest.approx(SQUARE.area)


def test_curves_and_what_is_not_finite_are_no_area():
    curve = wkb(10, line(8, RING[[0, 2, 0]]))
    for data in (curve, wkb(12, shapely.to_wkb(SQUARE), curve), wkb(11, line(2)), wkb(16), wkb(15, shapely.to_wkb(SQUARE)),
                 wkb(3, struct.pack("<I", 4) + np.full((4, 2), np.inf).tobytes()), shapely.to_wkb(shapely.Point(np.inf, 0))):
        assert area_of_wkb(data, "row 1") is None


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Two buildings in a GeoPackage."""
    return write_table(tmp_path_factory.mktemp("package") / "town.gpkg", [
        SQUARE, shapely.transform(SQUARE, lambda xy: xy + 0.001)], layer="houses", height=[9.0, 12.0])


def changed(package, tmp_path, *blobs):
    path = tmp_path / "a.gpkg"
    shutil.copy(package, path)
    with sqlite3.connect(path) as database:
        for name, in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f'DROP TRIGGER "{name}"')
        for number, blob in enumerate(blobs, start=1):
            database.execute("UPDATE houses SET geom = ? WHERE fid = ?", (b"GP\0\1" + struct.pack("<i", 4326) + blob, number))
    database.close()
    return path


def test_a_package_with_curves_says_so(package, tmp_path):
    curve = wkb(10, line(8, RING[[0, 2, 0]]))
    report = build_scene(changed(package, tmp_path, curve), tmp_path / "out", check_only=True)
    assert "1 building(s) have no geometry, or one that is not read (not finite, a curve" in report.problems[0].message
    with pytest.raises(BadInput, match=r"(?s)holds no buildings.*2 building\(s\).*CONVERT_TO_LINEAR"):
        build_scene(changed(package, tmp_path, curve, curve), tmp_path / "out", check_only=True)
    with pytest.raises(BadInput, match="a.gpkg: houses 2: 101 levels of nesting"):
        build_scene(changed(package, tmp_path, curve, nested(7, 20_000)), tmp_path / "out", check_only=True)


@pytest.mark.parametrize("old", [b"height", b'"geom"', b"houses", b'TABLE "houses"', b"srs_name"])
def test_names_of_a_schema_that_are_no_text(package, tmp_path, old):
    path = tmp_path / "a.gpkg"
    path.write_bytes(package.read_bytes().replace(old, old[:2] + b"\xff" + old[3:]))
    try:
        build_scene(path, tmp_path / "out", check_only=True)
    except BadInput as error:
        assert "a.gpkg" in str(error)


def test_many_buildings_in_one_place(tmp_path):
    model = without_semantics()
    part = model["CityObjects"].pop("B0-0")
    model["CityObjects"] = {f"B{number}": {"type": "Building", "geometry": part["geometry"]} for number in range(1500)}
    with pytest.raises(BadInput, match="pairs of a building, part or roof and one around it; at most 2,000,000"):
        city(tmp_path, model)
