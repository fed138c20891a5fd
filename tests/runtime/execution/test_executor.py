"""Same results wherever pieces run: order, errors, warnings, retries, halves, the cache."""

import os
import signal
import threading
import warnings

import numpy as np
import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.runtime import execution, processes
from radiotwin.runtime.execution import Job, Resources, open_executor
from radiotwin.runtime.jobs import NoCache
from radiotwin.runtime.processes import usable_cores
from tests.runtime.execution.jobs import (
    PLACES,
    Sums,
    environment,
    grow,
    halves,
    nap,
    needs_ray,
    processes_with,
    refuse,
    square,
    start,
    wait_until,
    warn,
)

PIECES = [tuple(range(start, start + 5)) for start in range(0, 60, 5)]
EXPECTED = [np.cumsum(np.sqrt(np.arange(start, start + 5.0))).tobytes() for start in range(0, 60, 5)]


@pytest.fixture(scope="module")
def executors():
    """One of each place for all tests of this module: a cluster takes seconds to start."""
    from contextlib import ExitStack

    with ExitStack() as stack:
        opened = {}

        def get(place):
            if place not in opened:
                opened[place] = stack.enter_context(open_executor(
                    "1" if place == "serial" else "2", "auto" if place == "ray" else None))
            return opened[place]

        yield get


class Memory:
    """A cache that notes what it is asked."""

    def __init__(self, known=()):
        self.known, self.put_pieces = dict(known), []

    def get(self, piece):
        return (self.known[piece],) if piece in self.known else None

    def put(self, piece, result, messages, seconds):
        self.known[piece] = result
        self.put_pieces.append(piece)


@pytest.mark.parametrize("place", PLACES)
def test_results_are_in_the_order_of_the_pieces(executors, place):
    assert executors(place).run(Job("squares", square), range(20)) == [n * n for n in range(20)]


@pytest.mark.parametrize("place", PLACES)
def test_what_the_function_raises_is_raised(executors, place):
    with pytest.raises(BadInput, match="^three is not allowed$"):
        executors(place).run(Job("some", refuse), range(6))
    assert executors(place).run(Job("squares", square), [4]) == [16]


@pytest.mark.parametrize("place", PLACES)
def test_a_warning_is_shown_once(executors, place):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        assert executors(place).run(Job("warns", warn), range(4)) == [0, 1, 2, 3]
    assert [str(each.message) for each in caught if each.category is UserWarning] == ["careful with this city"]


@pytest.mark.parametrize("place", PLACES)
def test_only_what_the_cache_lacks_is_run(executors, place):
    cache = Memory({2: "kept"})
    assert executors(place).run(Job("squares", square), [1, 2, 3], cache) == [1, "kept", 9]
    assert sorted(cache.put_pieces) == [1, 3]


@pytest.mark.parametrize("place", PLACES[1:])
def test_workers_are_other_processes_with_their_number_of_threads(executors, place):
    found = executors(place).run(Job("environments", environment, Resources(cores=1)), range(8))
    assert {threads for _, threads, _ in found} == {"1"}
    assert os.getpid() not in {pid for pid, _, _ in found}


@pytest.mark.parametrize("place", PLACES[1:])
def test_a_killed_worker_changes_nothing(executors, place, tmp_path):
    found = executors(place).run(Job("sums", Sums(tmp_path, deadly=31)), PIECES)
    assert [each.tobytes() for each in found] == EXPECTED
    calls = (tmp_path / "calls").read_text().split()
    assert (tmp_path / "died").exists()
    assert calls.count("30") == 2 and len(calls) == len(PIECES) + 1  # that piece alone ran twice


@pytest.mark.parametrize("place", PLACES[1:])
def test_a_piece_whose_workers_die_is_done_in_halves(executors, place, tmp_path):
    function, cache = Sums(tmp_path, deadly=3, always=True), Memory()
    pieces = [(1, 2), (3, 4), (5, 6)]
    job = Job("sums", function, halve=halves, join=lambda first, second: np.concatenate([first, second]))
    with pytest.warns(UserWarning, match="a piece is done in halves, as its process ended"):
        found = executors(place).run(job, pieces, cache)
    assert found[1].tobytes() == np.sqrt([3.0, 4.0]).tobytes()
    assert set(cache.put_pieces) == {(1, 2), (5, 6), (3,), (4,)}  # each under its own content
    assert executors(place).run(job, pieces[:1] + pieces[2:], cache)[1] is cache.known[(5, 6)]


@pytest.mark.parametrize("place", PLACES[1:])
def test_a_piece_that_kills_every_worker_ends_in_one_message(executors, place, tmp_path):
    with pytest.raises(RunFailed, match="sums: the process that worked on a piece of the work ended 2 times .*"
                                        "finished pieces are kept"):
        executors(place).run(Job("sums", Sums(tmp_path, deadly=3, always=True)), [(1, 2), (3, 4)])


