"""Radio materials: the ITU-R P.2040 table, and materials declared by scene files, models and maps.

Also names of shapes and materials that Sionna RT, Mitsuba and file systems accept.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.io.inputs import read_toml
from radiotwin.scene import checks as problems
from radiotwin.scene.checks import Problem, listed
from radiotwin.scene.mitsuba_xml import DeclaredShape, Node

RESERVED_NAMES = {"merged-shapes", "__root__"}  # of objects that Sionna RT adds to a scene
# ITU-R P.2040-4, Table 3: material -> ranges (lowest GHz, highest GHz, a, b, c, d); with f in GHz
#   relative permittivity = a f^b
#   conductivity [S/m]    = c f^d     (section 2.1.4)
# Where ranges overlap, the first one listed is used, as in Sionna RT.
ITU_TABLE: dict[str, tuple[tuple[float, float, float, float, float, float], ...]] = {
    "vacuum": ((0.001, 100, 1.0, 0, 0, 0),),
    "concrete": ((1, 100, 5.24, 0, 0.0462, 0.7822), (110, 330, 5.17, 0, 0.0145, 1.09)),
    "brick": ((1, 40, 3.91, 0, 0.0238, 0.16), (110, 330, 4.15, 0, 0.0006, 1.5712)),
    "plasterboard": (
        (1, 100, 2.73, 0, 0.0085, 0.9395),
        (110, 330, 2.56, 0, 0.0001, 1.7799),
        (100, 400, 2.65, 0, 0.0002, 1.598),
    ),
    "wood": (
        (0.001, 100, 1.99, 0, 0.0047, 1.0718),
        (110, 330, 1.82, 0, 0.004, 1.0761),
        (100, 400, 2.1183, 0, 0.0055, 1.1113),
    ),
    "glass": (
        (0.1, 100, 6.31, 0, 0.0036, 1.3394),
        (220, 450, 5.79, 0, 0.0004, 1.658),
        (100, 400, 6.5767, 0, 0.0012, 1.4697),
    ),
    "clear_acrylic": ((110, 330, 2.58, 0, 0.0001, 1.6524),),
    "ceiling_board": (
        (1, 100, 1.48, 0, 0.0011, 1.075),
        (220, 450, 1.52, 0, 0.0029, 1.029),
        (100, 400, 1.2567, 0, 0.00013, 1.454),
    ),
    "chipboard": ((1, 100, 2.58, 0, 0.0217, 0.78), (100, 200, 2.16, 0, 0.0023, 1.359)),
    "plywood": (
        (1, 40, 2.71, 0, 0.33, 0),
        (110, 330, 1.94, 0, 0.0067, 0.9982),
        (100, 400, 2.17, 0, 0.0063, 1.045),
    ),
    "marble": (
        (1, 60, 7.074, 0, 0.0055, 0.9262),
        (110, 330, 7.94, 0, 0.0001, 1.733),
        (100, 400, 8.62, 0, 0.0027, 1.15),
    ),
    "floorboard": (
        (50, 100, 3.66, 0, 0.0044, 1.3515),
        (220, 300, 5.27, 0, 2.22e-17, 7.3413),
        (300, 400, 5.27, 0, 0.0003, 2.0298),
        (400, 450, 5.27, 0, 49.8726, 0),
        (100, 400, 3.1575, 0, 0.001675, 1.32775),
    ),
    "vinyl_tile": ((1, 40, 3.62, 0, 0.0051, 0.8422),),
    "carpet_tile": ((1, 40, 2.08, 0, 0.0009, 0.82),),
    "asphalt_concrete": ((1, 40, 4.83, 0, 0.0108, 1.3969),),
    "metal": ((1, 100, 1.0, 0, 1e7, 0),),
    "very_dry_ground": ((1, 10, 3.0, 0, 0.00015, 2.52),),
    "medium_dry_ground": ((1, 10, 15.0, -0.1, 0.035, 1.63),),
    "wet_ground": ((1, 10, 30.0, -0.4, 0.15, 1.3),),
}
# Sionna RT evaluates every ITU material at this frequency while it loads a file, before the scene's
# own frequency is set.
_SIONNA_LOAD_FREQUENCY_HZ = 3.5e9
DEFAULT_MATERIAL = "concrete"
_COPY = re.compile(r"\.\d{3}$")
_RANGES = {  # allowed: far beyond any material, and well inside single precision
    "relative_permittivity": (1, 1e6), "conductivity_s_per_m": (0, 1e10), "thickness_m": (0, 1e4),
    "scattering_coefficient": (0, 1), "xpd_coefficient": (0, 1)}
MATERIAL_KEY = "building:material"
_FIELDS = ("default", "ground", "roof")  # entries of a `MaterialTable` that are no tags


def safe_name(text: str) -> str:
    """Replace everything but ASCII letters, digits, `_` and `-` by `_`, and cut at 100 characters.

    Sionna RT 2.2 stops at `$` (a Mitsuba parameter) in a name, and reads scene files in the
    system's own encoding; `.` is Mitsuba's separator; `/` and the like cannot be in a file name.
    """
    return re.sub(r"[^A-Za-z0-9_-]", "_", text)[:100] or "unnamed"


class Names(set[str]):
    """Names in use, in lower case."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        super().__init__(names)
        self._last_numbers: dict[str, int] = {}  # so that many equal names take linear time

    def unique(self, name: str) -> str:
        """Add a name and return it; if it is taken (ignoring case), with a number: `name_2`."""
        free, number = name, self._last_numbers.get(name.lower(), 1)
        while free.lower() in self:
            number += 1
            free = f"{name}_{number}"
        self._last_numbers[name.lower()] = number
        self.add(free.lower())
        return free


