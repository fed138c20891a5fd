"""Typical patterns: how an effect of a given size changes the levels of the measured links.

From them follows how large an effect would have had to be, to be seen
(`radiotwin.closeloop.verdict.sensitivity`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from radiotwin.effects.arrays import ends_above_ground, frequent_labels
from radiotwin.effects.boxes import Box, cross
from radiotwin.links import Links

MAX_MEMBERS = 5  # devices, receivers or flights of which the median is taken
MAX_PLACES = 3  # and of boxes in the way, whose search takes longer
MIN_LINKS = 30  # of each
WIDE_M = 20.0  # width of what hides links
PLACES, SHARES = 40, (0.1, 0.3, 0.5, 0.7, 0.9)  # links that it may stand on, and how far along
# What patterns are of, in the order in which they are listed.
KINDS = ("receiver", "device", "flight", "distance", "attitude", "direction", "position", "place",
         "building")


@dataclass(frozen=True, eq=False)
class Pattern:
    """A change of levels, as an effect of each size makes it.

    Attributes:
        kind: one of `KINDS`; any other is listed last.
        unit: of its size: dB, dB/km or m.
        what: its size is of.
        change_db: (n,) of the links' levels, of size 1.
        move_db: the same of a size, where that is not in proportion.
        low, high: least and largest size that the effect may have.
    """

    kind: str
    unit: str
    what: str
    change_db: np.ndarray
    move_db: Callable[[float], np.ndarray] | None = None
    low: float = 0.0
    high: float = np.inf

    @property
    def rank(self) -> int:
        """Place of its kind in the list."""
        return KINDS.index(self.kind) if self.kind in KINDS else len(KINDS)

    def of_size_db(self, size: float) -> np.ndarray:
        """Return what an effect of a size changes (n,)."""
        return size * self.change_db if self.move_db is None else self.move_db(size)


def members(label: np.ndarray) -> list[np.ndarray]:
    """Return masks (n,) of some labels with links enough, if there are two at least."""
    frequent = frequent_labels(label, MIN_LINKS)
    if len(frequent) < 2:
        return []
    return [label == each for each in frequent[_spread(len(frequent), MAX_MEMBERS)]]


def timed_members(links: Links, label: np.ndarray) -> list[np.ndarray]:
    """Return those of `members` of whose links most have a time, and not all the same."""
    timed = np.isfinite(links.time_s)
    return [mine for mine in members(label)
            if timed[mine].mean() > 0.5 and np.ptp(links.time_s[mine & timed]) != 0]


def crossed(links: Links, high_m: float) -> Iterator[np.ndarray]:
    """Yield lengths (n,) of links with line of sight in boxes that such a link passes [m]."""
    rows = np.flatnonzero(links.los)
    a_m, b_m = ends_above_ground(links, rows)
    passed = np.linspace(0, len(rows) - 1, min(PLACES, len(rows))).astype(int)
    found = []
    for link, share in product(passed.tolist(), SHARES):
        x_m, y_m = (a_m[link, :2] + share * (b_m[link, :2] - a_m[link, :2])).tolist()
        inside_m = cross(Box(x_m, y_m, WIDE_M, WIDE_M, high_m, 0.0), a_m, b_m).inside_m
        inside_m = np.where(inside_m > 0, inside_m, 0.0)
        if np.count_nonzero(inside_m) >= MIN_LINKS:
            found.append(inside_m)
    found.sort(key=np.count_nonzero)
    for each in found[_spread(len(found), MAX_PLACES)]:
        every_m = np.zeros(len(links))
        every_m[rows] = each
        yield every_m


def _spread(count: int, maximum: int) -> slice:
    """Return which of so many to take, evenly from first to last, `maximum` of them at most."""
    return slice(None, None, -(-count // maximum) or 1)