def test_a_worker_that_takes_too_much_memory_is_ended(executors):
    limit = Resources(memory_bytes=2**30)
    job = Job("hungry", grow, limit, halve=lambda megabytes: (megabytes // 2, megabytes - megabytes // 2),
              join=lambda first, second: first + second)
    with pytest.warns(UserWarning, match=r"took more than 1\.0 GiB of memory"):
        assert executors("local").run(job, [1300, 20]) == [130, 2]
    with pytest.raises(RunFailed, match=r"half a piece.*A worker may take 1\.0 GiB"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        executors("local").run(job, [4000])


def test_no_more_room_is_asked_for_than_there_are_pieces(monkeypatch):
    monkeypatch.setattr(execution, "free_memory_bytes", lambda: 3 * 2**30)
    with open_executor("4") as executor:
        assert executor.run(Job("squares", square, Resources(memory_bytes=2**30)), [1, 2]) == [1, 4]
        with pytest.raises(RunFailed, match="4 worker.s. may take 1.0 GiB of memory each, and 3 would fit"):
            executor.run(Job("squares", square, Resources(memory_bytes=2**30)), range(9))


def test_pages_of_files_are_given_back(monkeypatch, tmp_path):
    """A container of 8 GiB, 7 of which hold files that were read once."""
    monkeypatch.setattr(processes, "_GROUPS", tmp_path)
    for name, value in (("memory.max", 8 * 2**30), ("memory.current", 7.5 * 2**30)):
        (tmp_path / name).write_text(f"{int(value)}\n")
    assert processes._group_bytes() == 2**29
    (tmp_path / "memory.stat").write_text(f"anon {2**28}\ninactive_file {7 * 2**30}\nactive_file 5\n")
    assert processes._group_bytes() == 7.5 * 2**30
    (tmp_path / "memory.max").write_text("max\n")
    assert processes._group_bytes() is None


@pytest.mark.parametrize("patience_s, memory_bytes", [(0.0, 2**50), (20.0, 0)])  # too much memory, and done at once
def test_auto_starts_no_worker_that_would_not_help(patience_s, memory_bytes):
    said = []
    with open_executor("auto", say=said.append) as executor:
        executor._patience_s = patience_s
        found = executor.run(Job("environments", environment, Resources(memory_bytes=memory_bytes)), range(50))
    assert {pid for pid, _, _ in found} == {os.getpid()} and not said


@pytest.mark.skipif(usable_cores() < 2, reason="one core: there is no worker that would help")
def test_auto_starts_workers_when_the_work_goes_on_for_long():
    """Judged by the pieces so far, but the first one, which may have compiled something."""
    said = []
    with open_executor("auto", say=said.append) as executor:
        executor._patience_s = 2.0
        found = executor.run(Job("naps", nap), [0.5, *[0.3] * 20])
    assert found[:2] == [os.getpid()] * 2 and os.getpid() not in found[2:]
    assert len(said) == 1


def test_what_will_be_used_is_said():
    said = []
    with open_executor("2", say=said.append) as executor:
        executor.run(Job("squares", square, Resources(memory_bytes=2**30)), range(3))
    assert said == ["squares: 2 workers on this machine, 1 core, at most 1.0 GiB of memory each"]


@pytest.mark.parametrize("workers", ["0", "-1", "two", "1.5", "", "99999"])
def test_a_wrong_number_of_workers(workers):
    with pytest.raises(BadInput, match="allowed are auto, or a number from 1 to"), open_executor(workers):
        pass


DRIVER = """
import sys
from radiotwin.runtime.execution import Job, open_executor
from tests.runtime.execution.jobs import linger

with open_executor("2", sys.argv[2] or None) as executor:
    executor.run(Job("lingers", linger), [sys.argv[1]] * 4)
"""


@pytest.mark.parametrize(("number", "cluster"), [
    (signal.SIGKILL, ""), (signal.SIGTERM, ""), pytest.param(signal.SIGKILL, "auto", marks=needs_ray),
    pytest.param(signal.SIGTERM, "auto", marks=[needs_ray, pytest.mark.slow])])
def test_nothing_is_left_of_a_killed_driver(tmp_path, cluster, number):
    """No process, whatever it was doing; so no port either."""
    mark = f"mark-{tmp_path.name}-{number}"
    driver = start(DRIVER, tmp_path, cluster, MARK_OF_TEST=mark)
    wait_until(lambda: len(list(tmp_path.glob("worker-*"))) == 2 or driver.poll() is not None, 100)
    assert driver.poll() is None and len(processes_with(mark)) >= 3
    os.kill(driver.pid, number)
    driver.wait()
    wait_until(lambda: not processes_with(mark), 15)


def test_a_function_that_cannot_be_sent_is_refused_but_ahead_only_told_once():
    job, lines = Job("locked", lambda number, lock=threading.Lock(): number), []
    with open_executor("2", say=lines.append) as executor:
        with pytest.raises(RunFailed, match="cannot be sent to another process"):
            executor.run(job, range(2))
        for _ in range(2):
            executor.run_ahead(job, range(2), NoCache())
    (line,) = lines
    assert line.startswith("locked") and "cannot be sent to another process" in line and "in this process" in line