@dataclass(frozen=True)
class Material:
    """Radio properties of a surface.

    Attributes:
        name: Name in files; letters, digits, `_` and `-`.
        itu: Key of `ITU_TABLE`; None: a material with constants of its own.
        relative_permittivity: Real part, at least 1; None for an ITU material.
        conductivity_s_per_m: None where `relative_permittivity` is.
        thickness_m: Thickness of the slab that models a wall or roof.
        scattering_coefficient: 0 (mirror) to 1 (all power scattered).
        xpd_coefficient: Share of scattered power that changes polarisation, 0 to 1.
    """

    name: str
    itu: str | None = None
    relative_permittivity: float | None = None
    conductivity_s_per_m: float | None = None
    thickness_m: float = 0.1
    scattering_coefficient: float = 0.0
    xpd_coefficient: float = 0.0


def itu_name(text: str) -> str | None:
    """Return the key of `ITU_TABLE` for a name like `itu-metal` or `brick`; None if there is none.

    >>> itu_name("mat-itu_wet_ground")
    'wet_ground'
    """
    name = text.removeprefix("mat-")
    for prefix in ("itu_", "itu-"):
        name = name.removeprefix(prefix)
    return name if name in ITU_TABLE else None


def itu_material(text: str, **settings: Any) -> Material:
    """Return a material of the ITU table.

    Args:
        text: Name as `itu_name` accepts it.
        settings: Other fields of `Material`; its name is by default the key of the table.

    Raises:
        BadInput: Not in the table.
    """
    itu = itu_name(text)
    if itu is None:
        raise BadInput(f"there is no ITU material {text!r}; there are: {', '.join(ITU_TABLE)}")
    return Material(**({"name": itu} | settings), itu=itu)


def permittivity(name: str, frequency_hz: float) -> tuple[float, float, bool]:
    """Return the constants of an ITU material at a frequency (ITU-R P.2040-4, section 2.1.4).

    Outside the frequency ranges of the table, the nearest end of the nearest range is used: the
    power laws are not extrapolated, as no measurements support them there.

    Returns:
        Relative permittivity (real part), conductivity [S/m], and whether the frequency is in a
        range.

    Raises:
        BadInput: No such material, or the frequency is not positive.
    """
    if not frequency_hz > 0:
        raise BadInput(f"frequency {frequency_hz:g} Hz is not possible; give a positive frequency "
                       "in hertz")
    frequency_ghz = frequency_hz / 1e9
    ranges = ITU_TABLE[itu_material(name).itu or ""]  # an ITU material has a name
    in_range = next((row for row in ranges if row[0] <= frequency_ghz <= row[1]), None)
    row = in_range
    if row is None:
        frequency_ghz, row = min(((end, row) for row in ranges for end in row[:2]),
                                 key=lambda pair: abs(pair[0] - frequency_ghz))
    a, b, c, d = row[2:]
    return a * frequency_ghz**b, c * frequency_ghz**d, in_range is not None


