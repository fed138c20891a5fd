"""Exit statuses, the same for every command of both packages."""

import os
import signal
import time

import pytest
import typer

from radiotwin.command import exit_status
from radiotwin.errors import BadInput, RunFailed


@pytest.fixture(autouse=True)
def handlers():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def failing(error):
    def work():
        raise error
    return work


def signalled(number):
    def work():
        os.kill(os.getpid(), number)
        time.sleep(5)
    return work


@pytest.mark.parametrize("work, status, message", [
    (lambda: None, 0, ""), (failing(BadInput("--x 3: allowed is 1")), 2, "--x 3: allowed is 1"),
    (failing(RunFailed("no memory")), 1, "no memory"),
    (signalled(signal.SIGINT), 130, "interrupted; all is kept")])
def test_an_error_is_one_message_and_a_status(work, status, message, capsys):
    assert exit_status(work, "all is kept") == status
    assert message in capsys.readouterr().err


def test_termination_ends_the_process_in_an_orderly_way():
    with pytest.raises(SystemExit) as end:
        exit_status(signalled(signal.SIGTERM), "")
    assert end.value.code == 143


def test_an_app_is_interrupted_with_a_message(capsys):
    app = typer.Typer()
    app.command()(signalled(signal.SIGINT))
    assert exit_status(lambda: app([]), "go on") == 130
    assert "interrupted; go on" in capsys.readouterr().err
