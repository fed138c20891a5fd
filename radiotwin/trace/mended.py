"""Patches of Sionna RT 2.2.0 that make its diffraction reciprocal, applied in memory.

Three faults are corrected during a call:

1. Its wedge coefficient changes when the two ends are exchanged: it multiplies all four terms by
   the reflection of the incident ray. For a device 0.5 m from a metal wall and a receiver in its
   shadow, the gain is 32 dB too high. It is replaced by the coefficient of Kouyoumjian and Pathak
   [1] with Luebbers' reflections [2] in a reciprocal form, as in `radiotwin.propagation.paths`:
   each face reflects at the smaller of the angles that the incident and the diffracted ray make
   with it. For a conductor this is the exact coefficient of [1].
2. The visibility of a receiver from a diffraction point is tested from a point that is moved along
   the normal of the face that the ray hit, to the receiver's side. For a receiver behind that face,
   the point lies inside the wall if the wedge's inner angle exceeds 90 degrees. Such a receiver
   never gets the ray.
3. The length from a diffraction point to the receiver is summed over the vertices of all depths up
   to `max_depth`, including those after the last interaction, which still hold the image of the
   diffraction point. If reflections follow on the edge and the path has less than `max_depth`
   interactions, the segment from the edge to the last reflection counts three times.

[1] Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly
    conducting surface", Proc. IEEE 62(11), 1974: eq. 25-29.
[2] Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction in prediction of
    propagation path loss", IEEE Trans. Antennas Propag. 32(1), 1984.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

from radiotwin.errors import MissingPackage

KNOWN_VERSION = "2.2.0"

# From this argument on, a series replaces Sionna RT's transition function, which loses precision
_SERIES_FROM = 20.0


def installed_version() -> str:
    """Return the version of Sionna RT that is installed.

    Raises:
        MissingPackage: none is.
    """
    try:
        return version("sionna-rt")
    except PackageNotFoundError:
        raise MissingPackage("tracing rays needs Sionna RT, which is not installed; install it "
                             "with `pip install 'radiotwin[trace]'`") from None


def default_diffraction() -> Literal["reciprocal", "sionna"]:
    """Return `reciprocal` if the installed Sionna RT can be patched; else warn, return `sionna`."""
    if installed_version() == KNOWN_VERSION:
        return "reciprocal"
    warnings.warn(f"Sionna RT {installed_version()} is installed; its diffraction is used as it "
                  "is, which may change when the ends of a link are exchanged: the reciprocal one "
                  f"is known for {KNOWN_VERSION} only", stacklevel=3)
    return "sionna"


@contextmanager
def mended(diffraction: str) -> Iterator[None]:
    """Patch Sionna RT within this context, so that diffraction is the same in both directions.

    Three of its methods are replaced, and restored at the end, see the module. If `diffraction` is
    not `reciprocal`, nothing is changed.
    """
    if diffraction != "reciprocal":
        yield
        return
    import drjit
    from sionna.rt.constants import InteractionType
    from sionna.rt.path_solvers.field_calculator import FieldCalculator
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator as Search
    from sionna.rt.radio_materials.radio_material import RadioMaterial

    sample = Search._sample_radio_material

    def sample_outwards(self: Any, si: Any, *others: Any) -> Any:
        """Continue a diffracted ray 1 mm off the edge, as Sionna RT's image method does."""
        found, normal, wedges = sample(self, si, *others)
        diffracted = found.sampled_component == InteractionType.DIFFRACTION
        outward = drjit.normalize(wedges.n0 + wedges.nn)
        si.p = drjit.select(diffracted, si.p + 1e-3 * outward, si.p)
        si.n = drjit.select(diffracted, 0.0, si.n)  # a normal would move the ray's start farther
        return found, normal, wedges

    changed = ((Search, "_sample_radio_material", sample_outwards),
               (FieldCalculator, "_diffraction_compute_s_s_prime", _lengths_m),
               (RadioMaterial, "_diffraction_matrix", _wedge_matrix))
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changed]
    for owner, name, method in changed:
        setattr(owner, name, method)
    try:
        yield
    finally:
        for owner, name, method in before:
            setattr(owner, name, method)


def _lengths_m(self: Any, paths: Any, source: Any, target: Any) -> Any:
    """Return the lengths of paths after and before their diffraction [m]; replaces Sionna RT's.

    Depths behind a path's last interaction are skipped; without diffraction, all is before.
    """
    import drjit
    import mitsuba
    from sionna.rt.constants import InteractionType

    after, before = (drjit.zeros(mitsuba.Float, paths.buffer_size) for _ in range(2))
    bent = drjit.full(mitsuba.Bool, False, paths.buffer_size)
    point = drjit.copy(source)
    for depth in range(1, paths.max_depth + 1):
        kind = paths.get_interaction_type(mitsuba.UInt(depth), True)
        is_used = kind != InteractionType.NONE
        vertex = drjit.select(is_used, paths.get_vertex(mitsuba.UInt(depth), True), point)
        leg = drjit.norm(vertex - point)
        after += drjit.select(bent, leg, 0.0)
        before += drjit.select(bent, 0.0, leg)
        bent |= kind == InteractionType.DIFFRACTION
        point = vertex
    leg = drjit.norm(target - point)
    return (after + drjit.select(bent, leg, 0.0), before + drjit.select(bent, 0.0, leg))


