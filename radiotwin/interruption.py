"""Count of kept parts of this process's work, for the message after Ctrl-C."""

_finished = 0


def note_finished(count: int = 1) -> None:
    """Count finished parts that the next run will not do again."""
    global _finished
    _finished += count


def after_interrupt() -> str:
    """Return what is kept and how to go on: part of a message."""
    if not _finished:
        return "nothing is kept; run the same command again"
    parts = "1 finished part is" if _finished == 1 else f"{_finished:,} finished parts are"
    return f"{parts} kept; run the same command again to go on"
