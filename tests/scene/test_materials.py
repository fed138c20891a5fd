
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


@pytest.mark.parametrize(("name", "frequency_ghz", "at_ghz", "row"), [
    ("concrete", 2.4, 2.4, (5.24, 0, 0.0462, 0.7822)), ("itu_wet_ground", 5, 5, (30, -0.4, 0.15, 1.3)),
    ("brick", 0.2, 1, (3.91, 0, 0.0238, 0.16)), ("brick", 60, 40, (3.91, 0, 0.0238, 0.16)),
    ("brick", 100, 110, (4.15, 0, 0.0006, 1.5712)), ("brick", 400, 330, (4.15, 0, 0.0006, 1.5712))])
def test_constants_follow_the_table_and_out_of_range_its_nearest_end(name, frequency_ghz, at_ghz, row):
    a, b, c, d = row
    assert permittivity(name, frequency_ghz * 1e9) == (
        pytest.approx(a * at_ghz**b), pytest.approx(c * at_ghz**d), at_ghz == frequency_ghz)


@pytest.mark.parametrize("text", ["mat-itu_metal", "itu_metal", "itu-metal", "metal", "mat-metal"])
def test_all_forms_of_a_name(text):
    assert itu_name(text) == "metal"


@pytest.mark.parametrize(("name", "frequency_hz", "message"), [
    ("concrete", 0.0, "positive frequency"), ("concrete", -1e9, "positive frequency"),
    ("concrete", float("nan"), "positive frequency"), ("cheese", 1e9, "'cheese'.*concrete.*wet_ground")])
def test_impossible_materials_and_frequencies(name, frequency_hz, message):
    with pytest.raises(BadInput, match=message):
        permittivity(name, frequency_hz)


def test_traceable_freezes_what_sionna_refuses():
    assert traceable(itu_material("concrete"), 2.4e9) == itu_material("concrete")
    own = Material("own", relative_permittivity=3.0, conductivity_s_per_m=0.1)
    assert traceable(own, 1e6) is own
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
