import subprocess
import sys

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.folder import find_source, scene_name, source_text


@pytest.mark.parametrize(("name", "message"), [
    ("sionna:atlantis", "no scene 'atlantis'.*etoile.*munich.*simple_street_canyon"), ("nothing.xml", "not a file.*munich"),
    ("city.dae", "'.dae' is not read"), ("a" * 300 + ".xml", "is not a file")])
def test_what_is_no_city(tmp_path, monkeypatch, name, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "city.dae").write_text("")
    with pytest.raises(BadInput, match=message):
        find_source(name)


def test_names_for_scenes():
    names = {"sionna:etoile": "etoile", "data/my city (2).xml": "my_city__2_", "..xml": "city", ".town.xml": "town"}
    assert {source: scene_name(source) for source in names} == names
    assert source_text("\udcffä.osm") == r"\udcffä.osm"


@pytest.mark.seconds
def test_building_needs_no_ray_tracer():
    """Rationale: everything but tracing must work where there is no LLVM; importing drjit there can abort."""
    code = (
        "import sys; from radiotwin.scene.build import build_scene; "
        "build_scene('sionna:simple_street_canyon', 'unused', check_only=True); "
        "sys.exit(bool({'mitsuba', 'drjit', 'sionna.rt'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
