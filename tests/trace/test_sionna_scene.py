"""A scene is data: no plugin that its city.xml names, or that lies in a folder, is ever loaded."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.build import build_scene
from radiotwin.scene.folder import read_city
from radiotwin.trace.solver import import_sionna, load_city

ROOT = Path(__file__).parents[2]
MARKER = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void ran(void) {
    FILE *file = fopen(getenv("RADIOTWIN_TEST_MARK"), "a");
    if (file) { fputs("ran\\n", file); fclose(file); }
}
"""
NAMED = {"bsdf": '<bsdf type="evil" id="e"/>', "path": '<bsdf type="../../x/evil" id="e"/>',
         "shape": '<shape type="evil" id="e"/>', "nested": '<bsdf type="twosided" id="e"><bsdf type="evil"/></bsdf>',
         "sensor": '<sensor type="evil"/>', "emitter": '<emitter type="evil"/>', "integrator": '<integrator type="evil"/>'}
IGNORED = ("sensor", "emitter", "integrator")


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """A shared object that leaves a mark when it is loaded."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("plugin")
    (folder / "evil.c").write_text(MARKER)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", folder / "evil.so", folder / "evil.c"], check=True)
    return folder / "evil.so"


@pytest.fixture
def evil(small_scene, plugin, tmp_path):
    """A scene folder with the plugin wherever Mitsuba might look for one, under many names."""
    folder = tmp_path / "a" / "b" / "scene"
    shutil.copytree(small_scene.folder, folder, ignore=shutil.ignore_patterns("cache"))
    for place in (folder / "plugins", folder, folder / "meshes", tmp_path / "a" / "x", tmp_path / "x"):
        place.mkdir(exist_ok=True)
        for name in ("evil", "ply", "merge", "scene", "mesh", "itu-radio-material", "radio-material", "path"):
            shutil.copy(plugin, place / f"{name}.so")
    for name in ("drjit", "mitsuba", "sionna", "numpy", "xarray"):
        (folder / f"{name}.py").write_text("import os\nopen(os.environ['RADIOTWIN_TEST_MARK'], 'a').write('python')\n")
    return folder


def run(command, cwd, tmp_path, **environment):
    """Run a command line as the script `radiotwin` does: the working directory is not on Python's path."""
    program = "import sys; from radiotwin.cli import main; sys.exit(main())"
    known = os.environ | {"PYTHONPATH": str(ROOT), "RADIOTWIN_TEST_MARK": str(tmp_path / "mark")} | environment
    return subprocess.run([sys.executable, "-P", "-c", program, *command.split()], cwd=cwd, env=known, check=False,
                          capture_output=True, text=True, timeout=300)


@pytest.mark.llvm
def test_the_plugin_does_mark(plugin, tmp_path):
    """Without the change of `import_sionna`, Mitsuba loads it from the working directory."""
    (tmp_path / "plugins").mkdir()
    shutil.copy(plugin, tmp_path / "plugins" / "evil.so")
    program = ("import sys; from radiotwin.runtime import llvm; llvm.prepare(); import mitsuba as mi\n"
               "mi.set_variant('llvm_ad_mono_polarized')\n{}\ntry: mi.load_dict({{'type': 'evil'}})\nexcept Exception: pass")
    known = os.environ | {"PYTHONPATH": str(ROOT), "RADIOTWIN_TEST_MARK": str(tmp_path / "mark")}
    subprocess.run([sys.executable, "-P", "-c", program.format("")], cwd=tmp_path, env=known, check=True)
    assert (tmp_path / "mark").exists()


@pytest.mark.llvm
@pytest.mark.parametrize("command", ["gains . --points ../points.csv -o ../g.csv",
                                     pytest.param("trace . -o ../truth.nc", marks=pytest.mark.slow)])
def test_a_trace_within_the_folder_loads_nothing_of_it(evil, tmp_path, command):
    """Seen: `cd SCENE; radiotwin trace .` ran SCENE/plugins/ply.so, and SCENE/drjit.py."""
    (evil.parent / "points.csv").write_text("x_m,y_m,z_m\n100,40,60\n")
    result = run(f"{command} --devices d0 --quality fast", evil, tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("named", NAMED)
def test_nothing_loads_what_city_xml_names(evil, tmp_path, monkeypatch, named):
    """Cameras, lights and integrators are passed over; a material or a shape of such a type is refused."""
    path = evil / "city.xml"
    path.write_text(path.read_text().replace("</scene>", NAMED[named] + "</scene>"))
    monkeypatch.setenv("RADIOTWIN_TEST_MARK", str(tmp_path / "mark"))
    if named in IGNORED:
        assert read_city(path) and Scene.load(evil)
    else:
        for read in (read_city, lambda path: Scene.load(path.parent)):
            with pytest.raises(BadInput, match="line .* of type '.*evil' is not read"):
                read(path)
    assert build_scene(path, tmp_path / "out", check_only=True).tracing_would_fail == (named == "shape")
    assert not (tmp_path / "mark").exists()


@pytest.mark.llvm
def test_mitsuba_looks_for_plugins_where_it_is_installed_and_nowhere_else(small_scene, tmp_path, monkeypatch):
    monkeypatch.chdir(small_scene.folder)
    import_sionna()
    import mitsuba

    load_city(small_scene.xml_path, 2.4e9)
    paths = [str(path) for path in mitsuba.file_resolver()]
    assert paths == [os.path.dirname(os.path.realpath(mitsuba.__file__))]


@pytest.mark.llvm
def test_the_copy_that_a_killed_run_left_is_swept(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / ".radiotwin-abcdefgh").mkdir()
    (tmp_path / ".radiotwin-abcdefgh" / "city.xml").write_text("<scene/>")
    load_city(small_scene.xml_path, 2.4e9)
    assert not list(tmp_path.iterdir())
