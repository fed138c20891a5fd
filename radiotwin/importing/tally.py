"""Counts what is left out and why, so that read = kept + left out."""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd


@dataclass
class Tally:
    """Attributes:
        left_out: (reason, column) -> number of readings, in the order of the reasons' first use.
        first: (reason, column) -> where the first of them stands, such as `row 7`.
    """

    left_out: dict[tuple[str, str], int] = field(default_factory=dict)
    first: dict[tuple[str, str], str] = field(default_factory=dict)

    def count(self, reason: str, column: str, number: int, where: str) -> None:
        """Note `number` readings; none of them leaves no entry."""
        if number:
            self.left_out[reason, column] = self.left_out.get((reason, column), 0) + int(number)
            self.first.setdefault((reason, column), where)

    def drop(self, links: pd.DataFrame, bad, reason: str, column: str, where) -> pd.DataFrame:
        """`links` without those where `bad` (n,), which are counted; `where` names a row by its index."""
        bad = np.asarray(bad, dtype=bool)
        if not bad.any():
            return links
        self.count(reason, column, bad.sum(), where(links.index[int(np.argmax(bad))]))
        return links[~bad]
