"""Names of strangers give no orders to the terminal."""

import io
import logging
import time
import warnings

import pytest
from rich.panel import Panel
from rich.text import Text

from radiotwin.runtime import console
from radiotwin.runtime import console as progress_module
from radiotwin.runtime.console import (
    PrintableConsole,
    complain,
    print_rows,
    printable,
    say,
    show_warnings_plainly,
)

HOSTILE = "a\x1b]0;title\x07\x9b31m\x7f\r\u202eb\u2066\u2028\udcff[red]"
SHOWN = "a\\x1b]0;title\\x07\\x9b31m\\x7f\\r\\u202eb\\u2066\\u2028\\udcff[red]"


@pytest.fixture
def out(monkeypatch):
    """Everything that is printed, on a wide terminal without colours."""
    text = io.StringIO()
    for name in ("console", "error_console"):
        monkeypatch.setattr(console, name, PrintableConsole(file=text, width=200, color_system=None,
                                                            force_terminal=True))
    return text


def test_what_a_terminal_obeys_is_escaped_and_all_else_is_kept():
    assert printable(HOSTILE) == SHOWN
    honest = "Straße 3, 10×5 m – 東京 \tx\ny 👍"
    assert printable(honest) == honest


def test_messages_warnings_logs_and_tables(out, capsys, monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    complain(HOSTILE)
    say(HOSTILE)
    show_warnings_plainly()
    warnings.showwarning(UserWarning(HOSTILE), UserWarning, "/x/radiotwin/y.py", 1)
    print_rows(HOSTILE, {HOSTILE: "left"}, [[HOSTILE + "\n"]])
    lines = out.getvalue().splitlines()
    assert sum(SHOWN in line for line in lines) == 6
    logging.lastResort.handle(logging.makeLogRecord({"msg": HOSTILE, "levelno": logging.WARNING}))
    for text in (out.getvalue(), capsys.readouterr().err):
        assert SHOWN in text and not set(text) & set("\x1b\x07\x9b\x7f\r\u202e\u2066\u2028\udcff")


def test_a_warning_of_each_of_many_models_is_shown_once_in_a_command(out, monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    for _ in range(2):  # commands
        show_warnings_plainly()
        for line in (1, 2, 1):
            for text in ("the limit is not used", "another"):
                warnings.showwarning(UserWarning(text), UserWarning, "/x/radiotwin/y.py", line)
    assert out.getvalue().split("\n") == 2 * ["warning: the limit is not used", "warning: another"] + [""]


def test_a_table_is_cut_nowhere(monkeypatch):
    """In a pipe a line is as long as it needs to be; on a narrow terminal a cell goes on in its next line."""
    words = ["a" * 70, "b" * 60]
    for is_terminal in (False, True):
        text = io.StringIO()
        monkeypatch.setattr(console, "console", PrintableConsole(file=text, width=80, color_system=None,
                                                                force_terminal=is_terminal))
        print_rows("title", {"first": "left", "second": "left"}, [words])
        assert "…" not in text.getvalue()
        lines = text.getvalue().splitlines()
        assert any(all(word in line for word in words) for line in lines) is not is_terminal
        assert text.getvalue().count("a") == 70 and text.getvalue().count("b") == 60
        assert max(map(len, lines)) <= 80 or not is_terminal


def test_whatever_rich_prints(out):
    console.console.print(Panel(Text(HOSTILE)), Text(HOSTILE, style="bold"))
    assert "\x1b" not in out.getvalue() and out.getvalue().count("x9b31m") == 2


def test_a_progress_bar_reads_no_markup(monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(progress_module, "PrintableConsole", lambda stderr: PrintableConsole(
        file=text, width=200, color_system=None, force_terminal=True))
    with progress_module.progress("[/] \x1b]0;x", 2) as advance, progress_module.progress("[/b]\x9b", 1):
        advance(1, "[/c]\u202e")
    assert "[/] \\x1b" in text.getvalue() and "\x1b]" not in text.getvalue() and "\x9b" not in text.getvalue()


def test_progress_in_a_file_is_a_line_now_and_then(out, monkeypatch):
    monkeypatch.setattr(progress_module, "PrintableConsole", lambda stderr: PrintableConsole(file=io.StringIO()))
    monkeypatch.setattr(console, "LINE_S", 0.01)
    with progress_module.progress("first", 1000, lines=True) as advance:
        for text, done in (("second", "200"), ("third", "400")):
            advance(200, text)
            until = time.monotonic() + 60
            while out.getvalue().count(f"radiotwin: {text} ({done} of 1,000 done after ") < 2 and time.monotonic() < until:
                time.sleep(0.01)
            assert out.getvalue().count(f"radiotwin: {text} ({done} of 1,000 done after ") >= 2, "also while nothing advances"
