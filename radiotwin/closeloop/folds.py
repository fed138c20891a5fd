"""Which links are held out together."""

from dataclasses import dataclass

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.inference.groups import deal_groups
from radiotwin.links import LinkData
from radiotwin.links.correlation import moving_end_m
from radiotwin.links.evidence import fitting_width_m

WAYS = ("flight", "block", "quadrant", "device")
MIN_FLIGHTS = 4  # that most devices and receivers must be in, for flights to be held out
MAX_FOLDS = 6
BLOCK_M = 60.0  # side of a block on the ground
MIN_BLOCKS = 10
MIN_CLUSTERS = 6  # places that are held out one by one
STRETCHES = 4  # of each fold, where nothing moves
MAX_ENDS = 500  # more are positions of one end that moves, and need not return


@dataclass(frozen=True, eq=False)
class Folds:
    """A partition of n links.

    Attributes:
        by: one of `WAYS`.
        index: (n,) fold of each link; -1 = never held out.
    """

    by: str
    index: np.ndarray

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.index.max()) + 1


def make_folds(links: LinkData, seed: int, by: str = "auto") -> Folds:
    """Return which links are held out together.

    Args:
        links: n links.
        seed: of which go together.
        by: one of `WAYS`; or `auto`: by flight where most links are of devices and receivers that
            are in at least `MIN_FLIGHTS`, else by blocks on the ground.

    Raises:
        BadInput: an unknown way, or one that these data do not allow.
    """
    rng = np.random.default_rng(seed)
    if by == "auto":
        by = "flight" if _flights_are_alike(links) else "block"
    if by == "flight":
        return Folds(by, deal_groups(_require_several(links.flight, by), MAX_FOLDS, rng))
    if by == "quadrant":
        return Folds(by, deal_groups(_require_several(_quadrants(links), by), MAX_FOLDS, rng))
    if by == "device":
        # A device whose position is to be found from its own links cannot be left out.
        known = np.isin(links.device, sorted(links.anchors))
        _require_several(links.device[known], by)
        index = np.full(len(links), -1)
        index[known] = deal_groups(links.device[known], MAX_FOLDS, rng)
        return Folds(by, index)
    if by != "block":
        raise BadInput(f"links cannot be held out by {by!r}; allowed are auto, {', '.join(WAYS)}")
    return Folds(by, deal_groups(_blocks(links), MAX_FOLDS, rng))


def _blocks(links: LinkData) -> np.ndarray:
    """Return labels (n,) of squares of ground of the end that moves, or of stretches of time.

    Where `BLOCK_M` is too wide for `MIN_BLOCKS`, squares are smaller. Clusters of positions that no
    square parts are held out as they are; where there are too few of them, stretches are.
    """
    width_m = fitting_width_m(links, BLOCK_M, MIN_BLOCKS)
    cell = np.floor(moving_end_m(links)[:, :2] / width_m).astype(np.int64)
    block = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    if block.max() + 1 >= MIN_CLUSTERS:
        return block
    order = np.lexsort((np.arange(len(links)), links.time_s, links.flight))
    stretch = np.empty(len(links), dtype=int)
    stretch[order] = np.arange(len(links)) * MAX_FOLDS * STRETCHES // len(links)
    return stretch


def _quadrants(links: LinkData) -> np.ndarray:
    """Return labels (n,) of the four parts of the area on either side of its middle link.

    Each is a piece of ground that no other link is near to: what is learnt has to extrapolate.
    """
    end_m = moving_end_m(links)[:, :2]
    east, north = (end_m > np.median(end_m, axis=0)).T
    return 2 * east + north


def _require_several(index: np.ndarray, by: str) -> np.ndarray:
    if len(np.unique(index)) < 2:
        declared = " declared" * (by == "device")
        raise BadInput(f"links cannot be held out by {by}: there are fewer than two{declared}; "
                       "hold them out by block, or leave the choice to auto")
    return index


def _flights_are_alike(links: LinkData) -> bool:
    if len(np.unique(links.flight)) < MIN_FLIGHTS:
        return False
    seen = np.bincount(links.flight[np.isfinite(links.level_db)])
    if seen.max() > 0.5 * seen.sum():  # what is left without that flight would say little
        return False
    for end in (links.device, links.receiver):
        pairs = np.unique(np.column_stack([end, links.flight]), axis=0)
        ends, row = np.unique(end, return_inverse=True)
        flights = np.bincount(np.searchsorted(ends, pairs[:, 0]))
        if len(ends) <= MAX_ENDS and np.median(flights[row]) < MIN_FLIGHTS:
            return False
    return True