def ranges_text(name: str) -> str:
    """Format the frequency ranges of an ITU material: `1-100 GHz, 110-330 GHz`."""
    return ", ".join(f"{low:g}-{high:g} GHz" for low, high, *_ in ITU_TABLE[name])


def constants(material: Material, frequency_hz: float) -> tuple[float, float, bool]:
    """Return relative permittivity, conductivity [S/m], and whether they hold at the frequency.

    The last is False for an ITU material outside its frequency ranges.
    """
    if material.itu is not None:
        return permittivity(material.itu, frequency_hz)
    assert material.relative_permittivity is not None
    assert material.conductivity_s_per_m is not None
    return material.relative_permittivity, material.conductivity_s_per_m, True


def traceable(material: Material, frequency_hz: float) -> Material:
    """Return the material in a form that Sionna RT accepts at a frequency.

    Sionna RT stops on an ITU material outside its ranges, at the scene's frequency or at the
    3.5 GHz that it loads with. Such a material is returned with the constants that `permittivity`
    gives, named `<name>-fixed`; any other is returned as it is.
    """
    if material.itu is None:
        return material
    epsilon, conductivity, in_range = permittivity(material.itu, frequency_hz)
    if in_range and permittivity(material.itu, _SIONNA_LOAD_FREQUENCY_HZ)[2]:
        return material
    return replace(material, name=f"{material.name}-fixed", itu=None,
                   relative_permittivity=epsilon, conductivity_s_per_m=conductivity)


def map_materials(shapes: Sequence[DeclaredShape], declared: Mapping[str, Node],
                  overrides: Mapping[str, str], must_use_all: bool = True
                  ) -> tuple[list[Material | None], list[Problem]]:
    """Find the radio material of every shape of a Mitsuba or Sionna RT file.

    Args:
        shapes: Shapes as declared in the file.
        declared: `<bsdf>` elements of the file by identifier.
        overrides: Identifier of a material (with or without `mat-`) -> ITU material to use.
        must_use_all: Whether each override has to name a material of these shapes.

    Returns:
        The material of each shape (None: with an error among the problems), and the problems.

    Raises:
        BadInput: An override names a material that the city does not use, or no ITU material.
    """
    known: dict[str, Material | None] = {}
    used: set[str] = set()
    found: list[Problem] = []
    older: list[str] = []
    materials: list[Material | None] = []
    for shape in shapes:
        if shape.material is None:
            materials.append(None)
            continue
        if isinstance(shape.material, Node):
            node: Node | None = shape.material
            identifier = shape.material.attributes.get("id") or f"{shape.name}-material"
        else:
            identifier, node = shape.material, declared.get(shape.material)
        if identifier not in known:
            names = identifier, identifier.removeprefix("mat-")
            key = next((name for name in names if name in overrides), None)
            try:
                if key is not None:
                    used.add(key)
                    known[identifier] = itu_material(overrides[key])
                else:
                    known[identifier], is_older = _declared_material(identifier, node)
                    older += [identifier] * is_older
            except _Unmapped as error:
                known[identifier] = None
                found.append(problems.error(str(error), identifier))
        materials.append(known[identifier])
    unused = set(overrides) - used
    if unused and must_use_all:
        raise _unused_override_error(unused, known)
    if older:
        found.append(problems.fixed(
            f"{len(older)} material(s) in the older form, a surface colour with an ITU name "
            f"({listed(older)}): written as ITU radio materials"))
    if bare := [shape.name for shape in shapes if shape.material is None]:
        found.append(problems.error(
            f"{len(bare)} shape(s) have no material ({listed(bare)}); add "
            '<ref id="mat-itu_concrete" name="bsdf"/> and that material'))
    return materials, found


def _unused_override_error(names: Collection[str], known: Iterable[str]) -> BadInput:
    """Return the error that overrides name materials that the city does not use."""
    return BadInput(f"material {min(names)!r} is to be replaced, but the city does not use it; "
                    f"it uses: {', '.join(sorted(known)) or '(none)'}")


