"""Materials of buildings: tags of a map to materials of Recommendation ITU-R P.2040."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.io.inputs import read_toml
from radiotwin.scene.materials import Material, itu_material

KEY = "building:material"
_OWN = ("default", "ground", "roof")


@dataclass(frozen=True)
class MaterialTable:
    """ITU materials by tag.

    Attributes:
        default: material of buildings without a tag of the table.
        ground: material of the ground plane.
        by_tag: key -> value -> material; keys are looked up in this order.
        roof: material of roofs; None: that of their buildings.
    """

    default: str
    ground: str
    by_tag: Mapping[str, Mapping[str, str]]
    roof: str | None = None

    def material_of(self, tags: Mapping[str, str]) -> tuple[Material, str]:
        """Return the material of a building and its source.

        Args:
            tags: of the building; a value may be a list with `;`.

        Returns:
            The material, and the tag it follows from, as `building:material=brick`, or `default`.
        """
        for key, known in self.by_tag.items():
            for value in _values(tags, key):
                if value in known:
                    return itu_material(known[value]), f"{key}={value}"
        return itu_material(self.default), "default"

    def unknown(self, tags: Mapping[str, str]) -> str | None:
        """Return the value of `building:material` if it is not in the table."""
        values = [value for value in _values(tags, KEY) if value]
        known = self.by_tag.get(KEY, {})
        return values[0] if values and not any(value in known for value in values) else None


def _values(tags: Mapping[str, str], key: str) -> list[str]:
    return [value.strip() for value in tags.get(key, "").lower().split(";")]


# Natural stone has no entry in P.2040: dense stone is taken as marble, sandstone as concrete
STANDARD = MaterialTable(
    default="concrete", ground="asphalt_concrete",
    by_tag={
        KEY: {
            "concrete": "concrete", "reinforced_concrete": "concrete", "cement_block": "concrete",
            "sandstone": "concrete",
            "brick": "brick", "bricks": "brick", "clay": "brick", "masonry": "brick",
            "plastered_brick": "brick",
            "wood": "wood", "timber_framing": "wood", "log": "wood",
            "glass": "glass", "mirror": "glass",
            "metal": "metal", "steel": "metal", "tin": "metal", "aluminium": "metal",
            "copper": "metal",
            "stone": "marble", "limestone": "marble", "granite": "marble", "marble": "marble",
        },
        "building": {"greenhouse": "glass"},
    })


def read_material_table(path: Path | str) -> MaterialTable:
    """Read a TOML file that changes the standard table.

    Args:
        path: file with `default`, `ground`, `roof`, and tables named after keys of tags, which are
            looked up in the order of the file, before the other keys of the standard table.

    Returns:
        The changed table.

    Raises:
        BadInput: no such file, not TOML, or a material that is not in ITU-R P.2040.
    """
    path = Path(path)
    data = read_toml(path, "TOML file with materials by tag")
    own = {name: data.pop(name) for name in _OWN
           if name in data and not (name == "roof" and isinstance(data[name], dict))}  # a tag
    named: list[tuple[str, object]] = list(own.items())
    for key, values in data.items():
        if not isinstance(values, dict):
            raise BadInput(f"{path}: {key} = {values!r:.60} is in no table; write it under the key "
                           f'of its tag, for example ["{KEY}"]')
        named += [(f"[{key}] {value}", name) for value, name in values.items()]
    for entry, name in named:
        if not isinstance(name, str):
            raise BadInput(f"{path}: {entry} = {name!r:.60}; allowed is the name of an ITU "
                           "material")
        try:
            itu_material(name)
        except BadInput as error:
            raise BadInput(f"{path}: {entry}: {error}") from None
    by_tag = {key: dict(STANDARD.by_tag.get(key, {}))
              | {value.lower(): name for value, name in values.items()}
              for key, values in data.items()}
    rest = {key: known for key, known in STANDARD.by_tag.items() if key not in data}
    return replace(STANDARD, **own, by_tag=by_tag | rest)


def with_pairs(table: MaterialTable, pairs: Mapping[str, str]) -> MaterialTable:
    """Return a table with some entries replaced.

    Args:
        table: to change.
        pairs: value of `building:material`, or `default`, `ground` or `roof` -> ITU material.

    Raises:
        BadInput: a material is not in ITU-R P.2040.
    """
    for name in pairs.values():
        itu_material(name)
    own = {name: itu for name, itu in pairs.items() if name in _OWN}
    values = {name.lower(): itu for name, itu in pairs.items() if name not in own}
    return replace(table, **own,
                   by_tag=dict(table.by_tag) | {KEY: dict(table.by_tag[KEY]) | values})
