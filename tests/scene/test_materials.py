import math

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.materials import (
    ITU_TABLE,
    Material,
    itu_material,
    itu_name,
    permittivity,
    traceable,
)


def test_concrete_at_2_4_ghz():
    epsilon, sigma, in_range = permittivity("concrete", 2.4e9)
    assert epsilon == 5.24 and in_range
    assert sigma == pytest.approx(0.0462 * math.exp(0.7822 * math.log(2.4)))


def test_permittivity_of_ground_falls_with_frequency():
    assert permittivity("itu_wet_ground", 5e9)[0] == pytest.approx(30 / 5**0.4)


@pytest.mark.parametrize(
    "frequency_ghz, end_ghz, row",
    [
        (0.2, 1, (3.91, 0.0238, 0.16)),
        (60, 40, (3.91, 0.0238, 0.16)),
        (100, 110, (4.15, 0.0006, 1.5712)),
        (400, 330, (4.15, 0.0006, 1.5712)),
    ],
)
def test_out_of_range_is_taken_at_the_nearest_end(frequency_ghz, end_ghz, row):
    a, c, d = row
    assert permittivity("brick", frequency_ghz * 1e9) == (a, pytest.approx(c * end_ghz**d), False)


@pytest.mark.parametrize("text", ["mat-itu_metal", "itu_metal", "itu-metal", "metal", "mat-metal"])
def test_all_forms_of_a_name(text):
    assert itu_name(text) == "metal"


def test_unknown_material_names_the_known_ones():
    with pytest.raises(BadInput, match="'cheese'.*concrete.*wet_ground"):
        itu_material("cheese")


@pytest.mark.parametrize("frequency_hz", [0.0, -1e9, float("nan")])
def test_impossible_frequency(frequency_hz):
    with pytest.raises(BadInput, match="positive frequency"):
        permittivity("concrete", frequency_hz)


def test_traceable_keeps_what_sionna_can_load():
    material = itu_material("concrete")
    assert traceable(material, 2.4e9) is material
    own = Material("own", relative_permittivity=3.0, conductivity_s_per_m=0.1)
    assert traceable(own, 1e6) is own


def test_traceable_freezes_what_sionna_refuses():
    fixed = traceable(itu_material("concrete", thickness_m=0.3), 868e6)
    assert fixed.itu is None and fixed.thickness_m == 0.3
    assert (fixed.relative_permittivity, fixed.conductivity_s_per_m) == (5.24, 0.0462)
    assert traceable(itu_material("floorboard"), 60e9).itu is None  # in range, but not at 3.5 GHz


@pytest.mark.llvm
def test_table_equals_sionna():
    """Rationale: a report must show the constants that are traced.

    Expected: every material of Sionna RT is here, in range at the same frequencies, with equal constants.
    """
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES
    from sionna.rt.radio_materials.itu import itu_material as sionna_material

    assert set(ITU_MATERIALS_PROPERTIES) == set(ITU_TABLE)
    for name in ITU_TABLE:
        for frequency_hz in np.geomspace(1e6, 460e9, 60):
            epsilon, sigma, in_range = permittivity(name, frequency_hz)
            try:
                expected = [float(value) for value in sionna_material(name, frequency_hz)]
            except ValueError:
                assert not in_range, (name, frequency_hz)
            else:
                assert in_range, (name, frequency_hz)
                assert [epsilon, sigma] == pytest.approx(expected, rel=1e-4)
