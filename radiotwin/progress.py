"""One progress bar for the whole project."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

silent = False  # whether no bar is shown at all
_shown: list[Progress] = []  # the display in use: a terminal has room for one only


@contextmanager
def progress(description: str, total: float | None) -> Iterator[Callable[..., None]]:
    """Show a bar with the time left on standard error; silent where there is no terminal.

    A bar inside another one gets a line of its own below it.

    Yields:
        `advance(n=1, description=None)`, which also changes the text when one is given
    """
    if _shown:
        task = _shown[0].add_task(description, total=total)
        try:
            yield lambda n=1, description=None: _shown[0].update(task, advance=n, description=description)
        finally:
            _shown[0].remove_task(task)
        return
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=silent or not console.is_terminal) as bar:
        _shown.append(bar)
        try:
            task = bar.add_task(description, total=total)
            yield lambda n=1, description=None: bar.update(task, advance=n, description=description)
        finally:
            _shown.remove(bar)
