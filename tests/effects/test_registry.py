"""The catalogue: built-in effects, those of installed packages, and those that a script registers."""

import re
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import cloudpickle
import numpy as np
import pytest

from radiotwin.effects import GainEffect, catalogue, effect_named, register, registry
from radiotwin.errors import BadInput
from tests.worlds import city_of_boxes

NEAR_M = np.random.default_rng(0).uniform(20, 90, (100, 3))
FAR_HOUSE = {"city": city_of_boxes([[400, 400, 0], [420, 420, 30]])}


class Hail(GainEffect):
    """An effect of a package's own."""

    name = "hail"

    def gain_db(self, links):
        return np.full(len(links), -1.0)


@pytest.fixture
def installed(monkeypatch):
    """Pretend that packages declare effects: name -> class, or `module:class` to be loaded."""
    def install(**points):
        def entry_points(*, group):
            assert group == "radiotwin.effects"
            return [EntryPoint(name, effect, group) if isinstance(effect, str)
                    else SimpleNamespace(name=name, value=f"package:{name}", load=lambda effect=effect: effect)
                    for name, effect in points.items()]
        monkeypatch.setattr("radiotwin.runtime.plugins.entry_points", entry_points)
    monkeypatch.setattr(registry, "_registered", [])
    install()
    return install


@pytest.mark.filterwarnings("error")
def test_the_effect_of_a_package_is_in_the_catalogue_once(installed):
    installed(hail=Hail)
    assert catalogue() == catalogue() == (*registry.BUILT_IN, Hail)
    assert isinstance(effect_named("hail", ""), Hail)


def test_a_broken_one_warns_and_the_rest_works(installed):
    installed(broken="no_such_module:Effect", no_effect=dict, hail=Hail)
    with pytest.warns(UserWarning) as warned:
        assert catalogue()[-1] is Hail
    first, second = (str(each.message) for each in warned)
    assert "broken" in first and "no_such_module" in first and "no_effect" in second


@pytest.mark.parametrize("effect", registry.BUILT_IN, ids=lambda effect: effect.__name__)
def test_every_effect_can_be_sent_to_another_process_and_describes_its_parameters(effect):
    assert type(cloudpickle.loads(cloudpickle.dumps(effect()))) is effect
    assert all(field.description for field in effect.Params.model_fields.values())


def test_a_class_and_its_variants_are_registered_once(installed):
    assert register(Hail) is Hail and register(Hail) is Hail
    variant = register(type("LargeHail", (Hail,), {"variant": "large"}))
    assert catalogue()[-2:] == (Hail, variant)


@pytest.mark.parametrize(("thing", "why"), [
    (type("OtherHail", (Hail,), {}), "hail.*another name"), (dict, "subclass"), (Hail(), "subclass"),
    (type("Offset", (Hail,), {"name": "device_gain_offset"}), "gain_offsets")])
def test_what_is_no_effect_or_has_a_taken_name_is_refused(installed, thing, why):
    register(Hail)
    with pytest.raises(BadInput, match=why):
        register(thing)


def test_an_unknown_name_says_what_is_known(installed):
    with pytest.raises(BadInput, match="'hail'.*does not know.*antenna_pattern.*package"):
        effect_named("hail", "")


def test_the_effect_of_the_guide_works(installed, make_links):
    guide = (Path(__file__).parents[2] / "docs" / "add-an-effect.md").read_text(encoding="utf-8")
    exec(re.search(r"```python\n(.*?)```", guide, re.DOTALL)[1], {})
    effect, links = effect_named("altitude_loss", ""), make_links([[0.0, 0, 1.5]], [[0, 0, 50], [0, 0, 200]])
    (params,) = effect.propose(None)
    np.testing.assert_allclose(effect.with_params(params).term(links, None).offset_db, [-0.5, -2.0])
    variation = effect.with_params(params).variation()
    assert (variation.values, variation.low, variation.high) == (1.0, 0.0, 20.0)
    assert variation.effect(np.array([6.0])).neg_log_prior() == pytest.approx(0.5)


@pytest.mark.parametrize(("name", "why", "given"), [
    ("uncertain_sight", "no 3D map", {}),
    ("uncertain_sight", "decide over 0 links", FAR_HOUSE),
    ("roof_heights", "no 3D map", {}),
    ("building_entry", "no 3D map", {}),
    ("building_entry", "frequency", FAR_HOUSE | {"frequency_hz": np.nan}),
    ("building_entry", "0 links", FAR_HOUSE),
    ("mapped_vegetation", "the map shows no vegetation", FAR_HOUSE),
    ("ground_reflection", "frequency_hz", {"frequency_hz": np.nan}),
    ("missing_obstacle", "frequency_hz", {"frequency_hz": np.nan}),
    ("receiver_gain_offset", "two receivers", {}),
    ("receiver_drift", "time_s", {}),
    ("receiver_clock_offset", "time_s", {}),
    ("receiver_clock_offset", "moves", {"time_s": np.arange(100.0)})])
def test_what_the_links_cannot_show_is_not_looked_for(make_links, name, why, given):
    receiver_m = np.ones((100, 3)) if why == "moves" else NEAR_M
    links = make_links([[0.0, 0.0, 2.0]], receiver_m, **given)
    (effect,) = (each for each in registry.BUILT_IN if each.name == name)
    assert why in effect().unavailable(links)
