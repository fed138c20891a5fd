"""Print messages, warnings and tables the same way in every command."""

import warnings
from typing import Any, TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

console = Console(highlight=False)
error_console = Console(stderr=True, highlight=False)
collected: dict[str, Any] = {}
"""Messages, tables and results printed so far, for `--json`."""


def complain(message: str) -> None:
    """Print one message on standard error, without markup and without wrapping inside paths."""
    error_console.print("[bold red]radiotwin:[/] ", end="")
    error_console.print(message, markup=False, soft_wrap=True)


def notice(message: str) -> None:
    """Print one line about the run itself on standard error; nothing if it is empty."""
    if message and not console.quiet:
        error_console.print(f"radiotwin: {message}", markup=False, soft_wrap=True)


def say(message: str) -> None:
    """Print one line on standard output."""
    collected.setdefault("messages", []).append(message)
    console.print(message, markup=False, soft_wrap=True)


def show_warnings_plainly() -> None:
    """Show warnings of both packages as one line each, without source lines, and no others."""
    def show(message: Warning | str, category: type[Warning], filename: str, lineno: int,
             file: TextIO | None = None, line: str | None = None) -> None:
        path = filename.replace("\\", "/")
        if issubclass(category, UserWarning) and ("/radiotwin/" in path or "/marl/" in path):
            error_console.print("[yellow]warning:[/] ", end="")
            error_console.print(str(message), markup=False, soft_wrap=True)
    warnings.showwarning = show


def result(name: str, value: Any) -> None:
    """Add an entry to the document of `--json`, such as numbers that a table shows rounded."""
    collected[name] = value


def print_rows(title: str, columns: dict[str, str], rows: list[list]) -> None:
    """Print a table.

    Args:
        title: line above it.
        columns: heading -> `left` or `right`.
        rows: cells; floats are printed with two decimals, NaN as a dash.
    """
    names = [heading or f"column {number}" for number, heading in enumerate(columns, start=1)]
    collected.setdefault("tables", []).append(
        {"title": title, "rows": [dict(zip(names, row)) for row in rows]})
    table = Table(title=escape(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD,
                  pad_edge=False)
    for heading, justify in columns.items():
        table.add_column(escape(heading), justify=justify)  # type: ignore[arg-type]  # a Literal
    for row in rows:
        table.add_row(*(escape(_text(cell)) for cell in row))
    console.print(table)


def _text(cell: Any) -> str:
    if isinstance(cell, float):
        return "–" if cell != cell else f"{cell:.2f}"
    return str(cell)
