"""Notes on levels that are probably not what they seem to be."""

import numpy as np
import pytest

from radiotwin.links.checks import ceiling_notes


def readings(seed, step_db, highest_db=np.inf, n=900):
    """Return levels of two receivers, the second of which reads no more than some level."""
    rng = np.random.default_rng(seed)
    receiver = rng.integers(0, 2, n)
    level_db = rng.normal(-85, 10, n)
    level_db = np.where(receiver == 1, np.minimum(level_db, highest_db), level_db)
    level_db[rng.random(n) < 0.1] = np.nan
    return receiver, np.round(level_db / step_db) * step_db


@pytest.mark.parametrize("step_db", [0.01, 1.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_receiver_that_reads_no_more_than_some_level_is_told(seed, step_db):
    receiver, level_db = readings(seed, step_db, highest_db=-90.0)
    (note,) = ceiling_notes(receiver, ["good", "deaf"], level_db)
    share = (level_db[receiver == 1] == -90).sum() / np.isfinite(level_db[receiver == 1]).sum()
    assert f"of receiver deaf ({share:.0%} at -90): nothing higher is read" in note


@pytest.mark.parametrize("step_db", [0.01, 1.0, 3.0, 10.0])
def test_a_tail_is_no_ceiling(step_db):
    for seed in range(20):
        receiver, level_db = readings(seed, step_db)
        assert ceiling_notes(receiver, ["a", "b"], level_db) == []
