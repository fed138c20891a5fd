"""Saved models predict the same; damaged files are refused in one message."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from safetensors.numpy import save

from radiotwin.errors import BadInput
from radiotwin.propagation.laws import channel_models
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.map_error import MapError
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.propagation.laws.registry import decode_both, encode_channel
from radiotwin.scene.citymap import CityMap

MODELS = channel_models()

@pytest.fixture(scope="module")
def models(fitted_nn):
    """One of each kind; of those which follow paths, with laws and a diffuse power of their own."""
    network, data = fitted_nn
    house = trimesh.creation.box(bounds=[[200, 300, 0], [240, 360, 20]])
    links = replace(data.links, frequency_hz=2.4e9, city=CityMap(house.vertices, house.faces))
    found = {kind.name: kind().fit(links, data.level_db, -120.0, seed=0)
             for kind in MODELS.values() if not kind.follows_paths and kind.name != network.name}
    near = PathKriging()
    near.diffuse, near.kriging, near.weight = (-93.0, 3.5), found["kriging"], np.array([0.3, 0.8])
    near.field, near.map_error = near.kriging.field, MapError((1.5, 1.0, 2.0), (0.0, 0.0, 1.0))
    return found | {network.name: network, near.name: near,
                    ImagePaths.name: ImagePaths(found["segmented_log_distance"], (-93.0, 3.5))}


@pytest.mark.parametrize("name", MODELS)
def test_predictions_survive_bit_for_bit(name, models, world):
    solid = trimesh.creation.box(bounds=[[200, 300, 0], [240, 360, 40]])
    links = replace(world(70, 2000).links, city=CityMap(solid.vertices, solid.faces),
                    frequency_hz=2.4e9)
    stored = encode_channel(models[name])
    loaded, _ = decode_both(stored, "test")
    assert type(loaded) is MODELS[name]
    assert np.array_equal(loaded.predict(links), models[name].predict(links))
    assert encode_channel(loaded) == stored


@pytest.mark.parametrize("name", MODELS)
def test_truncated_file(name, models):
    whole = encode_channel(models[name])
    for share in (0.0, 0.3, 0.99):
        with pytest.raises(BadInput, match="not a whole channel model"):
            decode_both(whole[: int(share * len(whole))], "test")


def test_a_pickle_is_not_run():
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    with pytest.raises(BadInput, match="not a whole channel model"):
        decode_both(pickle.dumps(Trap()), "test")


@pytest.mark.parametrize(
    ("arrays", "header"),
    [
        ({"line": np.zeros(3)}, None),
        ({"line": np.zeros(3)}, {"channel": "not json"}),
        ({"line": np.zeros(3)}, {"channel": '{"model": "crystal_ball", "settings": {}}'}),
        ({"other": np.zeros(3)}, {"channel": '{"model": "log_distance", "settings": {}}'}),
        ({"line": np.zeros(2)}, {"channel": '{"model": "log_distance", "settings": {}}'}),
        ({"line": np.array([-30.0, np.nan, 1.0])}, {"channel": '{"model": "log_distance", "settings": {}}'}),
        (
            {"lines": np.zeros((2, 3))},
            {"channel": '{"model": "segmented_nn", "settings": {"borrowed": null}}'},
        ),
        ({"line": np.zeros(3)}, {"channel": "[1]"}),
    ],
)
def test_another_safetensors_file(arrays, header):
    with pytest.raises(BadInput, match="not a whole channel model"):
        decode_both(save(arrays, header), "test")
