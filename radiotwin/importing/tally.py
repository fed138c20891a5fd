"""Counts of the readings that are left out, by reason, so that read = kept + left out."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike


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
