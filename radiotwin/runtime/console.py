"""Print messages, warnings, tables and progress to the terminal.

Names come from strangers' files: control characters are shown as escapes.
"""

import logging
import re
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Table

# C0 but tab and line feed, DEL, C1; marks, embeddings, overrides and isolates of direction; line
# and paragraph separators; halves of characters, as Python reads names that are not UTF-8.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
                     "\ud800-\udfff]")
MAX_LINE = 10_000  # characters of a table that is not on a terminal
LINE_S = 10.0  # between lines of progress that is not on a terminal
silent = False  # True hides every bar
_displays: list[Progress] = []  # at most one: a terminal has room for one display


def printable(text: str) -> str:
    """Escape the control characters of a text, except tabs and line feeds."""
    return _OBEYED.sub(lambda match: repr(match[0])[1:-1], text)


class PrintableConsole(Console):
    """A Rich console that escapes the control characters of every text."""

    def render(self, renderable: RenderableType,
               options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield segments of printable text; see `rich.console.Console.render`."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)


console = PrintableConsole(highlight=False)
error_console = PrintableConsole(stderr=True, highlight=False)
collected: dict[str, Any] = {}
"""Messages, tables and results printed so far, for `--json`."""


def complain(message: str) -> None:
    """Print an error message on standard error, without markup and without wrapping."""
    with suppress(OSError):  # standard error is closed, or its disk is full
        error_console.print("[bold red]radiotwin:[/] ", end="")
        error_console.print(printable(message), markup=False, soft_wrap=True)


def notice(message: str) -> None:
    """Print a line about the run on standard error, unless it is empty."""
    if message and not console.quiet:
        error_console.print(f"radiotwin: {message}", markup=False, soft_wrap=True)


def say(message: str) -> None:
    """Print one line on standard output."""
    collected.setdefault("messages", []).append(message)
    console.print(printable(message), markup=False, soft_wrap=True)


def show_warnings_plainly() -> None:
    """Show UserWarnings of radiotwin and marl as one line each, once; hide all other warnings."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], filename: str, lineno: int,
             file: TextIO | None = None, line: str | None = None) -> None:
        path = filename.replace("\\", "/")
        if issubclass(category, UserWarning) and ("/radiotwin/" in path or "/marl/" in path):
            text = printable(str(message))
            if text in shown:
                return
            shown.add(text)
            with suppress(OSError):
                error_console.print("[yellow]warning:[/] ", end="")
                error_console.print(text, markup=False, soft_wrap=True)

    warnings.showwarning = show
    if logging.lastResort is not None:  # libraries log to it, since logging is not set up
        logging.lastResort.setFormatter(_PrintableLog())


class _PrintableLog(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def result(name: str, value: Any) -> None:
    """Add an entry to the document of `--json`, such as a number that a table rounds."""
    collected[name] = value


def print_rows(title: str, columns: dict[str, str], rows: list[list]) -> None:
    """Print a table, and keep its rows for the document of `--json`.

    Args:
        title: line above it.
        columns: heading -> `left` or `right`.
        rows: cells; floats get two decimals, small ones two digits, NaN a dash.
    """
    names = [heading or f"column {number}" for number, heading in enumerate(columns, start=1)]
    collected.setdefault("tables", []).append(
        {"title": title, "rows": [dict(zip(names, row)) for row in rows]})
    table = Table(title=escape(_text(title)), title_justify="left", title_style="bold",
                  box=SIMPLE_HEAD, pad_edge=False)
    for heading, justify in columns.items():
        table.add_column(escape(_text(heading)), justify=justify,  # type: ignore[arg-type]  # a Literal
                         overflow="fold")
    for row in rows:
        table.add_row(*(escape(_text(cell)) for cell in row))
    print_table(table, console)


def print_table(table: Table, to: Console) -> None:
    """Print a table without cutting its text: wrapped on a terminal, in long lines to a file."""
    if to.is_terminal:
        to.print(table)
        return
    wanted = Measurement.get(to, to.options.update(max_width=MAX_LINE), table).maximum
    width, to.width = to.width, max(to.width, wanted)
    try:
        to.print(table)
    finally:
        to.width = width


def _text(cell: Any) -> str:
    """Return the printable text of a cell, see `print_rows`."""
    if isinstance(cell, float):
        return "–" if cell != cell else f"{cell:.2g}" if 0 < abs(cell) < 0.005 else f"{cell:.2f}"
    return printable(str(cell)).replace("\n", "\\n").replace("\t", "\\t")


@contextmanager
def progress(description: str, total: float | None, lines: bool = False,
             ) -> Iterator[Callable[..., None]]:
    """Show a progress bar on standard error if that is a terminal.

    An inner bar gets a line below the outer one.

    Args:
        description: text before the bar.
        total: number of steps; None if unknown.
        lines: if standard error is no terminal, print a line every ten seconds.

    Yields:
        `advance(n=1, description=None)`, which adds `n` steps and may change the text.
    """
    if _displays:
        task = _displays[0].add_task(description, total=total)
        try:
            yield lambda n=1, description=None: _displays[0].update(
                task, advance=n, description=description)
        finally:
            _displays[0].remove_task(task)
        return
    console = PrintableConsole(stderr=True)
    if lines and not silent and not console.is_terminal:
        printed = _Lines(description, total)
        try:
            yield printed
        finally:
            printed.over.set()
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True,
                  disable=silent or not console.is_terminal) as display:
        _displays.append(display)
        try:
            task = display.add_task(description, total=total)
            yield lambda n=1, description=None: display.update(
                task, advance=n, description=description)
        finally:
            _displays.remove(display)


class _Lines:
    """Progress as lines in a file, every ten seconds.

    Attributes:
        over: set at the end of the work.
    """

    def __init__(self, description: str, total: float | None) -> None:
        self._text, self._total, self._done = description, total, 0.0
        self._started = time.monotonic()
        self.over = threading.Event()
        threading.Thread(target=self._print, daemon=True).start()

    def __call__(self, n: float = 1, description: str | None = None) -> None:
        self._text, self._done = description or self._text, self._done + n

    def _print(self) -> None:
        while not self.over.wait(LINE_S):
            of = "steps" if self._total is None else f"of {self._total:,.0f}"
            after_s = time.monotonic() - self._started
            notice(f"{self._text} ({self._done:,.0f} {of} done after {after_s:.0f} s)")
