"""Checkpoints hold what they were given, and are data only."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from marl.checkpoint import load_checkpoint, save_checkpoint
from radiotwin.errors import BadInput
from radiotwin.io.array_file import pack_arrays


def test_every_type_of_value_comes_back(tmp_path):
    rng = np.random.default_rng(3)
    rng.random(5)
    state = {
        "rng": rng.bit_generator.state, "rows": [{"ratio": 0.1 + 0.2, "round": 3, "nothing": float("nan")}],
        "array": np.arange(6, dtype=np.int16).reshape(2, 3), "mask": np.array([True, False]), "none": None,
        "empty": np.zeros((0, 3), np.float32), "scalar": np.float64(0.1), "number": -np.inf,
        "tensor": torch.ones(2), "tables": [pd.DataFrame({"x_m": [0.1, np.nan], "device": ["d0", "d1"]})]}
    save_checkpoint(state, tmp_path / "state")
    back = load_checkpoint(tmp_path / "state")
    again = np.random.default_rng()
    again.bit_generator.state = back["rng"]
    assert again.random() == rng.random()
    assert back["rows"][0]["ratio"] == 0.1 + 0.2 and np.isnan(back["rows"][0]["nothing"])
    np.testing.assert_array_equal(back["array"], state["array"])
    assert back["array"].dtype == np.int16 and back["mask"].dtype == bool and back["none"] is None
    assert back["empty"].shape == (0, 3) and back["scalar"] == 0.1 and back["number"] == -np.inf
    assert torch.equal(back["tensor"], state["tensor"])
    pd.testing.assert_frame_equal(back["tables"][0], state["tables"][0], check_dtype=False)


def test_a_damaged_checkpoint_is_bad_input(tmp_path):
    path = tmp_path / "state"
    save_checkpoint({"a": np.zeros(1000), "b": [1]}, path)
    whole = path.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.99):
        path.write_bytes(whole[:int(share * len(whole))])
        with pytest.raises(BadInput, match="damaged"):
            load_checkpoint(path)


@pytest.mark.parametrize("text", [
    "[]", "{", '{"format": 6}', '{"format": 6, "state": 3}', '{"format": 6, "state": {"$array": "7"}}',
    '{"format": 6, "state": {"a": {"$number": "many"}}}', '{"format": 6, "state": {"a": {"$array": ["0"]}}}',
    '{"format": 6, "state": {"a": {"$table": 3}}}', '{"format": 6, "state": {}}',
    '{"format": 6, "state": {"a": ' + "[" * 5000 + "]" * 5000 + "}}", '{"format": 6, "state": {"a": ' + "9" * 5000 + "}}"])
def test_a_document_that_makes_no_sense_is_one_message(text, tmp_path):
    (tmp_path / "state").write_bytes(pack_arrays({"0": np.zeros(3)}, "checkpoint", text))
    with pytest.raises(BadInput, match="state"):
        load_checkpoint(tmp_path / "state")


def test_a_pickle_is_not_run(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (pytest.fail, ("executed",))

    torch.save({"a": Harmful()}, tmp_path / "state")
    with pytest.raises(BadInput, match="damaged"):
        load_checkpoint(tmp_path / "state")


def test_a_checkpoint_of_another_version_is_refused(tmp_path):
    (tmp_path / "state").write_bytes(pack_arrays({}, "checkpoint", json.dumps({"format": 99, "state": {}})))
    with pytest.raises(BadInput, match="another version.*start again"):
        load_checkpoint(tmp_path / "state")
