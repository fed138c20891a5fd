"""Calls in threads: in order, as many as cores and the environment allow."""

import threading

import pytest

from radiotwin.runtime.processes import MAX_THREADS, in_threads, thread_count


@pytest.mark.parametrize("limit, most", [("1", 1), ("2", 2), ("0", 1), ("", MAX_THREADS), ("many", MAX_THREADS)])
def test_the_environment_limits_threads(monkeypatch, limit, most):
    monkeypatch.setenv("OMP_NUM_THREADS", limit)
    assert 1 <= thread_count() <= most


def test_results_are_in_the_order_of_the_items_and_run_side_by_side(monkeypatch):
    monkeypatch.setattr("radiotwin.runtime.processes.thread_count", lambda: 2)
    both = threading.Barrier(2)

    def double(value):
        both.wait(10)  # nobody passes alone
        return 2 * value
    assert in_threads(double, iter(range(4))) == [0, 2, 4, 6]


def test_the_error_of_a_call_is_that_of_all(monkeypatch):
    monkeypatch.setattr("radiotwin.runtime.processes.thread_count", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda value: 1 / value, [1, 0, 2])
    assert in_threads(str, []) == []
