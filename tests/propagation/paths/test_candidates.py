"""Candidates of devices are found once, by one thread or several."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, BrokenBarrierError

import numpy as np
import pytest

from radiotwin.propagation.paths import candidates as module
from radiotwin.propagation.paths.candidates import CandidateSearch


@pytest.fixture
def device_m():
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-20, 70, (6, 2)), rng.uniform(25, 40, 6)])


def same(found, expected):
    return all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))


def test_threads_find_what_one_alone_finds(town, device_m, monkeypatch):
    """What is around edges is written by one thread at a time: no two ever meet there."""
    alone = CandidateSearch(town(0.2), 2)
    expected = [alone.candidates(each_m) for each_m in device_m]
    meeting, met = Barrier(2, timeout=0.3), []

    def watched(*args):
        try:
            met.append(meeting.wait())
        except BrokenBarrierError:
            meeting.reset()
        return look_around(*args)

    look_around = module._edge_sequences
    monkeypatch.setattr(module, "_edge_sequences", watched)
    shared = CandidateSearch(town(0.2), 2)
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(shared.candidates, device_m))
    assert not met and all(same(*pair) for pair in zip(found, expected, strict=True))


def test_remembered_ones_are_bounded_and_the_oldest_are_found_anew(town, device_m, monkeypatch):
    search = CandidateSearch(town(0.2), 2)
    first = search.candidates(device_m[0])
    assert search.candidates(device_m[0].copy()) is first
    monkeypatch.setattr(module, "MAX_REMEMBERED_BYTES", 3 * sum(each.nbytes for each in first))
    for each_m in device_m:
        search.candidates(each_m)
    assert search.candidates(device_m[-1]) is search.candidates(device_m[-1])
    again = search.candidates(device_m[0])
    assert again is not first and same(again, first)
