"""Typical patterns: changes of the measured links' levels by a typical effect of some size.

The smallest detectable size of an effect follows from them
(`radiotwin.closeloop.verdict.sensitivity`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from radiotwin.effects.arrays import ends_above_ground, frequent_labels
from radiotwin.effects.boxes import Box, cross
from radiotwin.links import Links

MAX_MEMBERS = 5  # devices, receivers or flights over which the median is taken
MAX_PLACES = 3  # the same for boxes, whose search takes longer
MIN_LINKS = 30  # links of a member, or through a box
WIDE_M = 20.0  # width of a typical obstacle
PLACES, FRACTIONS = 40, (0.1, 0.3, 0.5, 0.7, 0.9)  # links with trial boxes, and where along them
# Kinds of patterns in the order of the report.
KINDS = ("receiver", "device", "flight", "distance", "attitude", "direction", "position", "place",
         "building")


@dataclass(frozen=True, eq=False)
class Pattern:
    """A change of levels as a function of the size of an effect.

    Attributes:
        kind: one of `KINDS`; any other is listed last.
        unit: unit of the size: dB, dB/km or m.
        what: description of the size, for the report.
        change_db: (n,) change of the links' levels at size 1 [dB].
        move_db: size -> change (n,) [dB], if not proportional to the size.
        low, high: range of sizes that the effect may have.
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
        """Position of its kind in `KINDS`."""
        return KINDS.index(self.kind) if self.kind in KINDS else len(KINDS)

    def of_size_db(self, size: float) -> np.ndarray:
        """Compute the change of the levels (n,) by an effect of some size [dB]."""
        return size * self.change_db if self.move_db is None else self.move_db(size)


def members(label: np.ndarray) -> list[np.ndarray]:
    """Return masks (n,) of up to `MAX_MEMBERS` labels of `MIN_LINKS` links; [] for a single one."""
    frequent = frequent_labels(label, MIN_LINKS)
    if len(frequent) < 2:
        return []
    return [label == member for member in frequent[_spread(len(frequent), MAX_MEMBERS)]]


def timed_members(links: Links, label: np.ndarray) -> list[np.ndarray]:
    """Return those masks of `members` in which most links have times, and not all the same time."""
    timed = np.isfinite(links.time_s)
    return [mask for mask in members(label)
            if timed[mask].mean() > 0.5 and np.ptp(links.time_s[mask & timed]) != 0]


def lengths_in_boxes(links: Links, height_m: float) -> Iterator[np.ndarray]:
    """Yield the length (n,) of every link inside each trial box, `height_m` above the ground [m].

    Boxes are `WIDE_M` wide and placed along links with line of sight; other links have 0. Of those
    crossed by `MIN_LINKS`, up to `MAX_PLACES`, spread evenly from rarely to often crossed ones.
    """
    rows = np.flatnonzero(links.los)
    a_m, b_m = ends_above_ground(links, rows)
    chosen = np.linspace(0, len(rows) - 1, min(PLACES, len(rows))).astype(int)
    found = []
    for link, fraction in product(chosen.tolist(), FRACTIONS):
        x_m, y_m = (a_m[link, :2] + fraction * (b_m[link, :2] - a_m[link, :2])).tolist()
        inside_m = cross(Box(x_m, y_m, WIDE_M, WIDE_M, height_m, 0.0), a_m, b_m).inside_m
        inside_m = np.where(inside_m > 0, inside_m, 0.0)
        if np.count_nonzero(inside_m) >= MIN_LINKS:
            found.append(inside_m)
    found.sort(key=np.count_nonzero)
    for inside_m in found[_spread(len(found), MAX_PLACES)]:
        length_m = np.zeros(len(links))
        length_m[rows] = inside_m
        yield length_m


def _spread(count: int, maximum: int) -> slice:
    """Return a slice that takes every k-th of `count` items, at most `maximum` in all."""
    return slice(None, None, -(-count // maximum) or 1)
