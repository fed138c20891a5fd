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


def test_array_comes_back_to_the_bit(tmp_path):
    array = np.random.default_rng(0).normal(size=7)
    array[3] = np.nan
    put(BatchStore(tmp_path, {"a": 1}), "batch", array)
    assert BatchStore(tmp_path, {"a": 1}).get(piece("batch", 7))[0].tobytes() == array.tobytes()


def test_keys_do_not_see_each_other(tmp_path):
    put(BatchStore(tmp_path, {"a": 1}), "batch", np.zeros(3))
    assert BatchStore(tmp_path, {"a": 2}).get(piece("batch", 3)) is None
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_link_out_of_the_scene_is_refused_before_anything_is_written(tmp_path):
    scene, outside = tmp_path / "scene", tmp_path / "outside"
    outside.mkdir()
    own = BatchStore(scene, {"a": 1}).folder
    shutil.rmtree(own)
    own.symlink_to(outside)
    with pytest.raises(BadInput, match="leads out of"):
        BatchStore(scene, {"a": 1})
    assert not list(outside.iterdir())


@pytest.mark.parametrize("spoil", [b"", b"\x93NUMPY\x01", b"no array", "zip", "pickle", "huge", "int", "short", "pipe", "folder"])
def test_a_damaged_batch_or_one_of_a_stranger_counts_as_missing(tmp_path, spoil):
    store = BatchStore(tmp_path, {"a": 1})
    put(store, "b", np.arange(4.0))
    path = store.folder / "b.npy"
    data = path.read_bytes()
    path.unlink()
    if isinstance(spoil, bytes):
        path.write_bytes(spoil)
    elif spoil == "zip":
        np.savez(path.with_suffix(".npz"), np.arange(4.0))
        path.with_suffix(".npz").rename(path)
    elif spoil == "pickle":
        np.save(path, np.array([{}] * 4), allow_pickle=True)
    elif spoil == "huge":
        path.write_bytes(data.replace(b"(4,)", b"(4000000000000,)"))
    elif spoil == "int":
        np.save(path, np.arange(4))
    elif spoil == "short":
        path.write_bytes(data[:-1])
    elif spoil == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    assert store.get(piece("b", 4)) is None
