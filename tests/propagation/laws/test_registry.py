"""Channel models: built-in ones, those of installed packages, and those that a script registers."""

import re
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.propagation.laws import (
    channel_models,
    channel_named,
    register,
    registry,
)
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.propagation.laws.registry import decode_both, encode_channel


class Rural(LogDistance):
    """A channel model of a package's own."""

    name = "rural"


@pytest.fixture
def installed(monkeypatch):
    """Pretend that packages declare models: name -> class, or `module:class` to be loaded."""
    def install(**points):
        def entry_points(*, group):
            assert group == "radiotwin.channels"
            return [EntryPoint(name, model, group) if isinstance(model, str)
                    else SimpleNamespace(name=name, value=f"package:{name}", load=lambda model=model: model)
                    for name, model in points.items()]
        monkeypatch.setattr("radiotwin.runtime.plugins.entry_points", entry_points)
    monkeypatch.setattr(registry, "_registered", {})
    install()
    return install


@pytest.mark.filterwarnings("error")
def test_the_model_of_a_package_is_known_once(installed):
    built_in = [each.name for each in registry.BUILT_IN]
    assert list(channel_models()) == built_in
    installed(rural=Rural)
    assert list(channel_models()) == list(channel_models()) == [*built_in, "rural"]
    assert channel_named("rural") is Rural


def test_a_broken_one_warns_and_the_rest_works(installed, world, tmp_path):
    installed(broken="no_such_module:Model", no_model=dict, rural=Rural)
    with pytest.warns(UserWarning) as warned:
        assert channel_named("rural") is Rural
    first, second = (str(each.message) for each in warned)
    assert "broken" in first and "no_such_module" in first and "no_model" in second
    data = world(0, 100)
    stored = encode_channel(Rural().fit(data.links, data.level_db, None))
    with pytest.warns(UserWarning):
        assert type(decode_both(stored, "test")[0]) is Rural


def test_what_cannot_be_registered_or_found_is_refused(installed):
    assert register(Rural) is Rural and register(Rural) is Rural
    with pytest.raises(BadInput, match="rural.*another name"):
        register(type("OtherRural", (Rural,), {}))
    with pytest.raises(BadInput, match=r"log_distance.*radiotwin\.propagation\.laws\.log_distance"):
        register(type("Law", (Rural,), {"name": "log_distance"}))
    assert channel_named("log_distance") is LogDistance and channel_named("rural") is Rural
    for thing in (dict, Rural()):
        with pytest.raises(BadInput, match="subclass"):
            register(thing)
    with pytest.raises(BadInput, match="'urban' is unknown.*log_distance.*paths"):
        channel_named("urban")


def test_the_model_of_the_guide_works(installed, world, tmp_path):
    guide = (Path(__file__).parents[3] / "docs" / "add-a-channel-model.md").read_text(encoding="utf-8")
    exec(re.search(r"```python\n(.*?)```", guide, re.DOTALL)[1], {"__name__": "guide"})
    limit_db = -95.0  # a third of the links is below it
    data = world(0, 1000, limit_db, law=lambda distance_m, los, elevation_rad: -40 - 20 * np.log10(distance_m))
    assert 0.1 < np.isnan(data.level_db).mean() < 0.5
    model = channel_named("free_space")().fit(data.links, data.level_db, limit_db)
    assert model.parameters == pytest.approx([-40.0, 2.0], abs=0.3)
    mean_db, sd_db = model.predict(data.links)
    assert np.abs(mean_db - data.mean_db).max() < 0.3 and mean_db.shape == sd_db.shape == (1000,)
    stored = encode_channel(model)
    loaded, _ = decode_both(stored, "test")
    np.testing.assert_array_equal(loaded.predict(data.links), model.predict(data.links))
    installed()
    registry._registered.clear()
    with pytest.raises(BadInput, match="free_space"):
        decode_both(stored, "test")
