"""What is wrong with an import, and how many readings are left out for which reason.

All that is wrong with an import, in one message.

Counts of the readings that are left out, by reason, so that read = kept + left out.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput

_SHOWN = 20  # of the problems in a message


class Problems:
    """Collects messages of `BadInput`, so that reading goes on and finds the others."""

    def __init__(self) -> None:
        self._messages: list[str] = []

    def __len__(self) -> int:
        return len(self._messages)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Keep the message of a `BadInput` raised within, and go on after it."""
        try:
            yield
        except BadInput as error:
            if str(error) not in self._messages:
                self._messages.append(str(error))

    def check(self) -> None:
        """Raise all messages as one.

        Raises:
            BadInput: there are some.
        """
        if not self._messages:
            return
        if len(self._messages) == 1:
            raise BadInput(self._messages[0])
        more = len(self._messages) - _SHOWN
        lines = self._messages[:_SHOWN] + [f"and {more} more"] * (more > 0)
        raise BadInput("\n".join([f"{len(self._messages)} things are wrong:",
                                  *(f"- {line}" for line in lines)]))


@dataclass
class Tally:
    """Readings that were left out.

    Attributes:
        left_out: (reason, column) -> number of readings, in the order of the reasons' first use.
        first: (reason, column) -> the first of them, such as `row 7`.
    """

    left_out: dict[tuple[str, str], int] = field(default_factory=dict)
    first: dict[tuple[str, str], str] = field(default_factory=dict)

    def count(self, reason: str, column: str, number: int, where: str) -> None:
        """Add readings; zero of them leave no entry.

        Args:
            reason: why they are left out.
            column: of the file, or `""`.
            number: of readings.
            where: the first of them, such as `row 7`.
        """
        if number:
            self.left_out[reason, column] = self.left_out.get((reason, column), 0) + int(number)
            self.first.setdefault((reason, column), where)

    def drop(self, links: pd.DataFrame, bad: ArrayLike, reason: str, column: str,
             where: Callable[[int], str]) -> pd.DataFrame:
        """Remove links and count them.

        Args:
            links: n rows.
            bad: (n,) bool, those to remove.
            reason: why they are left out.
            column: of the file.
            where: index -> `row 7`.

        Returns:
            the other links.
        """
        bad = np.asarray(bad, dtype=bool)
        if not bad.any():
            return links
        self.count(reason, column, bad.sum(), where(links.index[int(np.argmax(bad))]))
        return links[~bad]
