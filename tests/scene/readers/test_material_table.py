import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.materials import ITU_TABLE, STANDARD, read_material_table, with_materials


def of(table, **tags):
    material, source = table.material_of({key.replace("__", ":"): value for key, value in tags.items()})
    return material.itu, source


def test_the_standard_table_names_materials_that_exist():
    names = {STANDARD.default, STANDARD.ground, *(n for values in STANDARD.by_tag.values() for n in values.values())}
    assert names <= set(ITU_TABLE)


@pytest.mark.parametrize(("tags", "itu", "source"), [
    ({}, "concrete", "default"), ({"building__material": "Brick"}, "brick", "building:material=brick"),
    ({"building__material": "straw;glass"}, "glass", "building:material=glass"),
    ({"building": "greenhouse"}, "glass", "building=greenhouse"),
    ({"building": "greenhouse", "building__material": "metal"}, "metal", "building:material=metal")])
def test_tags(tags, itu, source):
    assert of(STANDARD, **tags) == (itu, source)


def test_a_users_table_goes_first(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text('default = "brick"\nground = "itu_wet_ground"\n[roof]\nflat = "metal"\n'
                    '["building:material"]\nbrick = "wood"')
    table = read_material_table(path)
    assert (table.default, table.ground) == ("brick", "itu_wet_ground")
    assert of(table, building__material="brick") == ("wood", "building:material=brick")
    assert of(table, building__material="glass")[0] == "glass"  # of the standard table
    assert of(table, roof="flat", building__material="glass")[0] == "metal"
    assert of(table) == ("brick", "default")


def test_pairs_of_the_command_line():
    table = with_materials(STANDARD, {"straw": "wood", "default": "brick", "ground": "wet_ground"})
    assert of(table, building__material="straw")[0] == "wood" and table.ground == "wet_ground"
    assert table.unknown({"building:material": "straw"}) is None
    assert STANDARD.unknown({"building:material": "straw"}) == "straw"


@pytest.mark.parametrize(("text", "message"), [
    ("=", "not readable TOML"), ('default = "cheese"', "default: there is no ITU material 'cheese'"),
    ("default = 7", "default = 7"), ('brick = "wood"', "brick = 'wood' is in no table"),
    ('["building:material"]\nbrick = ["wood"]', r"\[building:material\] brick"),
    ('[building]\nbarn = "hay"', r"\[building\] barn: there is no ITU material 'hay'")])
def test_bad_tables(tmp_path, text, message):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(BadInput, match=message):
        read_material_table(tmp_path / "m.toml")