def _wedge_matrix(self: Any, to_world: Any, direction_in: Any, direction: Any, si: Any,
                  permittivity: Any, wave_number: Any) -> Any:
    """Return the Jones matrix (4 x 4, real) of diffraction at a wedge; replaces Sionna RT's.

    The coefficient is that of [1] for a wedge of exterior angle n π, with the reflections of [2].
    Directions are in the frame of face 0, whose normal is z; `si` holds the edge's direction, face
    n's normal and the lengths of the path [m].
    """
    import drjit
    import mitsuba
    from sionna.rt.utils import (
        implicit_basis_vector,
        itu_coefficients_single_layer_slab,
        jones_matrix_rotator,
    )
    from sionna.rt.utils.jones import jones_matrix_from_real_imag

    along, normal_n = si.dn_du, si.dn_dv
    normal_0 = mitsuba.Vector3f(0, 0, 1)
    tangent = drjit.normalize(drjit.cross(normal_0, along))
    exterior = drjit.two_pi - drjit.safe_acos(-drjit.dot(normal_0, normal_n))
    n = exterior / drjit.pi

    def angle(to_end: Any) -> Any:
        """Return the angle of a direction from face 0 [rad], from 0 to `exterior`."""
        found = drjit.atan2(drjit.dot(to_end, normal_0), drjit.dot(to_end, tangent))
        found = drjit.select(found < 0, found + drjit.two_pi, found)
        inside = drjit.select(found > 0.5 * (drjit.two_pi + exterior), 0.0, exterior)
        return drjit.select(found > exterior, inside, found)

    phi_in, phi = angle(-direction_in), angle(direction)
    across_in, across = drjit.cross(direction_in, along), drjit.cross(along, direction)
    sine = drjit.norm(across)
    across_in, across = drjit.normalize(across_in), drjit.normalize(across)
    after_m, before_m = si.dp_du.x, si.dp_du.y
    x = wave_number * after_m * before_m / (after_m + before_m) * drjit.square(sine)

    def reflected(angle_of_face: Any) -> tuple[Any, Any]:
        """Return the reflection coefficients TE and TM of a face at a grazing angle [rad]."""
        te, tm, *_ = itu_coefficients_single_layer_slab(
            drjit.maximum(sine * drjit.sin(angle_of_face), 1e-5), permittivity, self._d,
            drjit.two_pi / wave_number)
        specular = drjit.sqrt(1.0 - drjit.square(self._s))
        return specular * te, specular * tm

    at_0, at_n = (reflected(drjit.minimum(phi, phi_in)),
                  reflected(exterior - drjit.maximum(phi, phi_in)))
    incident = (_cotangent_term(phi - phi_in, x, n, 1) + _cotangent_term(phi - phi_in, x, n, -1))
    term_n, term_0 = (_cotangent_term(phi + phi_in, x, n, 1),
                      _cotangent_term(phi + phi_in, x, n, -1))
    # The field changes by -D: with the sign of the scale of [1, eq. 25] it is positive
    scale = drjit.exp(mitsuba.Complex2f(0, -drjit.pi / 4)) / (  # type: ignore[operator]
        2 * n * drjit.sqrt(drjit.two_pi * wave_number) * sine)
    soft, hard = (scale * (incident + face_n * term_n + face_0 * term_0)
                  for face_0, face_n in zip(at_0, at_n))

    into = jones_matrix_rotator(
        direction_in, to_world.T @ implicit_basis_vector(to_world @ direction_in), across_in)
    out_of = jones_matrix_rotator(
        direction, across, to_world.T @ implicit_basis_vector(to_world @ direction))
    real, imaginary = (out_of @ mitsuba.Matrix2f(h, 0, 0, s) @ into
                       for h, s in ((hard.real, soft.real), (hard.imag, soft.imag)))
    return jones_matrix_from_real_imag(real, imaginary)


def _cotangent_term(beta: Any, x: Any, n: Any, sign: int) -> Any:
    """Return cot((π + sign β) / 2n) F(x a(β)), a term of the wedge's coefficient [1, eq. 26-29].

    The cotangent is infinite where F is 0 (shadow boundaries): both are computed from the angle to
    the boundary, so that their product is finite.
    """
    import drjit

    turns = drjit.round((beta + sign * drjit.pi) / (drjit.two_pi * n))
    apart = drjit.pi + sign * (beta - drjit.two_pi * n * turns)
    root_of_a = drjit.sqrt(2.0) * drjit.abs(drjit.sin(0.5 * apart))
    is_near = drjit.abs(apart) < 1e-4
    ratio = drjit.select(is_near, drjit.sqrt(2.0) * n * drjit.sign(apart),
                         root_of_a / drjit.tan(drjit.select(is_near, 1.0, apart / (2 * n))))
    return drjit.sqrt(x) * ratio * _transition_over_root(drjit.sqrt(x) * root_of_a)


def _transition_over_root(root: Any) -> Any:
    """Return F(x) / √x for `root` = √x, with F the transition function [1, eq. 28]; finite at 0."""
    import drjit
    import mitsuba
    from sionna.rt.utils import f_utd

    x = drjit.square(root)
    at_boundary = drjit.sqrt(drjit.pi / 2) * mitsuba.Complex2f(1, 1)  # type: ignore[operator]
    safe = drjit.maximum(root, 1e-4)
    inverse = 1 / drjit.maximum(x, 1.0)
    series = mitsuba.Complex2f(1 - 0.75 * inverse**2, 0.5 * inverse - 1.875 * inverse**3)  # type: ignore[operator]
    found = drjit.select(x > _SERIES_FROM, series, f_utd(drjit.square(safe))) / safe
    return drjit.select(root < 1e-4, at_boundary, found)
