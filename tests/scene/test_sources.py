import subprocess
import sys

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.folder import find_source, scene_name, source_text


def test_sionna_scene_is_found():
    assert find_source("sionna:munich").name == "munich.xml"


def test_unknown_sionna_scene_lists_the_known_ones():
    with pytest.raises(BadInput, match="no scene 'atlantis'.*etoile.*munich.*simple_street_canyon"):
        find_source("sionna:atlantis")


@pytest.mark.parametrize("name, message", [("nothing.xml", "not a file.*munich"), ("city.dae", "'.dae' is not read")])
def test_not_a_scene_file(tmp_path, name, message):
    (tmp_path / "city.dae").write_text("")
    with pytest.raises(BadInput, match=message):
        find_source(tmp_path / name)


@pytest.mark.parametrize("source, name", [("sionna:etoile", "etoile"), ("data/my city (2).xml", "my_city__2_")])
def test_scene_name(source, name):
    assert scene_name(source) == name


@pytest.mark.seconds
def test_building_needs_no_ray_tracer():
    """Rationale: everything but tracing must work where there is no LLVM; importing drjit there can abort."""
    code = (
        "import sys; from radiotwin.scene.build import build_scene; "
        "build_scene('sionna:simple_street_canyon', 'unused', check_only=True); "
        "sys.exit(bool({'mitsuba', 'drjit', 'sionna.rt'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_names_that_no_file_can_have():
    with pytest.raises(BadInput, match="is not a file"):
        find_source("a" * 300 + ".xml")
    assert scene_name("..xml") == "city" and scene_name(".town.xml") == "town"
    assert source_text("\udcffä.osm") == r"\udcffä.osm"
