"""Reflection at a slab and UTD diffraction at a wedge: coefficients, and the field after them.

A surface is a dielectric slab of the thickness that its material declares [1]; its back reflects,
too. The ground is a half space. Scattering by a rough surface weakens the reflected field by
sqrt(1 - S²) with the scattering coefficient S [5].

An edge is a wedge in the uniform theory of diffraction [2]. By Keller's law, incident and
diffracted ray have the same angle to the edge. For dielectric faces there are only heuristics,
which differ by many decibels away from the shadow and reflection boundaries. This is Luebbers' [3]:
the two terms of the reflection boundaries are multiplied by the reflection coefficients of the
faces. He takes the angles of reflection from the incident ray, which is not reciprocal. Here the
smaller of the angles of incident and diffracted ray to each face is used. It agrees with his at the
reflection boundaries and in the shadow behind a lit face, for which he gave it, and it is
reciprocal everywhere. For conductors it is exact.

The knife edge of ITU-R P.526 is not used: it has neither the angle of the wedge nor its material
nor the polarisation, and it holds close to the shadow boundary only.

[1] Recommendation ITU-R P.2040-4, "Effects of building materials and structures on radiowave
    propagation above about 100 MHz", 2025: section 2.2.2 and Table 3.
[2] Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
    conducting surface", Proc. IEEE 62(11), 1974: eq. 25-29 and 33.
[3] Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction in prediction of
    propagation path loss", IEEE Trans. Antennas Propag. 32(1), 1984.
[4] Balanis, "Advanced Engineering Electromagnetics", 2nd ed., 2012: section 5.3.
[5] Degli-Esposti et al., "Measurement and modelling of scattering from buildings", IEEE Trans.
    Antennas Propag. 55(1), 2007: eq. 2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.propagation.paths.surfaces import (
    ALONG,
    EXTERIOR,
    MATERIAL_0,
    MATERIAL_N,
    NORMAL_0,
    NORMAL_N,
    START,
    TANGENT,
    Triple,
    cross,
    divided,
    dot,
)
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import Material, constants

VACUUM_PERMITTIVITY_F_M = 8.8541878128e-12  # [F/m], CODATA 2018
MIN_SINE = 1e-9  # of the angle between ray and surface; at 0 all coefficients tend to -1
MIN_FACE_SINE = 1e-4  # of the angle between ray and face of a wedge; flatter rays are dropped


class Slabs(NamedTuple):
    """Materials of a city at one frequency; the last is the ground.

    Attributes:
        permittivity: (m,) complex relative permittivity, for fields that vary as exp(+j ω t).
        phase_rad: (m,) thickness times wave number in vacuum [rad]; infinite: a half space.
        specular: (m,) factor of the reflected field for a rough surface, sqrt(1 - S²).
    """

    permittivity: np.ndarray
    phase_rad: np.ndarray
    specular: np.ndarray


def city_slabs(city: CityMap, frequency_hz: float) -> Slabs:
    """Return the slabs of a city's materials at a frequency [Hz]; the last is the ground."""
    slabs = slabs_of((*city.materials, city.ground_material), frequency_hz)
    slabs.phase_rad[-1] = np.inf
    return slabs


def slabs_of(materials: Sequence[Material], frequency_hz: float) -> Slabs:
    """Return the slabs of m materials at a frequency [Hz], by `materials.constants`."""
    angular = 2 * np.pi * frequency_hz
    real, conductivity_s_m, _ = np.array([constants(material, frequency_hz)
                                          for material in materials]).T
    thickness_m, scattering = np.array([(material.thickness_m, material.scattering_coefficient)
                                        for material in materials]).T
    return Slabs(real - 1j * conductivity_s_m / (angular * VACUUM_PERMITTIVITY_F_M),
                 angular / speed_of_light * thickness_m, np.sqrt(1 - scattering**2))


@njit(cache=True)
def fresnel(sine: float, permittivity: complex) -> tuple[complex, complex]:
    """Return the Fresnel reflection coefficients TE and TM of a half space [4].

    They tend to -1 and +1 for a perfect conductor. `sine` is of the angle between ray and surface.
    """
    root = np.sqrt(permittivity - (1.0 - sine * sine) + 0j)
    te = (sine - root) / (sine + root)
    return te, (permittivity * sine - root) / (permittivity * sine + root)