def materials_by_name(names: Sequence[str | None], overrides: Mapping[str, str],
                      must_use_all: bool = True) -> tuple[list[Material | None], list[Problem]]:
    """Find the radio materials of a model in OBJ or glTF, which has only names of materials.

    Args:
        names: Name of each shape's material; None: it has none.
        overrides: Name of a material -> ITU material to use; `default`: for all unknown names.
        must_use_all: Whether each override has to name a material of these shapes.

    Returns:
        The material of each shape, and a warning about unknown names, which became concrete.

    Raises:
        BadInput: As `map_materials`.
    """
    by_name: dict[str | None, Material | None] = {}
    unknown: list[str] = []
    used: set[str] = set()
    default = itu_material(overrides.get("default", DEFAULT_MATERIAL))
    for name in dict.fromkeys(names):
        key = next((key for key in (name, (name or "").removeprefix("mat-")) if key in overrides),
                   None)
        # Blender numbers copies (brick.001); `traceable` appends -fixed, which exports keep
        itu = itu_name(_COPY.sub("", name or "").removesuffix("-fixed").lower())
        if key is not None:
            used.add(key)
            by_name[name] = itu_material(overrides[key])
        elif itu is not None:
            by_name[name] = itu_material(itu)
        else:
            by_name[name] = default
            unknown.append(name or "(no material)")
    unused = set(overrides) - used - {"default"}
    if unused and must_use_all:
        raise _unused_override_error(unused, [name for name in by_name if name])
    found = [] if "default" in overrides or not unknown else [problems.warning(
        f"{len(unknown)} material(s) have no name of an ITU material ({listed(unknown)}): "
        f"{DEFAULT_MATERIAL} was taken. Say what they are with --material NAME=ITU, or of all such "
        "with --material default=ITU")]
    return [by_name[name] for name in names], found


class _Unmapped(Exception):
    """A declared material that has no radio constants; the message says what to do."""


def _declared_material(identifier: str, node: Node | None) -> tuple[Material, bool]:
    """Return the material of a `<bsdf>` by its ITU name or constants, and if its form is older.

    _Unmapped, with a remedy, if it has neither, or is not declared (`node` is None).
    """
    base = identifier.removeprefix("mat-")
    remedy = f"say what it is made of, for example with --material {base}=itu_concrete"
    if node is None:
        raise _Unmapped(f"material {identifier!r} is used but not declared; {remedy}")
    kind = node.attributes.get("type", "")
    has_itu_name = base.startswith(("itu_", "itu-"))
    if has_itu_name or kind == "itu-radio-material":
        itu = itu_name(node.get("string", "type") or (base if has_itu_name else ""))
        if itu is None:
            raise _Unmapped(f"{node.position}: material {identifier!r} has the ITU type "
                            f"{node.get('string', 'type') or base!r}, which does not exist; "
                            f"there are: {', '.join(ITU_TABLE)}")
        name = safe_name(base[4:] if has_itu_name else base)
        return (_with_surface(identifier, node, Material(name, itu=itu)),
                kind != "itu-radio-material")
    if kind == "radio-material":
        name = safe_name(base)
        return _with_surface(identifier, node, Material(
            f"own-{name}" if itu_name(name) else name,
            relative_permittivity=node.number("relative_permittivity", 1.0),
            conductivity_s_per_m=node.number("conductivity", 0.0))), False
    if base in ITU_TABLE:
        return itu_material(base), True
    raise _Unmapped(f"{node.position}: material {identifier!r} (type '{kind}') has no radio "
                    f"constants; {remedy}")


def _with_surface(identifier: str, node: Node, material: Material) -> Material:
    """Return the material with thickness and scattering of its `<bsdf>`, all values checked."""
    material = replace(
        material,
        thickness_m=node.number("thickness", Material.thickness_m),
        scattering_coefficient=node.number("scattering_coefficient", 0.0),
        xpd_coefficient=node.number("xpd_coefficient", 0.0))
    for name, (low, high) in _RANGES.items():
        value = getattr(material, name)
        if value is not None and not low <= value <= high:
            raise _Unmapped(f"{node.position}: material {identifier!r}: {name} = {value:g} is not "
                            f"possible; allowed: {low:g} to {high:g}")
    return material


