"""The command line, and files that it has made."""

import shutil

import pytest

from tests.cli.strangers import FIT, MAP, SECRET, SURVEY
from tests.command_line import run, run_installed
from tests.worlds import quick_report

__all__ = ["quick_report", "run", "run_installed"]


@pytest.fixture(scope="session")
def scene_to_map(run, tmp_path_factory):
    """A folder with a scene, a survey of it (m.csv), a twin, and a map."""
    folder = tmp_path_factory.mktemp("scene-to-map")
    for command in ("build-scene preset:small -o scene", SURVEY.replace("out", "m"), FIT.replace("out", "twin"),
                    MAP.replace("out", "map")):
        assert run(command, folder).returncode == 0
    return folder


@pytest.fixture
def strangers_folder(scene_to_map, tmp_path):
    """A copy of them, beside a secret."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret").write_text(SECRET)
    return shutil.copytree(scene_to_map, tmp_path / "work", ignore=shutil.ignore_patterns("cache"))
