"""Broken city models through the real command line: one clear message, exit status 2, nothing written."""

import pytest
import trimesh

GOOD = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="wall"><string name="type" value="concrete"/></bsdf>
<shape type="ply" id="ground"><string name="filename" value="ground.ply"/><ref id="wall" name="bsdf"/></shape>
<shape type="ply" id="house"><string name="filename" value="house.ply"/><ref id="wall" name="bsdf"/></shape>
</scene>
"""


@pytest.fixture
def city(tmp_path):
    ground = trimesh.Trimesh([[-90, -90, 0], [90, -90, 0], [90, 90, 0], [-90, 90, 0]], [[0, 1, 2], [0, 2, 3]])
    ground.export(tmp_path / "ground.ply")
    trimesh.creation.box(bounds=[[-20, -20, 0], [20, 20, 15]]).export(tmp_path / "house.ply")
    (tmp_path / "city.xml").write_text(GOOD)
    return tmp_path


def truncate(folder):
    data = (folder / "house.ply").read_bytes()
    (folder / "house.ply").write_bytes(data[: len(data) // 2])


BREAK = {
    "truncated PLY": (truncate, ["house.ply", "truncated"]),
    "malformed XML": (lambda folder: (folder / "city.xml").write_text(GOOD.replace("</scene>", "")),
                      ["city.xml", "line"]),
    "missing mesh": (lambda folder: (folder / "house.ply").unlink(), ["house.ply"]),
    "unknown material": (lambda folder: (folder / "city.xml").write_text(GOOD.replace("concrete", "kryptonite")),
                         ["kryptonite"]),
}


@pytest.mark.parametrize("what", BREAK)
@pytest.mark.parametrize("options", ["-o scene", "-o scene --check"])
def test_a_broken_city_is_refused(run, city, what, options):
    spoil, parts = BREAK[what]
    spoil(city)
    before = sorted(city.iterdir())
    result = run(f"build-scene city.xml {options}", cwd=city)
    said = result.stderr + result.stdout
    assert result.returncode == 2 and "Traceback" not in said
    for part in parts:
        assert part in said, said
    assert sorted(city.iterdir()) == before


def test_the_city_itself_is_fine(run, city):
    assert run("build-scene city.xml -o scene", cwd=city).returncode == 0
    assert (city / "scene" / "scene.toml").is_file()
    assert run("build-scene city.xml -o other --frequency-hz -1", cwd=city).returncode == 2
    assert not (city / "other").exists()


def test_a_source_inside_the_output_is_not_replaced(run, city):
    """`build-scene D/city.xml -o D` would leave nothing of the user's own files."""
    assert run("build-scene city.xml -o scene", cwd=city).returncode == 0
    before = (city / "scene" / "city.xml").read_bytes()
    result = run("build-scene scene/city.xml -o scene", cwd=city)
    assert result.returncode == 2 and "choose another output" in result.stderr
    assert (city / "scene" / "city.xml").read_bytes() == before