@njit(cache=True)
def reflection(sine: float, slabs: Slabs, row: int) -> tuple[complex, complex]:
    """Return the reflection coefficients of a slab in air [1, eq. 43a, 44] or of a half space.

    TE and TM of the specular field, with the signs of `fresnel`; `row` is the material's in
    `slabs`.
    """
    sine = max(sine, MIN_SINE)
    permittivity = slabs.permittivity[row]
    te, tm = fresnel(sine, permittivity)
    if np.isinf(slabs.phase_rad[row]):
        return te * slabs.specular[row], tm * slabs.specular[row]
    root = np.sqrt(permittivity - (1.0 - sine * sine) + 0j)
    round_trip = np.exp(-2j * slabs.phase_rad[row] * root)
    scale = slabs.specular[row] * (1.0 - round_trip)
    return te * scale / (1.0 - te * te * round_trip), tm * scale / (1.0 - tm * tm * round_trip)


@njit(cache=True)
def transition(x: float) -> complex:
    """Return the transition function F(x) of Kouyoumjian and Pathak, x >= 0, exact to 1e-5."""
    if x > 30.0:  # asymptotic series
        inverse = 1.0 / x
        return complex(1.0 - 0.75 * inverse * inverse, 0.5 * inverse - 1.875 * inverse**3)
    root = np.sqrt(x)
    return 2j * root * np.exp(1j * x) * _fresnel_tail(root)


@njit(cache=True)
def _fresnel_tail(a: float) -> complex:
    """Return the integral of exp(-j t²) over t from a >= 0 to infinity."""
    if a < 2.2:  # power series of the integral from 0 to a
        total = 0j
        term = complex(a, 0.0)
        square = -1j * a * a
        for n in range(60):
            total += term / (2 * n + 1)
            term *= square / (n + 1)
            if abs(term) < 1e-15:
                break
        return 0.5 * np.sqrt(np.pi / 2) * (1 - 1j) - total
    # Continued fraction of the complementary error function (Abramowitz and Stegun, 7.1.14)
    z = a * np.exp(0.25j * np.pi)
    fraction = z
    for n in range(60, 0, -1):
        fraction = z + 0.5 * n / fraction
    return 0.5 * np.exp(-0.25j * np.pi) * np.exp(-1j * a * a) / fraction


@njit(cache=True)
def wedge_coefficients(phi: float, phi_in: float, sine_edge: float, distance_m: float,
                       wave_number: float, n: float, face_0: tuple[complex, complex],
                       face_n: tuple[complex, complex]) -> tuple[complex, complex]:
    """Return the UTD diffraction coefficients of a wedge with lossy faces [2, eq. 25-28; 3].

    For the field along (soft) and across (hard) the edge [√m]. Angles of the diffracted and
    incident ray are from face 0, across the edge [rad], 0 to n π, the exterior angle; `sine_edge`
    is of the angle between ray and edge, `distance_m` s s' sin² / (s + s') of the distances s'
    before and s after the edge. Faces have reflection coefficients (TE, TM) at their `face_sines`;
    (-1, 1) is a perfect conductor.
    """
    soft_0, hard_0 = face_0
    soft_n, hard_n = face_n
    x = wave_number * distance_m
    incident = _cotangent_term(phi - phi_in, x, n, 1) + _cotangent_term(phi - phi_in, x, n, -1)
    at_n = _cotangent_term(phi + phi_in, x, n, 1)
    at_0 = _cotangent_term(phi + phi_in, x, n, -1)
    scale = -np.exp(-0.25j * np.pi) / (2.0 * n * np.sqrt(2.0 * np.pi * wave_number) * sine_edge)
    return (scale * (incident + soft_n * at_n + soft_0 * at_0),
            scale * (incident + hard_n * at_n + hard_0 * at_0))


@njit(cache=True)
def face_sines(phi: float, phi_in: float, sine_edge: float, n: float) -> tuple[float, float]:
    """Return the sines of the grazing angles at which the faces 0 and n of a wedge reflect.

    At each face it is the smaller angle of incident and diffracted ray, which is reciprocal.
    Arguments are those of `wedge_coefficients`.
    """
    return (sine_edge * abs(np.sin(min(phi, phi_in))),
            sine_edge * abs(np.sin(n * np.pi - max(phi, phi_in))))


@njit(cache=True)
def _cotangent_term(beta: float, x: float, n: float, sign: int) -> complex:
    """Return a term of UTD: cot((π + sign β) / 2n) F(x a(β)), finite at the boundary [2]."""
    turns = np.rint((beta + sign * np.pi) / (2.0 * np.pi * n))
    half = 0.5 * (2.0 * np.pi * n * turns - beta)
    a = 2.0 * np.cos(half) ** 2
    epsilon = np.pi + sign * (beta - 2.0 * np.pi * n * turns)
    if abs(epsilon) < 1e-5:
        side = 1.0 if epsilon >= 0 else -1.0
        return n * (np.sqrt(2.0 * np.pi * x) * side - 2.0 * x * epsilon * np.exp(0.25j * np.pi)) \
            * np.exp(0.25j * np.pi)
    return transition(x * a) / np.tan((np.pi + sign * beta) / (2.0 * n))


