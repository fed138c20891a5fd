"""What the commands print with."""

import warnings
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

console = Console(highlight=False)
error_console = Console(stderr=True, highlight=False)
OURS = ("radiotwin", "marl")
collected: dict[str, Any] = {}
"""What the command has printed so far, for `--json`."""


def complain(message: str) -> None:
    """One message on standard error, as it is: no markup, no wrapping inside paths."""
    error_console.print("[bold red]radiotwin:[/] ", end="")
    error_console.print(message, markup=False, soft_wrap=True)


def say(message: str) -> None:
    """One line on standard output."""
    collected.setdefault("messages", []).append(message)
    console.print(message, markup=False, soft_wrap=True)


def show_warnings_plainly() -> None:
    """Warnings of the library as one line each, without a source line."""
    def show(message, category, filename, lineno, file=None, line=None):
        if issubclass(category, UserWarning) and any(f"/{package}/" in filename.replace("\\", "/") for package in OURS):
            error_console.print("[yellow]warning:[/] ", end="")
            error_console.print(str(message), markup=False, soft_wrap=True)
    warnings.showwarning = show


def result(name: str, value: Any) -> None:
    """Something that `--json` gives beside the tables: numbers that a table shows in a short form."""
    collected[name] = value


def print_rows(title: str, columns: dict[str, str], rows: list[list]) -> None:
    """A table.

    Args:
        title: above it.
        columns: heading -> `left` or `right`.
        rows: cells; floats are printed with two decimals, NaN as a dash.
    """
    names = [heading or f"column {number}" for number, heading in enumerate(columns, start=1)]
    collected.setdefault("tables", []).append({"title": title, "rows": [dict(zip(names, row)) for row in rows]})
    table = Table(title=escape(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    for heading, justify in columns.items():
        table.add_column(escape(heading), justify=justify)  # type: ignore[arg-type]  # one of Rich's words
    for row in rows:
        table.add_row(*(escape(_text(cell)) for cell in row))
    console.print(table)


def _text(cell) -> str:
    if isinstance(cell, float):
        return "–" if cell != cell else f"{cell:.2f}"
    return str(cell)
