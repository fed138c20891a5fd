"""Settings that make no sense are refused before anything starts; what a map's key holds of them."""

import pytest

from radiotwin.errors import BadInput
from radiotwin.trace import SolverSettings, mended


@pytest.mark.parametrize("settings, message", [
    ({"solver": "magic"}, "solver"), ({"combining": "sum"}, "combining"), ({"max_depth": -1}, "max_depth"),
    ({"seed": -1}, "seed"), ({"samples_per_src": 0}, "samples_per_src"), ({"batch_receivers": 0}, "batch_receivers"),
    ({"solver": "map", "combining": "coherent"}, "combining"), ({"solver": "map", "radius_m": 50.0}, "radius_m = 50"),
    *[({"radius_m": radius_m}, "allowed is a length above 0 m, or inf") for radius_m in (0.0, float("nan"))]])
def test_impossible_settings(settings, message):
    with pytest.raises(BadInput, match=message):
        SolverSettings(**settings)


def test_unknown_quality_names_those_there_are():
    with pytest.raises(BadInput, match="fast, default, high"):
        SolverSettings.of_quality("best")


def test_finer_settings_take_no_more_memory():
    settings = SolverSettings()
    finer = settings.finer(10)
    assert finer.samples_per_src == 10 * settings.samples_per_src
    assert finer.samples_per_src * finer.batch_receivers <= settings.samples_per_src * settings.batch_receivers


def test_another_version_is_used_as_it_is_with_a_warning(monkeypatch):
    monkeypatch.setattr(mended, "installed_version", lambda: "2.3.0")
    with pytest.warns(UserWarning, match=r"Sionna RT 2\.3\.0 is installed.*known for 2\.2\.0 only"):
        assert SolverSettings().diffraction == "sionna"
    with pytest.raises(BadInput, match=r"'reciprocal' mends Sionna RT 2\.2\.0, and 2\.3\.0 is installed; take"):
        SolverSettings(diffraction="reciprocal")


def test_what_earlier_versions_kept_stays_valid():
    """A whole city has no radius in its key, and only mended diffraction has a wedge."""
    assert "radius_m" not in SolverSettings().attributes()
    assert SolverSettings(radius_m=float("inf")).attributes() == SolverSettings().attributes()
    assert SolverSettings(radius_m=100.0).attributes()["radius_m"] == 100.0
    for name, number, wedge in (("reciprocal", 1, "reciprocal"), ("sionna", 1, None), ("off", 0, None)):
        attributes = SolverSettings(diffraction=name).attributes()
        assert attributes["diffraction"] == number and attributes.get("wedge") == wedge
