"""Saved models predict the same; damaged files are refused in one message."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from safetensors.numpy import save_file

from radiotwin.errors import BadInput
from radiotwin.propagation.laws import channel_models, load_channel, save_channel
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.map_error import MapError
from radiotwin.propagation.laws.path_kriging import PathKriging
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
    near.diffuse, near.kriging, near.weight = (-93.0, 3.5), found["regression_kriging"], np.array([0.3, 0.8])
    near.field, near.map_error = near.kriging.field, MapError((1.5, 1.0, 2.0), (0.0, 0.0, 1.0))
    return found | {network.name: network, near.name: near,
                    ImagePaths.name: ImagePaths(found["segmented_log_distance"], (-93.0, 3.5))}


@pytest.mark.parametrize("name", MODELS)
def test_predictions_survive_bit_for_bit(name, models, world, tmp_path):
    solid = trimesh.creation.box(bounds=[[200, 300, 0], [240, 360, 40]])
    links = replace(world(70, 2000).links, city=CityMap(solid.vertices, solid.faces),
                    frequency_hz=2.4e9)
    path = tmp_path / "channel.safetensors"
    save_channel(models[name], path)
    loaded = load_channel(path)
    assert type(loaded) is MODELS[name]
    assert np.array_equal(loaded.predict(links), models[name].predict(links))
    first = path.read_bytes()
    save_channel(loaded, path)
    assert path.read_bytes() == first
    assert [file.name for file in tmp_path.iterdir()] == ["channel.safetensors"]


@pytest.mark.parametrize("name", MODELS)
def test_truncated_file(name, models, tmp_path):
    path = tmp_path / "channel.safetensors"
    save_channel(models[name], path)
    whole = path.read_bytes()
    for share in (0.0, 0.3, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(BadInput, match="not a whole channel model"):
            load_channel(path)


def test_missing_file(tmp_path):
    with pytest.raises(BadInput, match="nowhere.safetensors"):
        load_channel(tmp_path / "nowhere.safetensors")


def test_a_pickle_is_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    path = tmp_path / "channel.safetensors"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(BadInput, match="not a whole channel model"):
        load_channel(path)


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
def test_another_safetensors_file(arrays, header, tmp_path):
    path = tmp_path / "channel.safetensors"
    save_file(arrays, path, header)
    with pytest.raises(BadInput, match="not a whole channel model"):
        load_channel(path)


def test_nothing_is_left_where_saving_fails(models, tmp_path, monkeypatch):
    path = tmp_path / "channel.safetensors"
    path.write_text("the old one")
    monkeypatch.setattr(
        "radiotwin.propagation.laws.registry.encode_channel", lambda *_: (_ for _ in ()).throw(OSError("disk full"))
    )
    with pytest.raises(OSError, match="disk full"):
        save_channel(models["log_distance"], path)
    assert path.read_text() == "the old one"
    assert len(list(tmp_path.iterdir())) == 1
