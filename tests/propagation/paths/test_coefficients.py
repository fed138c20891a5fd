"""Coefficients against their limits and against exact integrals."""

import numpy as np
import pytest

from radiotwin.propagation.paths.interactions import (
    face_sines,
    fresnel,
    reflection,
    slabs_of,
    transition,
    wedge_coefficients,
)
from radiotwin.scene.materials import Material, itu_material
from tests.propagation import wedges

CONCRETE = slabs_of([itu_material("concrete", thickness_m=0.1)], 2.4e9)
CONDUCTOR = slabs_of([itu_material("metal")], 2.4e9)
WAVE_NUMBER = 2 * np.pi * 2.4e9 / 299_792_458.0


def test_concrete_at_one_gigahertz_and_below():
    """P.2040, eq. 9b; below its range a material has the constants of its end."""
    below, end = (slabs_of([itu_material("concrete")], frequency_hz).permittivity[0] for frequency_hz in (0.9e9, 1e9))
    assert end.real == 5.24 and end.imag == pytest.approx(-17.98 * 0.0462, rel=1e-3)
    assert below.real == end.real and below.imag * 0.9 == pytest.approx(end.imag)  # of one conductivity


def test_fresnel_straight_on_and_grazing():
    te, tm = fresnel(1.0, complex(4, 0))
    assert te == pytest.approx(-1 / 3) and tm == pytest.approx(1 / 3)
    assert np.allclose(fresnel(0.0, complex(5, -0.3)), -1)
    assert abs(fresnel(np.sin(np.arctan(1 / 2)), complex(4, 0))[1]) < 1e-12  # Brewster's angle


@pytest.mark.parametrize("x", [0.0, 0.01, 0.5, 3.0, 4.8, 4.9, 10.0, 29.9, 30.1, 500.0])
def test_transition_function(x):
    assert transition(x) == pytest.approx(wedges.transition(x), abs=2e-5)


def slab(permittivity, conductivity_s_per_m=0.0, thickness_m=0.1, frequency_hz=2.4e9, **others):
    return slabs_of([Material("slab", None, permittivity, conductivity_s_per_m, thickness_m, **others)], frequency_hz)


@pytest.mark.parametrize("sine", [0.01, 0.2, 0.7, 0.99])
@pytest.mark.parametrize("thickness_m", [0.002, 0.1, 0.37])
def test_a_slab_is_a_line_that_ends_in_free_space(line_of_slab, sine, thickness_m):
    ours = reflection(sine, slab(6.31, 0.0117, thickness_m), 0)
    assert ours == pytest.approx(line_of_slab(sine, 6.31, 0.0117, thickness_m), rel=1e-9)


def test_no_slab_reflects_more_than_all_and_none_of_no_thickness():
    rng = np.random.default_rng(0)
    for _ in range(500):
        any_slab = slab(1 + 10 ** rng.uniform(-2, 2), 10 ** rng.uniform(-4, 7), 10 ** rng.uniform(-3, 1))
        assert np.abs(reflection(rng.uniform(0, 1), any_slab, 0)).max() <= 1 + 1e-9
    assert reflection(0.4, slab(5.0, 0.1, thickness_m=0.0), 0) == (0, 0)
    assert np.allclose(reflection(0.0, CONCRETE, 0), -1)


def wedge(phi, phi_in, sine_edge, distance_m, n, slabs):
    faces = [reflection(sine, slabs, 0) for sine in face_sines(phi, phi_in, sine_edge, n)]
    return wedge_coefficients(phi, phi_in, sine_edge, distance_m, WAVE_NUMBER, n, *faces)


def field(phi, phi_in, n, slabs, soft):
    """Direct, reflected and diffracted field of a line source's ray across a wedge, over that of free space."""
    before_m, after_m = 40.0, 70.0
    row = 0 if soft else 1
    total = wedge(phi, phi_in, 1.0, before_m * after_m / (before_m + after_m), n, slabs)[row] \
        / np.sqrt(before_m * after_m * (before_m + after_m))
    total *= np.exp(-1j * WAVE_NUMBER * (before_m + after_m))
    for seen, angle in ((phi < np.pi + phi_in, phi - phi_in), (phi < np.pi - phi_in, phi + phi_in)):
        if seen:
            length_m = np.sqrt(before_m ** 2 + after_m ** 2 - 2 * before_m * after_m * np.cos(angle))
            image = 1.0
            if angle == phi + phi_in:
                sine = before_m * np.sin(phi_in) / length_m + after_m * np.sin(phi) / length_m
                image = reflection(sine, slabs, 0)[row]
            total += image * np.exp(-1j * WAVE_NUMBER * length_m) / length_m
    return total * (before_m + after_m)


@pytest.mark.parametrize("slabs", [CONDUCTOR, CONCRETE])
@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("n", [1.5, 1.25, 2.0])
def test_the_field_has_no_step_at_the_boundaries(slabs, soft, n):
    phi_in = 0.5
    for boundary in (np.pi + phi_in, np.pi - phi_in):
        # Across the boundary, and from its limiting form to the full one.
        for low, high in ((-1e-7, 1e-7), (0.99e-5, 1.01e-5), (-1.01e-5, -0.99e-5)):
            before, after = (field(boundary + step, phi_in, n, slabs, soft) for step in (low, high))
            assert abs(before - after) < 2e-3
    at_shadow = wedge(np.pi + phi_in + 1e-7, phi_in, 1.0, 25.0, n, slabs)
    assert np.allclose(np.abs(at_shadow) / np.sqrt(25.0), 0.5, atol=0.06)  # half the free-space field
    there, back = (wedge(*angles, 0.8, 30.0, n, slabs) for angles in ((4.1, 0.7), (0.7, 4.1)))
    turned = wedge(n * np.pi - 0.7, n * np.pi - 4.1, 0.8, 30.0, n, slabs)  # angles from the other face
    assert np.allclose(there, back) and np.allclose(there, turned)
