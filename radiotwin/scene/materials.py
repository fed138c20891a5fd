"""Radio materials: Recommendation ITU-R P.2040, and materials with constants of their own."""

from dataclasses import dataclass, replace
from typing import Any

from radiotwin.errors import BadInput

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


@dataclass(frozen=True)
class Material:
    """Radio properties of a surface.

    Attributes:
        name: Used in files; letters, digits, `_` and `-`.
        itu: Key of `ITU_TABLE`, or None for a material with its own constants.
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
    """Return the key of `ITU_TABLE` for a name like `itu-metal` or `brick`, or None.

    >>> itu_name("mat-itu_wet_ground")
    'wet_ground'
    """
    name = text.removeprefix("mat-")
    for prefix in ("itu_", "itu-"):
        name = name.removeprefix(prefix)
    return name if name in ITU_TABLE else None


def itu_material(text: str, **settings: Any) -> Material:
    """Return a material of the ITU table, named after its type.

    Args:
        text: `concrete`, `itu_concrete`, ...
        settings: Other fields of `Material`.

    Raises:
        BadInput: Not in the table.
    """
    itu = itu_name(text)
    if itu is None:
        raise BadInput(f"there is no ITU material {text!r}; there are: {', '.join(ITU_TABLE)}")
    return Material(**({"name": itu} | settings), itu=itu)


def permittivity(name: str, frequency_hz: float) -> tuple[float, float, bool]:
    """Return the constants of an ITU material (ITU-R P.2040-4, section 2.1.4).

    Outside the frequency ranges of its fit, the nearest end of the nearest range is used: the power
    laws are not extrapolated, as no measurements support them there.

    Args:
        name: `concrete`, `itu_concrete`, ...
        frequency_hz: Frequency [Hz].

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
    if in_range is None:
        nearest_ghz, row = min(((end, row) for row in ranges for end in row[:2]),
                               key=lambda pair: abs(pair[0] - frequency_ghz))
        return *_power_laws(row, nearest_ghz), False
    return *_power_laws(in_range, frequency_ghz), True


def _power_laws(row: tuple[float, ...], frequency_ghz: float) -> tuple[float, float]:
    _, _, a, b, c, d = row
    return a * frequency_ghz**b, c * frequency_ghz**d


def ranges_text(name: str) -> str:
    """Return the frequency ranges of an ITU material as `1-100 GHz, 110-330 GHz`."""
    return ", ".join(f"{low:g}-{high:g} GHz" for low, high, *_ in ITU_TABLE[name])


def constants(material: Material, frequency_hz: float) -> tuple[float, float, bool]:
    """Return the constants of any material.

    Args:
        material: With or without an ITU type.
        frequency_hz: Frequency [Hz].

    Returns:
        Relative permittivity, conductivity [S/m], and whether ITU covers the frequency (True for a
        material with its own constants).
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

    Args:
        material: Any material.
        frequency_hz: Frequency of the scene [Hz].
    """
    if material.itu is None:
        return material
    epsilon, conductivity, in_range = permittivity(material.itu, frequency_hz)
    if in_range and permittivity(material.itu, _SIONNA_LOAD_FREQUENCY_HZ)[2]:
        return material
    return replace(material, name=f"{material.name}-fixed", itu=None,
                   relative_permittivity=epsilon, conductivity_s_per_m=conductivity)
