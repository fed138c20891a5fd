"""Finished parts on disk: what comes back, what counts as damaged, and how much is kept."""

import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.io import signals as interruption
from radiotwin.runtime import pieces
from radiotwin.runtime.pieces import PieceStore, cached, keep_pieces, pieces_folder


@pytest.fixture(autouse=True)
def keep_all(monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)


class Work:
    """A function that counts its calls."""

    def __init__(self, value=None, message=None):
        self.calls, self.message = 0, message
        self.value = np.array([1.5, np.nan, -0.0]) if value is None else value

    def __call__(self):
        self.calls += 1
        if self.message:
            warnings.warn(self.message)
        return self.value

    def cached(self, *inputs):
        return cached("work", inputs, self, lambda value: ({"value": value}, {"size": len(value)}), self.read)

    def read(self, arrays, content):
        if content["size"] != len(arrays["value"]):
            raise ValueError("another size")
        return arrays["value"]


def test_a_part_is_made_once_and_comes_back_to_the_bit():
    work = Work()
    for expected in (0, 1):
        with keep_pieces() as store:
            assert work.cached(1, "a").tobytes() == work.value.tobytes()
        assert store.earlier == expected and store.made == 1 - expected
    assert work.calls == 1
    assert store.progress == "1 of 1 parts were kept from an earlier run"


@pytest.mark.parametrize("inputs, calls, files", [
    ([(1,), (2,), (1, 2), ("1",)], 4, 4), ([(1,), (1,)], 1, 1), ([(object(),), (object(),)], 2, 0)])
def test_other_inputs_are_another_part_and_unknown_ones_are_not_kept(inputs, calls, files):
    work = Work()
    with keep_pieces() as store:
        for each in inputs:
            work.cached(*each)
    assert work.calls == calls and len(store.files()) == files and store.progress == ""


def test_other_code_or_libraries_make_another_part(monkeypatch):
    work = Work()
    with keep_pieces():
        work.cached(1)
        monkeypatch.setattr(pieces, "versions", lambda: ("changed",))
        work.cached(1)
    assert work.calls == 2


def test_nothing_is_kept_where_nobody_asks_for_it(own_cache):
    work = Work()
    work.cached(1), work.cached(1)
    assert work.calls == 2 and not own_cache.exists()


def test_quick_parts_are_not_written(monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 5.0)
    with keep_pieces() as store:
        Work().cached(1)
    assert store.made == 1 and not store.files()


@pytest.mark.parametrize("spoil", [
    lambda data: b"", lambda data: data[:len(data) // 2], lambda data: data[:-1], lambda data: b"\x80\x04]\x94." * 50,
    lambda data: data.replace(b'"size": 3', b'"size": 4'), lambda data: bytes(byte ^ 1 for byte in data),
    lambda data: data[:150] + bytes([data[150] ^ 4]) + data[151:]])
def test_a_damaged_part_is_made_again(spoil):
    work = Work()
    with keep_pieces() as store:
        work.cached(1)
    ((_, _, path),) = store.files()
    whole = path.read_bytes()
    path.write_bytes(spoil(whole))
    for calls in (2, 2):
        with keep_pieces():
            assert work.cached(1).tobytes() == work.value.tobytes()
        assert work.calls == calls and path.read_bytes() == whole


def test_a_pickle_is_never_read(tmp_path):
    """Rationale: numpy would run what a pickled object says."""
    store = PieceStore(tmp_path)
    np.savez(tmp_path / "work-1.npz", value=np.array([{"a": 1}], dtype=object), _json=np.zeros(1, np.uint8))
    assert store.get("work-1", lambda arrays, content: arrays) is None


def test_a_large_or_packed_part_is_not_read(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "work-1.npz", _json=np.frombuffer(b"[null, []]", np.uint8), zeros=np.zeros(10**6))
    assert PieceStore(tmp_path).get("work-1", lambda arrays, content: arrays) is None
    np.savez(tmp_path / "work-2.npz", _json=np.frombuffer(b"[null, []]", np.uint8), zeros=np.zeros(10**3))
    assert PieceStore(tmp_path).get("work-2", lambda arrays, content: arrays) is not None
    monkeypatch.setenv("RADIOTWIN_MAX_PIECE_BYTES", "8000")
    assert PieceStore(tmp_path).get("work-2", lambda arrays, content: arrays) is None


def test_warnings_come_again_with_the_part():
    work = Work(message="only 3 links")
    for _ in range(2):
        with keep_pieces(), pytest.warns(UserWarning, match="only 3 links") as caught:
            work.cached(1), work.cached(1)
        assert len(caught) == 1


def test_an_error_is_not_kept():
    def fail():
        raise BadInput("nothing detected")
    with keep_pieces() as store, pytest.raises(BadInput, match="nothing detected"):
        cached("work", (1,), fail, lambda value: ({}, None), lambda arrays, content: None)
    assert not store.files()


def test_a_folder_that_cannot_be_written_is_one_warning(own_cache):
    own_cache.write_text("a file")
    work = Work()
    with keep_pieces(), pytest.warns(UserWarning, match="finished parts are not kept: cannot write") as caught:
        assert work.cached(1) is work.value
        assert work.cached(2) is work.value
    assert len(caught) == 1


def test_the_oldest_parts_give_way(monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_CACHE_BYTES", "100_000")
    work = Work(np.zeros(2500))
    with keep_pieces() as store:
        for number in range(20):
            work.cached(number)
            assert sum(size for _, size, _ in store.files()) <= 100_000
    assert 2 <= len(store.files()) < 5
    with keep_pieces() as store:
        work.cached(19)
    assert store.earlier == 1


def test_two_threads_of_work_in_one_folder_do_not_disturb_each_other(monkeypatch):
    """Rationale: one process removes what another reads, writes the same part, or clears all."""
    monkeypatch.setenv("RADIOTWIN_MAX_CACHE_BYTES", "60_000")
    errors = []

    def run():
        store = PieceStore(pieces_folder())
        try:
            for number in range(150):
                name = f"work-{number % 7}"
                found = store.get(name, lambda arrays, content: arrays["value"])
                assert found is None or (found[0] == number % 7).all()
                store.put(name, ({"value": np.full(2000, float(number % 7))}, None), [])
                if number % 40 == 0:
                    store.clear()
            assert not store.failed, store.failed
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors


def test_versions_are_the_same_in_every_process():
    found = pieces.versions()
    assert any(each.startswith("numpy ") for each in found) and any(each.startswith("scipy ") for each in found)
    text = "from radiotwin.runtime.pieces import versions; print(*versions(), sep='\\n')"
    assert found == tuple(subprocess.run([sys.executable, "-c", text], capture_output=True, text=True).stdout.splitlines())


def test_the_folder_is_in_the_users_cache(monkeypatch, tmp_path):
    assert pieces_folder().name == "pieces"
    monkeypatch.delenv("RADIOTWIN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert pieces_folder() == tmp_path / "radiotwin" / "pieces"


def test_the_message_after_an_interruption_is_true(monkeypatch):
    monkeypatch.setattr(interruption, "_finished", 0)
    assert interruption.after_interrupt() == "nothing is kept; run the same command again"
    with keep_pieces():
        Work().cached(1)
    assert interruption.after_interrupt() == "1 finished part is kept; run the same command again to go on"
    with keep_pieces():
        Work().cached(1)
    assert interruption.after_interrupt().startswith("2 finished parts are kept")
