import re
import tomllib
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions, build_scene, print_report
from tests.scene.conftest import CUBE_QUADS


def check(source, **options):
    return build_scene(source, "unused", BuildOptions(**options), check_only=True)


def found(report, severity):
    return "\n".join(problem.message for problem in report.problems if problem.severity == severity)


Y_UP = "1 0 0 0  0 0 1 0  0 -1 0 0  0 0 0 1"  # (x, y, z) -> (x, z, -y)


def transformed(town, matrix):
    """The town's file with one more transform for all of its shapes."""
    step = f'<transform name="to_world"><matrix value="{matrix}"/></transform>'
    town.shapes = [shape.replace("<ref", f"{step}<ref") for shape in town.shapes]
    return town


def test_town(town, tmp_path):
    report = build_scene(town.write(), tmp_path / "out", BuildOptions(devices=10, frequency_hz=5.8e9, seed=3))
    assert (report.shapes, report.triangles) == (10, 2 + 9 * 12)
    assert report.extent_m == (-80, 80, -80, 80)
    assert (report.tallest_m, report.tallest) == (24.0, "house8")
    assert report.built_fraction == pytest.approx(9 * 400 / 160**2, abs=0.002)
    assert not report.tracing_would_fail and not report.problems
    (use,) = report.materials
    assert (use.name, use.kind, use.shapes, use.in_range) == ("concrete", "ITU", 10, True)
    assert use.conductivity_s_per_m == pytest.approx(0.0462 * 5.8**0.7822)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"scene.toml", "city.xml", "meshes", "preview.png"}
    scene = Scene.load(tmp_path / "out")
    assert scene.config.name == "town" and scene.config.radio.frequency_hz == 5.8e9
    assert len(scene.config.devices) == 10 and len(scene.config.uavs) == 3
    assert scene.city.height_at(-60.0, -60.0) == pytest.approx(8.0)


@pytest.mark.seconds
def test_same_seed_same_scene_from_anywhere(town, tmp_path):
    path = town.write()
    build_scene(path, tmp_path / "a", BuildOptions(devices=6, seed=1))
    build_scene(path, tmp_path / "b", BuildOptions(devices=6, seed=1))
    (town.folder).rename(tmp_path / "gone")  # the scenes need nothing outside themselves
    assert Scene.load(tmp_path / "a").content_hash() == Scene.load(tmp_path / "b").content_hash()


