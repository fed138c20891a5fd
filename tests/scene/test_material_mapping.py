import re

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.materials import (
    Material,
    Names,
    itu_material,
    map_materials,
    safe_name,
    traceable_materials,
)
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml


def mapped(city, bsdf, identifier, overrides=None):
    """(material, problems) of one cube made of `identifier` in a file that declares `bsdf`."""
    city.materials.append(bsdf)
    city.add_xml(f'<shape type="cube" id="a"><ref id="{identifier}" name="bsdf"/></shape>')
    declared = read_mitsuba_xml(city.write())
    materials, problems = map_materials(declared.shapes, declared.materials, overrides or {})
    return materials[0], problems


def radio(**values):
    return '<bsdf type="radio-material" id="m">' + "".join(
        f'<float name="{name}" value="{value}"/>' for name, value in values.items()) + "</bsdf>"


FACADE = ('<bsdf type="itu-radio-material" id="mat-facade"><string name="type" value="brick"/>'
          '<float name="thickness" value="0.24"/><float name="scattering_coefficient" value="0.3"/></bsdf>')
TILE = radio(relative_permittivity=4.5, conductivity=0.02)


@pytest.mark.parametrize(("bsdf", "identifier", "material"), [
    (FACADE, "mat-facade", Material("facade", itu="brick", thickness_m=0.24, scattering_coefficient=0.3)),
    (TILE, "m", Material("m", relative_permittivity=4.5, conductivity_s_per_m=0.02)),
    # Sionna RT stops at a radio-material called after an ITU material
    (TILE.replace('"m"', '"glass"'), "glass", Material("own-glass", relative_permittivity=4.5, conductivity_s_per_m=0.02))])
def test_radio_materials(empty_city, bsdf, identifier, material):
    assert mapped(empty_city, bsdf, identifier) == (material, [])


@pytest.mark.parametrize(("identifier", "itu"), [
    ("mat-itu_metal", "metal"), ("itu_wet_ground", "wet_ground"), ("itu-wood", "wood"), ("mat-concrete", "concrete"),
    ("brick", "brick")])
@pytest.mark.parametrize("kind", ["diffuse", "twosided", "principled"])
def test_older_forms(empty_city, identifier, itu, kind):
    colour = '<bsdf type="diffuse"><rgb name="reflectance" value="1 0 0"/></bsdf>'
    material, (problem,) = mapped(empty_city, f'<bsdf type="{kind}" id="{identifier}">{colour}</bsdf>', identifier)
    assert material == Material(itu, itu=itu)
    assert problem.severity == "fixed" and identifier in problem.message


@pytest.mark.parametrize(("bsdf", "identifier", "message"), [
    ('<bsdf type="diffuse" id="red"/>', "red", r"line 3: material 'red' \(type 'diffuse'\).*--material red=itu_concrete"),
    ('<bsdf type="itu-radio-material" id="m"><string name="type" value="cheese"/></bsdf>', "m", "'cheese'.*concrete"),
    ('<bsdf type="itu-radio-material" id="m"/>', "m", "does not exist"),
    ('<bsdf type="diffuse" id="mat-itu_cheese"/>', "mat-itu_cheese", "does not exist"),
    ('<bsdf type="absorber-radio-material" id="m"/>', "m", "no radio constants"),
    ("", "nowhere", "used but not declared.*--material nowhere"),
    (radio(relative_permittivity=0.5), "m", r"allowed: 1 to 1e\+06"), (radio(conductivity=-1), "m", r"allowed: 0 to 1e\+10"),
    *((radio(**{name: 1e308}), "m", "is not possible") for name in ("relative_permittivity", "conductivity", "thickness")),
    (radio(scattering_coefficient=2), "m", "0 to 1")])
def test_errors(empty_city, bsdf, identifier, message):
    material, (problem,) = mapped(empty_city, bsdf, identifier)
    assert material is None and problem.severity == "error" and re.search(message, problem.message)


@pytest.mark.parametrize(("bsdf", "identifier", "overrides", "message"), [
    (radio(thickness="thick"), "m", {}, "line 3.*'thick'"), ("", "concrete", {"blue": "itu_brick"}, "'blue'.*uses: concrete"),
    ("", "concrete", {"concrete": "cheese"}, "'cheese'")])
def test_what_is_refused(empty_city, bsdf, identifier, overrides, message):
    with pytest.raises(BadInput, match=message):
        mapped(empty_city, bsdf, identifier, overrides)


@pytest.mark.parametrize("key", ["mat-red", "red"])
def test_override(empty_city, key):
    material, problems = mapped(empty_city, '<bsdf type="diffuse" id="mat-red"/>', "mat-red", {key: "itu_brick"})
    assert material == Material("brick", itu="brick") and not problems


def test_shape_without_material(empty_city):
    declared = read_mitsuba_xml(empty_city.add_xml('<shape type="cube" id="bare"/>').write())
    materials, (problem,) = map_materials(declared.shapes, declared.materials, {})
    assert materials == [None] and problem.severity == "error" and "'bare'" in problem.message


@pytest.mark.parametrize(("text", "safe"), [
    ("a$b", "a_b"), ("Straße 1/2", "Stra_e_1_2"), ("a.b", "a_b"), ("", "unnamed"), ("x" * 300, "x" * 100), ("wall-2_b",) * 2])
def test_safe_name(text, safe):
    assert safe_name(text) == safe


def test_unique_names_differ_in_more_than_case():
    taken = Names(["wall"])
    assert [taken.unique("Wall") for _ in range(2)] == ["Wall_2", "Wall_3"]


def test_materials_become_traceable_with_unique_names_and_a_warning_out_of_range():
    concrete, thick = itu_material("concrete"), itu_material("concrete", thickness_m=0.5)
    written, problems = traceable_materials([concrete, thick, concrete], 5e9, Names(["concrete"]))
    assert {written[concrete].name, written[thick].name} == {"concrete_2", "concrete_3"} and not problems
    written, problems = traceable_materials([concrete], 700e6, Names())
    assert written[concrete].relative_permittivity == 5.24
    assert problems[0].severity == "warning" and "1-100 GHz" in problems[0].message
    assert "5.24" in problems[0].message and "0.0462" in problems[0].message
