"""What the training of the ensemble must not touch."""

import numpy as np
import pytest
import torch

from radiotwin.propagation.laws import segmented_nn as ensemble


def test_thread_count_comes_back_even_after_an_error():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyError), ensemble.one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_global_random_states_are_left_alone(world, monkeypatch):
    from radiotwin.propagation.laws.segmented_nn import SegmentedNN

    monkeypatch.setattr(ensemble, "STEPS", 40)
    data = world(0, 60)
    torch_before, numpy_before = torch.random.get_rng_state(), np.random.get_state()[1].copy()
    SegmentedNN().fit(data.links, data.level_db, None, seed=3)
    assert torch.equal(torch_before, torch.random.get_rng_state())
    assert np.array_equal(numpy_before, np.random.get_state()[1])
