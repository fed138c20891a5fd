"""Checkpoints hold what they were given."""

import numpy as np
import pandas as pd
import pytest
import torch

from marl.checkpoint import folder_content, load_checkpoint, restore_folder, save_checkpoint
from radiotwin.errors import BadInput


def test_every_type_of_value_comes_back(tmp_path):
    rng = np.random.default_rng(3)
    rng.random(5)
    state = {
        "rng": rng.bit_generator.state, "rows": [{"ratio": 0.1 + 0.2, "round": 3, "nothing": float("nan")}],
        "array": np.arange(6, dtype=np.int16).reshape(2, 3), "mask": np.array([True, False]), "none": None,
        "tensor": torch.ones(2), "tables": [pd.DataFrame({"x_m": [0.1, np.nan], "device": ["d0", "d1"]})]}
    save_checkpoint(state, tmp_path / "state.pt")
    back = load_checkpoint(tmp_path / "state.pt")
    again = np.random.default_rng()
    again.bit_generator.state = back["rng"]
    assert again.random() == rng.random()
    assert back["rows"][0]["ratio"] == 0.1 + 0.2 and np.isnan(back["rows"][0]["nothing"])
    np.testing.assert_array_equal(back["array"], state["array"])
    assert back["array"].dtype == np.int16 and back["mask"].dtype == bool and back["none"] is None
    assert torch.equal(back["tensor"], state["tensor"])
    pd.testing.assert_frame_equal(back["tables"][0], state["tables"][0], check_dtype=False)


def test_a_damaged_checkpoint_is_bad_input(tmp_path):
    path = tmp_path / "state.pt"
    save_checkpoint({"a": np.zeros(1000)}, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(BadInput, match="damaged"):
        load_checkpoint(path)


def test_no_code_is_executed_on_reading(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (print, ("executed",))

    torch.save({"a": Harmful()}, tmp_path / "state.pt")
    with pytest.raises(BadInput, match="damaged"):
        load_checkpoint(tmp_path / "state.pt")


def test_a_folder_comes_back(tmp_path):
    (tmp_path / "twin").mkdir()
    (tmp_path / "twin" / "a.json").write_text("{}")
    (tmp_path / "twin" / "b.bin").write_bytes(bytes(range(256)))
    content = folder_content(tmp_path / "twin")
    restore_folder(content, tmp_path / "other")
    assert (tmp_path / "other" / "b.bin").read_bytes() == bytes(range(256))
    assert (tmp_path / "other" / "a.json").read_text() == "{}"


def test_a_checkpoint_of_another_version_is_refused(tmp_path):
    torch.save({"rows": []}, tmp_path / "state.pt")
    with pytest.raises(BadInput, match="another version.*start again"):
        load_checkpoint(tmp_path / "state.pt")
