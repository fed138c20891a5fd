"""Sionna RT itself loads the output of `build_scene`."""

import pytest

from radiotwin.scene.build import BuildOptions, build_scene


@pytest.mark.llvm
@pytest.mark.parametrize("frequency_hz", [868e6, 2.4e9, 28e9, 70e9])
def test_sionna_rt_loads_what_is_built(town, tmp_path, frequency_hz):
    """Every material that can be declared, at frequencies in and out of its range, with names that are refused."""
    from sionna import rt

    kinds = ["concrete", "brick", "marble", "floorboard", "medium_dry_ground", "metal"]
    for number, kind in enumerate(kinds):
        town.materials.append(f'<bsdf type="diffuse" id="mat-itu_{kind}"/>')
        town.add(f"itu_{kind}", town.box((10 * number - 30, 10 * number - 25), (-20, -15)), material=f"mat-itu_{kind}")
    town.materials.append(
        '<bsdf type="radio-material" id="glass"><float name="relative_permittivity" value="6"/></bsdf>'
    )
    town.add("$x", town.box((-30, -25), (20, 30)), material="glass").add("concrete", town.box((-20, -15), (20, 30)))
    build_scene(town.write(), tmp_path / "out", BuildOptions(frequency_hz=frequency_hz))
    for merge in (True, False):
        scene = rt.load_scene(str(tmp_path / "out" / "city.xml"), merge_shapes=merge)
        scene.frequency = frequency_hz
        constants = [material.relative_permittivity[0] for material in scene.radio_materials.values()]
        assert len(constants) >= 7 and min(constants) >= 1.0
    assert len(scene.objects) == 18
