"""Lines of a text, counted and bounded."""

import io
from collections.abc import Iterator

from radiotwin.budgets import ROW_BYTES


class Lines:
    """Iterates over the lines of a text.

    Args:
        text: opened with `newline=""`.
        source: of it, for messages.

    Attributes:
        number: of the line that was read last, from 1.
    """

    def __init__(self, text: io.TextIOWrapper, source: object) -> None:
        self._text, self._source, self.number = text, source, 0

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(ROW_BYTES.limit)
        if not line:
            raise StopIteration
        if len(line) == ROW_BYTES.limit and not line.endswith(("\n", "\r")):
            ROW_BYTES.refuse(f"{self._source}: line {self.number + 1}",
                             f"a line of {ROW_BYTES.limit:,} characters and more")
        self.number += 1
        return line if self.number > 1 else line.removeprefix("\ufeff")