@njit(cache=True, error_model="numpy")
def reflect(normal: np.ndarray, material: int, direction_in: np.ndarray, slabs: Slabs,
            field: np.ndarray) -> Triple:
    """Reflect the complex field (3,) of a ray in place, and return the reflected ray's direction.

    The unit normal (3,) of the surface may point to either side; `direction_in` (3,) is a unit
    vector.
    """
    cosine = dot(direction_in, normal)
    direction = (direction_in[0] - 2.0 * cosine * normal[0],
                 direction_in[1] - 2.0 * cosine * normal[1],
                 direction_in[2] - 2.0 * cosine * normal[2])
    across = cross(direction_in, normal)
    size2 = dot(across, across)
    if size2 < 1e-12:  # normal incidence: any direction in the surface is TE
        other = (1.0, 0.0, 0.0) if abs(normal[0]) < 0.7 else (0.0, 1.0, 0.0)
        across = cross(direction_in, other)
        size2 = dot(across, across)
    across = divided(across, np.sqrt(size2))
    within_in, within = cross(across, direction_in), cross(across, direction)
    te, tm = reflection(abs(cosine), slabs, material)
    field_te = te * dot(field, across)
    field_tm = tm * dot(field, within_in)
    for i in range(3):
        field[i] = field_te * across[i] + field_tm * within[i]
    return direction


@njit(cache=True, error_model="numpy")
def around_edge(edges: np.ndarray, edge: int, x: float, y: float, z: float
                ) -> tuple[bool, float, float]:
    """Return cylindrical coordinates of a point x, y, z [m] around an edge.

    Returns:
        True if the point is outside the wedge, its coordinate along the edge from the start [m],
        and its distance from the edge's line [m].
    """
    x, y, z = x - edges[edge, START], y - edges[edge, START + 1], z - edges[edge, START + 2]
    along_m = x * edges[edge, ALONG] + y * edges[edge, ALONG + 1] + z * edges[edge, ALONG + 2]
    across_m = np.sqrt(max(x * x + y * y + z * z - along_m * along_m, 1e-12))
    min_m = MIN_FACE_SINE * across_m
    is_open = x * edges[edge, NORMAL_0] + y * edges[edge, NORMAL_0 + 1] \
        + z * edges[edge, NORMAL_0 + 2] > min_m \
        or x * edges[edge, NORMAL_N] + y * edges[edge, NORMAL_N + 1] \
        + z * edges[edge, NORMAL_N + 2] > min_m
    return is_open, along_m, across_m


@njit(cache=True, error_model="numpy")
def diffract(edges: np.ndarray, edge: int, direction_in: np.ndarray, direction: np.ndarray,
             before_m: float, after_m: float, wave_number: float, slabs: Slabs, field: np.ndarray
             ) -> None:
    """Replace a ray's field (3,) by the one that an edge diffracts (UTD), without spreading loss.

    Directions (3,) before and after the edge are unit vectors, lengths of the path before and after
    it in metres.
    """
    row = edges[edge]
    along, tangent = row[ALONG:ALONG + 3], row[TANGENT:TANGENT + 3]
    normal_0, normal_n = row[NORMAL_0:NORMAL_0 + 3], row[NORMAL_N:NORMAL_N + 3]
    material_0, material_n = int(row[MATERIAL_0]), int(row[MATERIAL_N])
    exterior = row[EXTERIOR]
    phi_in = np.arctan2(-dot(direction_in, normal_0), -dot(direction_in, tangent)) % (2.0 * np.pi)
    phi = np.arctan2(dot(direction, normal_0), dot(direction, tangent)) % (2.0 * np.pi)
    if dot(direction_in, normal_0) >= 0.0:  # make face 0 the one that the source sees
        phi_in, phi = exterior - phi_in, exterior - phi
        normal_0, normal_n = normal_n, normal_0
        material_0, material_n = material_n, material_0
    across_in, across = cross(direction_in, along), cross(along, direction)
    sine = np.sqrt(dot(across, across))
    across_in = divided(across_in, np.sqrt(dot(across_in, across_in)))
    across = divided(across, sine)
    upright_in, upright = cross(direction_in, across_in), cross(direction, across)
    distance_m = before_m * after_m / (before_m + after_m) * sine * sine
    sine_0, sine_n = face_sines(phi, phi_in, sine, exterior / np.pi)
    soft, hard = wedge_coefficients(
        phi, phi_in, sine, distance_m, wave_number, exterior / np.pi,
        reflection(sine_0, slabs, material_0), reflection(sine_n, slabs, material_n))
    field_soft, field_hard = -soft * dot(field, upright_in), -hard * dot(field, across_in)
    for i in range(3):
        field[i] = field_soft * upright[i] + field_hard * across[i]
