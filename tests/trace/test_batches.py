"""Batches on disk."""

import os
import shutil

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.trace.link_job import BatchStore, LinkBatch


def piece(name, size):
    return LinkBatch(name, np.zeros(3), np.zeros((size, 3)), (None, None), size)


def put(store, name, array):
    store.put(piece(name, len(array)), array, [], 0.0)


def test_a_batch_comes_back_to_the_bit_for_its_own_key(tmp_path):
    array = np.random.default_rng(0).normal(size=7)
    array[3] = np.nan
    put(BatchStore(tmp_path, {"a": 1}), "batch", array)
    assert BatchStore(tmp_path, {"a": 1}).get(piece("batch", 7))[0].tobytes() == array.tobytes()
    assert BatchStore(tmp_path, {"a": 2}).get(piece("batch", 7)) is None


def test_a_link_out_of_the_scene_is_refused_before_anything_is_written(tmp_path):
    scene, outside = tmp_path / "scene", tmp_path / "outside"
    outside.mkdir()
    own = BatchStore(scene, {"a": 1}).folder
    shutil.rmtree(own)
    own.symlink_to(outside)
    with pytest.raises(BadInput, match="leads out of"):
        BatchStore(scene, {"a": 1})
    assert not list(outside.iterdir())


SPOIL = {
    "empty": lambda path, data: path.write_bytes(b""), "no array": lambda path, data: path.write_bytes(b"no array"),
    "short": lambda path, data: path.write_bytes(data[:-1]),
    "huge": lambda path, data: path.write_bytes(data.replace(b"(4,)", b"(4000000000000,)")),
    "integers": lambda path, data: np.save(path, np.arange(4)),
    "pickle": lambda path, data: np.save(path, np.array([{}] * 4), allow_pickle=True),
    "pipe": lambda path, data: os.mkfifo(path), "folder": lambda path, data: path.mkdir()}


@pytest.mark.parametrize("spoil", SPOIL)
def test_a_damaged_batch_or_one_of_a_stranger_counts_as_missing(tmp_path, spoil):
    store = BatchStore(tmp_path, {"a": 1})
    put(store, "b", np.arange(4.0))
    path = store.folder / "b.npy"
    data = path.read_bytes()
    path.unlink()
    SPOIL[spoil](path, data)
    assert store.get(piece("b", 4)) is None
