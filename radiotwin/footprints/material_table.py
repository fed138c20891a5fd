"""What buildings are made of: tags of a map -> materials of Recommendation ITU-R P.2040."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.scene.materials import Material, itu_material

KEY = "building:material"


@dataclass(frozen=True)
class MaterialTable:
    """Names of ITU materials.

    Attributes:
        default: for buildings without a tag that the table knows.
        ground: of the plane.
        by_tag: key -> value -> material; keys are looked up in this order.
    """

    default: str
    ground: str
    by_tag: Mapping[str, Mapping[str, str]]

    def material_of(self, tags: Mapping[str, str]) -> tuple[Material, str]:
        """The material, and the tag that says so, as `building:material=brick`, or `default`."""
        for key, values in self.by_tag.items():
            for value in tags.get(key, "").lower().split(";"):
                if value.strip() in values:
                    return itu_material(values[value.strip()]), f"{key}={value.strip()}"
        return itu_material(self.default), "default"

    def unknown(self, tags: Mapping[str, str]) -> str | None:
        """The value of `building:material` where the table does not know it."""
        values = [value.strip() for value in tags.get(KEY, "").lower().split(";") if value.strip()]
        return values[0] if values and not any(value in self.by_tag.get(KEY, {}) for value in values) else None


# Natural stone has no entry of its own in P.2040: dense stone is taken as marble, sandstone as concrete.
STANDARD = MaterialTable(
    default="concrete", ground="asphalt_concrete",
    by_tag={
        KEY: {
            "concrete": "concrete", "reinforced_concrete": "concrete", "cement_block": "concrete",
            "sandstone": "concrete",
            "brick": "brick", "bricks": "brick", "clay": "brick", "masonry": "brick", "plastered_brick": "brick",
            "wood": "wood", "timber_framing": "wood", "log": "wood",
            "glass": "glass", "mirror": "glass",
            "metal": "metal", "steel": "metal", "tin": "metal", "aluminium": "metal", "copper": "metal",
            "stone": "marble", "limestone": "marble", "granite": "marble", "marble": "marble",
        },
        "building": {"greenhouse": "glass"},
    })


def read_material_table(path: Path | str) -> MaterialTable:
    """The standard table with what a TOML file says otherwise: `default`, `ground`, tables named after keys of tags.

    Raises:
        BadInput: no such file, not TOML, or a material that is not in ITU-R P.2040.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path} cannot be read: {error}; give a TOML file with materials by tag") from None
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{path} is not valid TOML: {error}") from None
    own = {name: data.pop(name) for name in ("default", "ground") if name in data}
    for key, values in data.items():
        if not isinstance(values, dict):
            raise BadInput(f"{path}: {key} = {values!r} stands alone; write it under the key of its tag, for example "
                           f'["{KEY}"]')
    named = [*own.items(), *((f"[{key}] {value}", name)
                             for key, values in data.items() for value, name in values.items())]
    for place, name in named:
        if not isinstance(name, str):
            raise BadInput(f"{path}: {place} = {name!r}; allowed is the name of an ITU material")
        try:
            itu_material(name)
        except BadInput as error:
            raise BadInput(f"{path}: {place}: {error}") from None
    by_tag = {key: dict(STANDARD.by_tag.get(key, {})) | {value.lower(): name for value, name in values.items()}
              for key, values in data.items()}
    return replace(STANDARD, **own, by_tag=by_tag | {k: v for k, v in STANDARD.by_tag.items() if k not in data})


def with_pairs(table: MaterialTable, pairs: Mapping[str, str]) -> MaterialTable:
    """The table with values of `building:material`, or `default` and `ground`, replaced.

    Raises:
        BadInput: no ITU material.
    """
    for name in pairs.values():
        itu_material(name)
    own = {name: itu for name, itu in pairs.items() if name in ("default", "ground")}
    values = dict(table.by_tag[KEY]) | {name.lower(): itu for name, itu in pairs.items() if name not in own}
    return replace(table, **own, by_tag=dict(table.by_tag) | {KEY: values})
