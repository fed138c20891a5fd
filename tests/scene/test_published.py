"""The published scenes are found in a source tree and in an installed package."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.folder import published_scene

ROOT = Path(__file__).parents[2]
PROGRAM = """
from radiotwin.scene.folder import published_scene
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
scene = Scene.load(published_scene("rbm"))
RadioMap.load(scene.folder / "truth.nc").require_made_for(scene)
print(scene.folder)
"""


@pytest.mark.parametrize("name", ["rbm", "rdm"])
def test_in_the_source_tree(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert published_scene(name).samefile(ROOT / "scenes" / name)
    scene = Scene.load(published_scene(name))
    RadioMap.load(scene.folder / "truth.nc").require_made_for(scene)


def test_the_working_directory_comes_first(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes" / "rbm").mkdir(parents=True)
    (tmp_path / "scenes" / "rbm" / "scene.toml").touch()
    assert published_scene("rbm") == Path("scenes/rbm")
    assert published_scene("atlantis") == Path("scenes/atlantis"), "for the message that it is missing"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this source tree."""
    pytest.importorskip("setuptools", minversion="77")
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, folder / "tree", symlinks=True,
                    ignore=shutil.ignore_patterns(".*", "docs", "tests", "build", "dist", "site", "cache", "runs"))
    program = "from setuptools import build_meta; print(build_meta.build_wheel('..'))"
    done = subprocess.run([sys.executable, "-c", program], cwd=folder / "tree", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / done.stdout.split()[-1]


@pytest.mark.seconds
def test_the_wheel_holds_all_data(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = (path for package in ("radiotwin", "marl") for path in (ROOT / package).rglob("*"))
    files = {path.relative_to(ROOT).as_posix() for path in packages if path.is_file()}
    assert {name for name in files if "__pycache__" not in name} <= names
    for name in ("rbm", "rdm"):
        for path in (ROOT / "scenes" / name).rglob("*"):
            if path.is_file() and "cache" not in path.parts:
                assert f"radiotwin/{path.relative_to(ROOT).as_posix()}" in names


@pytest.mark.seconds
def test_in_a_wheel(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "empty").mkdir()
    done = subprocess.run([sys.executable, "-P", "-c", f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r})\n"
                           + PROGRAM], cwd=tmp_path / "empty", capture_output=True, text=True)
    assert done.stdout.strip() == str(tmp_path / "site" / "radiotwin" / "scenes" / "rbm"), done.stderr
