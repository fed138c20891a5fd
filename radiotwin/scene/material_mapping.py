"""From the materials a scene file declares to radio materials, the older forms included."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.scene.materials import (
    ITU_TABLE,
    Material,
    constants,
    itu_material,
    itu_name,
    ranges_text,
    traceable,
)
from radiotwin.scene.mitsuba_xml import DeclaredShape, Node
from radiotwin.scene.problems import Problem, listed


def safe_name(text: str) -> str:
    """A name that Sionna RT, Mitsuba and file systems accept: ASCII letters, digits, `_` and `-`.

    Sionna RT 2.2 stops at `$` (a Mitsuba parameter) in a name, and reads scene files in the system's own
    encoding; `.` is Mitsuba's separator; `/` and the like cannot be in the name of a mesh file.
    """
    return re.sub(r"[^A-Za-z0-9_-]", "_", text)[:100] or "unnamed"


def unique_name(name: str, taken: set[str]) -> str:
    """The name, with a number where it is not free; `taken` (lower case: as some file systems) grows."""
    free, number = name, 1
    while free.lower() in taken:
        number += 1
        free = f"{name}_{number}"
    taken.add(free.lower())
    return free


def map_materials(
    shapes: Sequence[DeclaredShape], declared: Mapping[str, Node], overrides: Mapping[str, str]
) -> tuple[list[Material | None], list[Problem]]:
    """Radio material of every shape.

    Args:
        shapes: as declared.
        declared: `<bsdf>` elements of the file by identifier.
        overrides: identifier of a material (with or without `mat-`) -> ITU material to take for it.

    Returns:
        The material of each shape, None where there is none, and the problems found.

    Raises:
        BadInput: an override names a material that the city does not use, or no ITU material.
    """
    mapper = _Mapper(declared, overrides)
    materials = [mapper.material_of(shape) for shape in shapes]
    unused = set(overrides) - mapper.overridden
    if unused:
        raise BadInput(
            f"material {min(unused)!r} is to be replaced, but the city does not use it; it uses: "
            f"{', '.join(sorted(mapper.known))}"
        )
    return materials, mapper.all_problems()


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
            self.known[identifier] = self._resolve(identifier, node)
        return self.known[identifier]

    def all_problems(self) -> list[Problem]:
        found = list(self.problems)
        if self.legacy:
            found.append(
                Problem(
                    "fixed",
                    "",
                    f"{len(self.legacy)} material(s) in the older form, a surface colour with "
                    f"an ITU name ({listed(self.legacy)}): written as ITU radio materials",
                )
            )
        if self.bare:
            found.append(
                Problem(
                    "error",
                    "",
                    f"{len(self.bare)} shape(s) have no material ({listed(self.bare)}); add "
                    '<ref id="mat-itu_concrete" name="bsdf"/> and that material',
                )
            )
        return found

    def _error(self, identifier: str, message: str) -> Any:
        """Note an error; None, for a material that there is not."""
        self.problems.append(Problem("error", identifier, message))

    def _resolve(self, identifier: str, node: Node | None) -> Material | None:
        base = identifier.removeprefix("mat-")
        for key in (identifier, base):
            if key in self.overrides:
                self.overridden.add(key)
                return itu_material(self.overrides[key])
        remedy = f"say what it is made of, for example with --material {base}=itu_concrete"
        if node is None:
            return self._error(identifier, f"material {identifier!r} is used but not declared; {remedy}")
        kind = node.attributes.get("type", "")
        has_itu_name = base.startswith(("itu_", "itu-"))
        if has_itu_name or kind == "itu-radio-material":
            itu = itu_name(node.get("string", "type") or (base if has_itu_name else ""))
            if itu is None:
                return self._error(
                    identifier,
                    f"{node.place}: material {identifier!r} has the ITU type "
                    f"{node.get('string', 'type') or base!r}, which does not exist; there are: "
                    f"{', '.join(ITU_TABLE)}",
                )
            if kind != "itu-radio-material":
                self.legacy.append(identifier)
            return self._surface(
                identifier, node, Material(safe_name(base[4:] if has_itu_name else base), itu=itu)
            )
        if kind == "radio-material":
            name = safe_name(base)
            material = Material(
                f"own-{name}" if itu_name(name) else name,
                relative_permittivity=node.number("relative_permittivity", 1.0),
                conductivity_s_per_m=node.number("conductivity", 0.0),
            )
            return self._surface(identifier, node, material)
        if base in ITU_TABLE:
            self.legacy.append(identifier)
            return itu_material(base)
        return self._error(
            identifier,
            f"{node.place}: material {identifier!r} (type '{kind}') has no radio constants; {remedy}",
        )

    def _surface(self, identifier: str, node: Node, material: Material) -> Material | None:
        material = replace(
            material,
            thickness_m=node.number("thickness", 0.1),
            scattering_coefficient=node.number("scattering_coefficient", 0.0),
            xpd_coefficient=node.number("xpd_coefficient", 0.0),
        )
        limits = (
            ("relative_permittivity", 1, inf),
            ("conductivity_s_per_m", 0, inf),
            ("thickness_m", 0, inf),
            ("scattering_coefficient", 0, 1),
            ("xpd_coefficient", 0, 1),
        )
        for name, low, high in limits:
            value = getattr(material, name)
            if value is not None and not low <= value <= high:
                allowed = f"at least {low}" if high == inf else f"{low} to {high}"
                return self._error(
                    identifier,
                    f"{node.place}: material {identifier!r}: {name} = {value:g} is not "
                    f"possible; allowed: {allowed}",
                )
        return material


def settle(
    materials: Sequence[Material], frequency_hz: float, taken: set[str]
) -> tuple[dict[Material, Material], list[Problem]]:
    """The materials as they are written: accepted by Sionna RT at the frequency, with names of their own.

    Args:
        materials: those in use.
        frequency_hz: of the scene [Hz].
        taken: names in use already (lower case); grows.

    Returns:
        Material as declared -> as written, and a problem for each that is outside the range of its ITU fit.
    """
    written, problems = {}, []
    for material in sorted(set(materials), key=lambda material: (material.name, repr(material))):
        usable = traceable(material, frequency_hz)
        written[material] = replace(usable, name=unique_name(usable.name, taken))
        if usable is material:
            continue
        epsilon, sigma, in_range = constants(material, frequency_hz)
        values = (
            f"relative permittivity {epsilon:.3g} and conductivity {sigma:.3g} S/m are written as constants "
            "(build the scene again to change the frequency)"
        )
        if in_range:
            problems.append(
                Problem(
                    "fixed",
                    material.name,
                    f"material {material.name!r} (ITU {material.itu}, "
                    f"{ranges_text(material.itu or '')}) cannot be loaded by Sionna RT, which starts at 3.5 GHz: "
                    f"{values}",
                )
            )
        else:
            problems.append(
                Problem(
                    "warning",
                    material.name,
                    f"material {material.name!r} (ITU {material.itu}, "
                    f"{ranges_text(material.itu or '')}) is not known at {frequency_hz / 1e9:g} GHz; taken at the "
                    f"nearest end of its ranges: {values}",
                )
            )
    return written, problems