def traceable_materials(materials: Sequence[Material], frequency_hz: float, taken: Names
                        ) -> tuple[dict[Material, Material], list[Problem]]:
    """Convert materials to the form that Sionna RT accepts at a frequency, with unique names.

    Returns:
        Declared material -> traceable material, whose name is added to `taken`, and a problem for
        each ITU material that became one with constants.
    """
    written, found = {}, []
    for material in sorted(set(materials), key=lambda one: (one.name, repr(one))):
        usable = traceable(material, frequency_hz)
        written[material] = replace(usable, name=taken.unique(usable.name))
        if usable is material:
            continue
        epsilon, sigma, in_range = constants(material, frequency_hz)
        values = (f"relative permittivity {epsilon:.3g} and conductivity {sigma:.3g} S/m are "
                  "written as constants (build the scene again to change the frequency)")
        subject = (f"material {material.name!r} (ITU {material.itu}, "
                   f"{ranges_text(material.itu or '')})")
        if in_range:
            found.append(problems.fixed(f"{subject} cannot be loaded by Sionna RT, which starts at "
                                        f"3.5 GHz: {values}", material.name))
        else:
            found.append(problems.warning(
                f"{subject} is not known at {frequency_hz / 1e9:g} GHz; taken at the nearest end "
                f"of its ranges: {values}", material.name))
    return written, found


@dataclass(frozen=True)
class MaterialTable:
    """ITU materials of a map's buildings, by tag.

    Attributes:
        default: material of buildings without a tag of the table.
        ground: material of the ground plane.
        by_tag: key -> value -> material; keys are looked up in this order.
        roof: material of roofs; None: that of the building's walls.
    """

    default: str
    ground: str
    by_tag: Mapping[str, Mapping[str, str]]
    roof: str | None = None

    def material_of(self, tags: Mapping[str, str]) -> tuple[Material, str]:
        """Return the material of a building, and its source: `building:material=brick`, `default`.

        A tag may have several values, separated by `;`: the first one in the table is used.
        """
        for key, known in self.by_tag.items():
            for value in _tag_values(tags, key):
                if value in known:
                    return itu_material(known[value]), f"{key}={value}"
        return itu_material(self.default), "default"

    def unknown(self, tags: Mapping[str, str]) -> str | None:
        """Return the value of `building:material` if it is not in the table, else None."""
        values = [value for value in _tag_values(tags, MATERIAL_KEY) if value]
        known = self.by_tag.get(MATERIAL_KEY, {})
        return values[0] if values and not any(value in known for value in values) else None


def _tag_values(tags: Mapping[str, str], key: str) -> list[str]:
    """Return the values of a tag, which `;` separates, in lower case."""
    return [value.strip() for value in tags.get(key, "").lower().split(";")]


# Natural stone has no entry in P.2040: dense stone is taken as marble, sandstone as concrete
STANDARD = MaterialTable(
    default="concrete", ground="asphalt_concrete",
    by_tag={
        MATERIAL_KEY: {
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
    """Read a table of materials by tag from a TOML file; its entries precede the standard ones.

    Args:
        path: file with `default`, `ground`, `roof`, and tables named after keys of tags, which are
            looked up in the order of the file, before the other keys of the standard table.

    Raises:
        BadInput: no such file, not TOML, or a material that is not in ITU-R P.2040.
    """
    path = Path(path)
    data = read_toml(path, "TOML file with materials by tag")
    fields = {name: data.pop(name) for name in _FIELDS
              if name in data and not (name == "roof" and isinstance(data[name], dict))}  # a tag
    named: list[tuple[str, object]] = list(fields.items())
    for key, values in data.items():
        if not isinstance(values, dict):
            raise BadInput(f"{path}: {key} = {values!r:.60} is in no table; write it under the key "
                           f'of its tag, for example ["{MATERIAL_KEY}"]')
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
    unchanged = {key: known for key, known in STANDARD.by_tag.items() if key not in data}
    return replace(STANDARD, **fields, by_tag=by_tag | unchanged)


def with_materials(table: MaterialTable, overrides: Mapping[str, str]) -> MaterialTable:
    """Return a table of materials with some entries replaced.

    Args:
        table: table that is copied.
        overrides: `default`, `ground`, `roof`, or a value of `building:material` -> ITU material.

    Raises:
        BadInput: a material is not in ITU-R P.2040.
    """
    for name in overrides.values():
        itu_material(name)
    fields = {name: itu for name, itu in overrides.items() if name in _FIELDS}
    values = {name.lower(): itu for name, itu in overrides.items() if name not in fields}
    by_tag = dict(table.by_tag) | {MATERIAL_KEY: dict(table.by_tag[MATERIAL_KEY]) | values}
    return replace(table, **fields, by_tag=by_tag)
