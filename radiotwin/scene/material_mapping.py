"""Radio materials for the materials that a scene file declares, older forms included."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from radiotwin.errors import BadInput
from radiotwin.scene import problems
from radiotwin.scene.materials import (
    ITU_TABLE,
    Material,
    constants,
    itu_material,
    itu_name,
    ranges_text,
    traceable,
)
from radiotwin.scene.mitsuba_xml import DeclaredShape
from radiotwin.scene.names import safe_name, unique_name
from radiotwin.scene.problems import Problem, listed
from radiotwin.scene.xml_tree import Node

DEFAULT_MATERIAL = "concrete"
_COPY = re.compile(r"\.\d{3}$")
_LIMITS = {  # far beyond any material, and well inside single precision
    "relative_permittivity": (1, 1e6), "conductivity_s_per_m": (0, 1e10), "thickness_m": (0, 1e4),
    "scattering_coefficient": (0, 1), "xpd_coefficient": (0, 1)}


def map_materials(shapes: Sequence[DeclaredShape], declared: Mapping[str, Node],
                  overrides: Mapping[str, str], must_use_all: bool = True
                  ) -> tuple[list[Material | None], list[Problem]]:
    """Find the radio material of every shape.

    Args:
        shapes: As declared.
        declared: `<bsdf>` elements of the file by identifier.
        overrides: Identifier of a material (with or without `mat-`) -> ITU material to use.
        must_use_all: Whether each override has to name a material of these shapes.

    Returns:
        The material of each shape, None where there is none, and the problems found.

    Raises:
        BadInput: An override names a material that the city does not use, or no ITU material.
    """
    mapper = _Mapper(declared, overrides)
    materials = [mapper.material_of(shape) for shape in shapes]
    unused = set(overrides) - mapper.overridden
    if unused and must_use_all:
        raise _unused(unused, mapper.known)
    return materials, mapper.all_problems()


def _unused(names: Collection[str], known: Iterable[str]) -> BadInput:
    return BadInput(f"material {min(names)!r} is to be replaced, but the city does not use it; "
                    f"it uses: {', '.join(sorted(known)) or '(none)'}")


def materials_by_name(names: Sequence[str | None], overrides: Mapping[str, str],
                      must_use_all: bool = True) -> tuple[list[Material | None], list[Problem]]:
    """Find radio materials by nothing but their names, as models in OBJ or glTF have them.

    Args:
        names: Of the material of each shape; None: it has none.
        overrides: Name of a material -> ITU material to use; `default`: of all others.
        must_use_all: Whether each override has to name a material of these shapes.

    Returns:
        The material of each shape, and a problem about those that concrete was taken for.

    Raises:
        BadInput: An override names a material that the model does not use, or no ITU material.
    """
    by_name: dict[str | None, Material | None] = {}
    unknown: list[str] = []
    used: set[str] = set()
    default = itu_material(overrides.get("default", DEFAULT_MATERIAL))
    for name in dict.fromkeys(names):
        key = next((key for key in (name, (name or "").removeprefix("mat-")) if key in overrides),
                   None)
        # Blender numbers copies (brick.001), exported scenes have constants of ITU's (brick-fixed)
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
        raise _unused(unused, [name for name in by_name if name])
    found = [] if "default" in overrides or not unknown else [problems.warning(
        f"{len(unknown)} material(s) have no name of an ITU material ({listed(unknown)}): "
        f"{DEFAULT_MATERIAL} was taken. Say what they are with --material NAME=ITU, or of all such "
        "with --material default=ITU")]
    return [by_name[name] for name in names], found


class _Unmapped(Exception):
    """A declared material that has no radio constants; the message says what to do."""


@dataclass
class _Mapper:
    declared: Mapping[str, Node]
    overrides: Mapping[str, str]
    known: dict[str, Material | None] = field(default_factory=dict)
    overridden: set[str] = field(default_factory=set)
    problems: list[Problem] = field(default_factory=list)
    legacy: list[str] = field(default_factory=list)
    bare: list[str] = field(default_factory=list)

    def material_of(self, shape: DeclaredShape) -> Material | None:
        if shape.material is None:
            self.bare.append(shape.name)
            return None
        node: Node | None
        if isinstance(shape.material, Node):
            node = shape.material
            identifier = node.attributes.get("id") or f"{shape.name}-material"
        else:
            identifier = shape.material
            node = self.declared.get(identifier)
        if identifier not in self.known:
            try:
                self.known[identifier] = self._resolve(identifier, node)
            except _Unmapped as error:
                self.known[identifier] = None
                self.problems.append(problems.error(str(error), identifier))
        return self.known[identifier]

    def all_problems(self) -> list[Problem]:
        found = list(self.problems)
        if self.legacy:
            found.append(problems.fixed(
                f"{len(self.legacy)} material(s) in the older form, a surface colour with an ITU "
                f"name ({listed(self.legacy)}): written as ITU radio materials"))
        if self.bare:
            found.append(problems.error(
                f"{len(self.bare)} shape(s) have no material ({listed(self.bare)}); add "
                '<ref id="mat-itu_concrete" name="bsdf"/> and that material'))
        return found

    def _resolve(self, identifier: str, node: Node | None) -> Material:
        base = identifier.removeprefix("mat-")
        for key in (identifier, base):
            if key in self.overrides:
                self.overridden.add(key)
                return itu_material(self.overrides[key])
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
            if kind != "itu-radio-material":
                self.legacy.append(identifier)
            name = safe_name(base[4:] if has_itu_name else base)
            return _with_surface(identifier, node, Material(name, itu=itu))
        if kind == "radio-material":
            name = safe_name(base)
            return _with_surface(identifier, node, Material(
                f"own-{name}" if itu_name(name) else name,
                relative_permittivity=node.number("relative_permittivity", 1.0),
                conductivity_s_per_m=node.number("conductivity", 0.0)))
        if base in ITU_TABLE:
            self.legacy.append(identifier)
            return itu_material(base)
        raise _Unmapped(f"{node.position}: material {identifier!r} (type '{kind}') has no radio "
                        f"constants; {remedy}")


def _with_surface(identifier: str, node: Node, material: Material) -> Material:
    """Add what a `<bsdf>` says about thickness and scattering, and check all constants."""
    material = replace(
        material,
        thickness_m=node.number("thickness", Material.thickness_m),
        scattering_coefficient=node.number("scattering_coefficient", 0.0),
        xpd_coefficient=node.number("xpd_coefficient", 0.0))
    for name, (low, high) in _LIMITS.items():
        value = getattr(material, name)
        if value is not None and not low <= value <= high:
            raise _Unmapped(f"{node.position}: material {identifier!r}: {name} = {value:g} is not "
                            f"possible; allowed: {low:g} to {high:g}")
    return material


def settle(materials: Sequence[Material], frequency_hz: float, taken: set[str]
           ) -> tuple[dict[Material, Material], list[Problem]]:
    """Return the materials as Sionna RT accepts them at a frequency, with unique names.

    Args:
        materials: Materials in use.
        frequency_hz: Frequency of the scene [Hz].
        taken: Names in use, in lower case; grows.

    Returns:
        Material as declared -> as written, and a problem for each that is written as constants.
    """
    written, found = {}, []
    for material in sorted(set(materials), key=lambda one: (one.name, repr(one))):
        usable = traceable(material, frequency_hz)
        written[material] = replace(usable, name=unique_name(usable.name, taken))
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