def test_truncated_ply(town, tmp_path):
    town.add("torn", None, text=town.ply(*town.box((0, 5), (0, 5)))[:-40])
    report = check(town.write())
    assert report.tracing_would_fail and "mesh10.ply is truncated" in found(report, "error")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]  # a check writes nothing
    with pytest.raises(BadInput, match="tracing would fail[^$]*mesh10.ply is truncated"):
        build_scene(town.path, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def only_a_house_on_a_hill(town):
    town.shapes.clear()
    town.add("house", town.box((0, 5), (0, 5), (520, 530)))


@pytest.mark.parametrize(("spoil", "severity", "message"), [
    (lambda town: (town.folder / "mesh3.ply").unlink(), "error", r"mesh3\.ply does not exist \(named in .*line 6"),
    (lambda town: [path.unlink() for path in town.folder.glob("*.ply")], "error", "5 more shapes cannot be read"),
    (lambda town: town.add("stray", town.box((4e6, 4e6 + 20), (0, 20))), "error", "km wide"),
    (lambda town: transformed(town, Y_UP).shapes.pop(0), "error", "the axis y seems to point up"),
    (lambda town: town.shapes.pop(0), "warning", r"there is no ground: [^(]*\(the lowest point is at 0\.00 m\)"),
    (only_a_house_on_a_hill, "warning", "hang in the air")])
def test_what_a_check_finds(town, spoil, severity, message):
    spoil(town)
    report = check(town.write())
    assert re.search(message, found(report, severity)) and report.tracing_would_fail == (severity == "error")
    print_report(report, Console(quiet=True))


@pytest.mark.parametrize(("change", "message"), [
    (lambda text: text[:-4], r"town\.xml, line \d+, column \d+"), (lambda text: "<scene/>", "no shapes")])
def test_what_no_check_can_read(town, change, message):
    town.path.write_text(change(town.write().read_text()))
    with pytest.raises(BadInput, match=message):
        check(town.path)


@pytest.mark.parametrize(("options", "message"), [
    ({"frequency_hz": 0.0}, "frequency"), ({"frequency_hz": -2.4e9}, "frequency"), ({"scale": 0.0}, "scale 0"),
    ({"scale": float("nan")}, "scale"), ({"up": "w"}, "'w'"), ({"devices": -1}, "-1 devices"),
    ({"devices": 30_000}, "not enough ground"), ({"bbox": (5, 0, 0, 5)}, "bbox"),
    ({"bbox": (900, 900, 950, 950)}, "is empty; the city lies in x -100 to 100"),
    *(({"bbox": bbox}, "an extent of .*(not possible|but a line)") for bbox in (
        (0, 0, 1e-300, 1e300), (-1e308, -1e308, 1e308, 1e308), (0, 0, 1e-9, 50)))])
def test_impossible_options(town, options, message):
    with pytest.raises(BadInput, match=message):
        check(town.write(), **options)


def test_unknown_material_and_its_remedy(town, tmp_path):
    town.materials.append('<bsdf type="diffuse" id="mat-red"/>')
    town.add("hut", town.box((0, 5), (0, 5)), material="mat-red")
    assert "--material red=itu_concrete" in found(check(town.write()), "error")
    report = build_scene(town.path, tmp_path / "out", BuildOptions(materials={"red": "itu_brick"}))
    assert {use.name: use.shapes for use in report.materials} == {"concrete": 10, "brick": 1}
    assert tomllib.loads((tmp_path / "out" / "scene.toml").read_text())["provenance"]["materials"] == (
        "{'red': 'itu_brick'}"
    )


def test_quads_become_triangles(empty_city, tmp_path):
    empty_city.add("ground", empty_city.plane())
    corners, _ = empty_city.box((0, 20), (0, 20))
    empty_city.add("house", (corners, CUBE_QUADS))
    report = build_scene(empty_city.write(), tmp_path / "out")
    assert "6 faces with more than three corners in 1 mesh(es) were cut" in found(report, "fixed")
    assert report.triangles == 2 + 12
    assert Scene.load(tmp_path / "out").city.inside([[10, 10, 5], [10, 10, 11], [30, 10, 5]]).tolist() == [1, 0, 0]


def test_y_up(town, tmp_path):
    path = transformed(town, Y_UP).write()
    report = check(path)
    assert report.tracing_would_fail and "the axis y seems to point up" in found(report, "error")
    assert "seems to point up" not in found(check(path, up="z"), "error")
    report = build_scene(path, tmp_path / "out", BuildOptions(up="y"))
    assert report.extent_m == (-80, 80, -80, 80) and (report.tallest_m, report.tallest) == (24.0, "house8")
    assert Scene.load(tmp_path / "out").city.height_at(60.0, 60.0) == pytest.approx(24.0)


@pytest.mark.parametrize(
    "factor, message, scale", [(1 / 0.3048, None, None), (5 / 0.3048, "feet", 0.3048), (1e-3, "kilometres", 1000.0)]
)
def test_units(town, factor, message, scale):
    """Buildings of 16 m in the middle are 52 ft, which a tall city in metres could have: not noticed, as documented."""
    path = transformed(town, f"{factor} 0 0 0  0 {factor} 0 0  0 0 {factor} 0  0 0 0 1").write()
    if message is None:
        assert not check(path).problems
        return
    assert message in found(check(path), "warning")
    report = check(path, scale=scale)
    assert not report.problems
    assert report.tallest_m == pytest.approx(24.0 * factor * scale)
    assert not found(check(path, scale=1.0), "warning")


def test_city_far_from_the_origin_is_moved(town, tmp_path):
    report = build_scene(transformed(town, "1 0 0 691000  0 1 0 5335000  0 0 1 519  0 0 0 1").write(), tmp_path / "out")
    assert "moved by (-691000, -5335000) m" in found(report, "fixed")
    assert "the ground was at z = 519.000 m: moved to 0" in found(report, "fixed")
    assert report.extent_m == (-80, 80, -80, 80) and report.tallest_m == pytest.approx(24.0, abs=0.01)
    provenance = Scene.load(tmp_path / "out").config.provenance
    assert provenance["moved_m"] == "-691000.000, -5335000.000, -519.000"


def test_names_that_sionna_refuses(town, tmp_path):
    town.add("Straße $5", town.box((0, 5), (0, 5)))
    town.add("a/b", town.box((10, 15), (0, 5)))
    town.add("house1", town.box((20, 25), (0, 5)))
    town.add("mesh-merged-shapes", town.box((30, 35), (0, 5)))
    report = build_scene(town.write(), tmp_path / "out")
    assert "2 name(s) had characters" in found(report, "fixed") and "'a/b -> a_b'" in found(report, "fixed")
    assert "2 shape(s) had the name of another" in found(report, "fixed")
    files = {path.stem for path in (tmp_path / "out" / "meshes").iterdir()}
    assert {"Stra_e__5", "a_b", "house1", "house1_2", "merged-shapes_2"} <= files


def test_uneven_ground(empty_city):
    corners, faces = empty_city.plane()
    corners[2:, 2] = 30.0
    empty_city.add("slope", (corners, faces)).add("house", empty_city.box((-10, 10), (-10, 10), (10, 35)))
    empty_city.add("other", empty_city.box((30, 50), (-10, 10), (10, 40)))
    report = check(empty_city.write())
    assert "rises to 30.0 m" in found(report, "warning")
    assert (report.tallest, report.tallest_m) == ("other", pytest.approx(25.0, abs=0.1))


def test_degenerate_open_and_inward_meshes(town):
    corners, faces = town.box((0, 5), (0, 5))
    town.add("sliver", (corners, [*faces, [0, 0, 1]])).add("inward", (corners + 7, [face[::-1] for face in faces]))
    town.add("nothing", (corners, [[0, 0, 1]])).add("open", (corners + [14, 0, 0], faces[2:]))
    report = check(town.write())
    fixed, warning = found(report, "fixed"), found(report, "warning")
    assert "2 degenerate triangles (without area) in 2 mesh(es) were left out ('sliver', 'nothing')" in fixed
    assert "empty mesh and were left out ('nothing')" in fixed
    assert "faced inwards" in fixed and "'inward'" in fixed
    assert "1 of 13 meshes are not watertight ('open')" in warning


def add_house_in_two(town, roof_material):
    corners, faces = town.box((-30, -25), (0, 5), (0, 9))
    town.add("walls", (corners, faces[0:8])).add("cover", (corners, faces[10:12]), material=roof_material)


def test_roof_of_another_material_is_reported(town):
    town.materials.append('<bsdf type="itu-radio-material" id="tin"><string name="type" value="metal"/></bsdf>')
    add_house_in_two(town, "tin")
    report = check(town.write())
    assert "2 meshes are roofs and walls of different materials" in found(report, "warning")
    assert report.shapes == 12
    assert "joined" in found(check(town.path, materials={"tin": "concrete"}), "fixed")


def test_a_roof_apart_becomes_one_mesh_with_its_walls(town, tmp_path):
    """Sionna RT finds no diffracting edge between two meshes."""
    corners, faces = town.box((-40, 40), (-5, 5), (0, 20))
    found = []
    for parts in ([faces], [faces[:10], faces[10:]]):
        town.shapes = []
        for number, part in enumerate(parts):
            town.add(f"part{number}", (corners, part))
        assert build_scene(town.write(), tmp_path / f"{len(parts)}").shapes == 1
        found.append(Scene.load(tmp_path / f"{len(parts)}").city)
    one, two = (set(map(tuple, city.vertices[city.faces].reshape(-1, 9).tolist())) for city in found)
    assert one == two and len(found[1].vertices) == 8


def test_part_of_a_city(town, tmp_path):
    report = build_scene(town.write(), tmp_path / "out", BuildOptions(bbox=(-75, -75, 0, 40)))
    names = {path.stem for path in (tmp_path / "out" / "meshes").iterdir()}
    assert names == {"ground", "house0", "house1", "house3", "house4"}
    assert report.extent_m == (-75, 0, -75, 40)


@pytest.mark.seconds
def test_other_files_are_never_erased(town, tmp_path):
    out = tmp_path / "out"
    build_scene(town.write(), out)
    build_scene(town.path, out)  # a scene may be built again
    (out / "truth.nc").write_text("precious")
    with pytest.raises(BadInput, match="truth.nc"):
        build_scene(town.path, out)
    assert (out / "truth.nc").read_text() == "precious" and (out / "scene.toml").exists()


def test_report_is_printed(town):
    console = Console(record=True, width=120, file=StringIO())
    town.add("hut", town.box((0, 5), (0, 5)), material="[red]stone")
    print_report(check(town.write()), console)
    text = console.export_text()
    assert "error" in text and "[red]stone" in text


@pytest.mark.seconds
def test_munich_of_sionna(tmp_path):
    """Rationale: a real city of 2367 meshes, roofs apart from open-bottomed walls.

    Expected: nothing but the warnings about open meshes and seams; known places are inside, streets are not.
    """
    report = build_scene("sionna:munich", tmp_path / "out", BuildOptions(bbox=(-400, -300, 200, 200), devices=10))
    assert 500 < report.shapes < 1500 and 0.3 < report.built_fraction < 0.6
    assert report.tallest.startswith("Frauenkirche") and report.tallest_m == pytest.approx(98.57, abs=0.01)
    assert not report.tracing_would_fail
    assert "not watertight" in found(report, "warning") and "roofs and walls" in found(report, "warning")
    scene = Scene.load(tmp_path / "out")
    x, y = np.meshgrid(np.arange(-400, 200, 7.0), np.arange(-300, 200, 7.0))
    top_m = scene.city.height_at(x, y).ravel()
    points = np.column_stack([x.ravel(), y.ravel(), top_m])
    built = top_m > 3
    assert scene.city.inside(points[built] - [0, 0, 1]).mean() > 0.999
    assert not scene.city.inside(points[built] + [0, 0, 1]).any()
    assert not scene.city.inside(points[top_m < 0.1] + [0, 0, 1.5]).any()
