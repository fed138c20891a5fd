"""One progress display for the whole project."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from radiotwin.console import PrintableConsole

silent = False  # True hides every bar
_displays: list[Progress] = []  # at most one: a terminal has room for one display


@contextmanager
def progress(description: str, total: float | None) -> Iterator[Callable[..., None]]:
    """Show a progress bar on standard error; show nothing where that is no terminal.

    A bar inside another one gets a line below it in the same display.

    Args:
        description: text before the bar.
        total: number of steps; None if unknown.

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
