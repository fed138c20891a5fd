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


@pytest.mark.parametrize("effect", registry.BUILT_IN, ids=lambda effect: f"{effect.name}-{effect.variant}")
def test_every_effect_can_be_sent_to_another_process(effect):
    assert type(cloudpickle.loads(cloudpickle.dumps(effect()))) is effect


def test_a_taken_name_is_refused(installed):
    assert register(Hail) is Hail and register(Hail) is Hail
    other = type("OtherHail", (Hail,), {})
    with pytest.raises(BadInput, match="hail.*another name"):
        register(other)
    variant = register(type("LargeHail", (Hail,), {"variant": "large"}))
    assert catalogue()[-2:] == (Hail, variant)
    with pytest.raises(BadInput, match="gain_offsets"):
        register(type("Offset", (Hail,), {"name": "device_gain_offset"}))


def test_what_is_no_effect_is_refused(installed):
    for thing in (dict, Hail()):
        with pytest.raises(BadInput, match="subclass"):
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


@pytest.mark.parametrize("effect", registry.BUILT_IN, ids=lambda effect: effect.__name__)
def test_every_parameter_has_a_description(effect):
    assert all(field.description for field in effect.Params.model_fields.values())
