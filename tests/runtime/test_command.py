"""Exit statuses and messages, the same for every command of both packages."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import typer

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io import files, signals
from radiotwin.runtime.command import exit_status

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["radiotwin", "fit", "links.csv"])
    before = {number: signal.getsignal(number) for number in (*signals.NUMBERS, signal.SIGALRM)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored, where the tests run under nohup
    hook = sys.unraisablehook
    yield
    sys.unraisablehook = hook
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


app = typer.Typer()
app.command()(signalled(signal.SIGINT))


@pytest.mark.parametrize("work, status, message", [
    (lambda: None, 0, ""), (failing(BadInput("--x 3: allowed is 1")), 2, "--x 3: allowed is 1"),
    (failing(RunFailed("no memory")), 1, "no memory"),
    (signalled(signal.SIGINT), 130, "interrupted; all is kept"),
    (signalled(signal.SIGTERM), 143, "terminated; all is kept"),
    (signalled(signal.SIGHUP), 129, "terminated; all is kept"),
    (failing(MemoryError("Unable to allocate 8 TiB")), 1,
     "out of memory while running radiotwin fit links.csv: Unable to allocate 8 TiB; use"),
    (lambda: app([]), 130, "interrupted; all is kept"),
    (lambda: Path("x" * 300).is_dir(), 2, "cannot be a path (File name too long)"),
    (failing(SystemExit(3)), 3, ""), (failing(BrokenPipeError()), 1, "unexpected error")])
def test_an_error_is_one_message_and_a_status(work, status, message, capsys):
    assert exit_status(work, "all is kept") == status
    said = capsys.readouterr().err
    assert message in said and len(said.splitlines()) == bool(message)


def test_under_nohup_a_hang_up_stops_nothing():
    def work():
        os.kill(os.getpid(), signal.SIGHUP)
        return 0

    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert exit_status(work, "all is kept") == 0


def overflow():
    return overflow()


def wrapped():
    try:
        signalled(signal.SIGTERM)()
    except BaseException as error:
        raise RuntimeError("dr.while_loop(): encountered an exception (see above)") from error


went_on = []


def swallowed():
    try:
        signalled(signal.SIGTERM)()
    except BaseException:
        pass
    time.sleep(5)
    went_on.append("swallowed")


class Swallows:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)


def swallowed_in_del():
    Swallows()
    time.sleep(5)
    went_on.append("swallowed in del")


@pytest.mark.parametrize("work", [wrapped, swallowed, swallowed_in_del])
def test_a_signal_gets_through_whatever_the_work_makes_of_it(work, capsys):
    assert exit_status(work, "all is kept") == 143 and not went_on
    assert capsys.readouterr().err == "radiotwin: terminated; all is kept\n"


def test_a_second_signal_does_not_disturb_the_clean_up(tmp_path):
    cleaned = []

    def work():
        try:
            signalled(signal.SIGINT)()
        finally:
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.01)
            cleaned.append(True)

    assert exit_status(work, "") == 130 and cleaned


def test_a_folder_is_not_lost_while_it_is_replaced(tmp_path, monkeypatch):
    """At 0f68f2a a signal between the two renames removed the old folder."""
    (tmp_path / "twin").mkdir()
    (tmp_path / "twin" / "old").touch()
    replace = os.replace

    def signalled_replace(*paths):
        replace(*paths)
        os.kill(os.getpid(), signal.SIGINT)

    def work():
        with files.atomic_folder(tmp_path / "twin") as folder:
            (folder / "new").touch()

    monkeypatch.setattr(os, "replace", signalled_replace)
    assert exit_status(work, "") == 130
    assert [path.name for path in tmp_path.rglob("*")] == ["twin", "new"]


def test_signals_are_deferred_in_the_main_thread_alone():
    def work():
        with signals.deferred():
            os.kill(os.getpid(), signal.SIGINT)
            thread = threading.Thread(target=inside)
            thread.start()
            thread.join()
        time.sleep(5)

    def inside():
        with signals.deferred():
            seen.append(True)
        seen.append(True)

    seen = []
    assert exit_status(work, "") == 130 and seen == [True, True]


def test_an_unexpected_error_is_a_message_and_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert exit_status(overflow, "") == 1
    said = capsys.readouterr().err
    (path,) = tmp_path.iterdir()
    assert said.startswith("radiotwin: unexpected error while running radiotwin fit links.csv: RecursionError: ")
    assert str(path) in said and len(said.splitlines()) == 1 and path.stat().st_mode & 0o77 == 0
    assert "Traceback" in path.read_text() and "in overflow" in path.read_text()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nothing"))
    assert exit_status(overflow, "") == 1
    assert "could not be saved (FileNotFoundError)" in capsys.readouterr().err


AT_IMPORT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.{number})
sys.meta_path.insert(0, Finder())
sys.argv = ["radiotwin", "{command}", "--help"]
"""


@pytest.mark.parametrize("module, number, status", [("typer", "SIGINT", 130), ("rich.console", "SIGTERM", 143),
                                                    ("radiotwin.cli.scenes", "SIGINT", 130)])
def test_a_signal_while_the_command_is_loaded_is_one_line(module, number, status):
    program = AT_IMPORT.format(module=module, number=number, command="fit")
    done = subprocess.run([sys.executable, "-c", program + "from radiotwin.cli import main; main()"], text=True,
                          capture_output=True, env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=60)
    word = "interrupted" if status == 130 else "terminated"
    assert (done.returncode, done.stderr) == (status, f"radiotwin: {word}; nothing had been done yet\n")


def test_a_working_folder_that_is_gone(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert exit_status(lambda: Path("x").resolve(), "") == 2
    assert "working folder does not exist" in capsys.readouterr().err
