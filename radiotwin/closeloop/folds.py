"""Which links are held out together, and which count as one piece of evidence."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.closeloop.records import Records
from radiotwin.errors import BadInput

FEWEST_FLIGHTS = 4
MOST_FOLDS = 6
WAYS = ("flight", "block", "device")
BLOCK_M = 60.0
EVIDENCE_M = 100.0
LEAST_CELLS = 10
MOST_ENDS = 500


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
        return int(self.index.max()) + 1


def make_folds(records: Records, seed: int, by: str = "auto") -> Folds:
    """Which links are held out together.

    Args:
        records: n links.
        seed: of which go together.
        by: one of `WAYS`; or `auto`: by flight where most links are of devices and receivers that are in at least four,
            else by blocks on the ground.

    Raises:
        BadInput: an unknown way, or one that this data does not allow.
    """
    rng = np.random.default_rng(seed)
    if by == "auto":
        by = "flight" if _flights_are_alike(records) else "block"
    if by == "flight":
        return Folds(by, _spread(_several(records.flight, by), rng))
    if by == "device":
        # A device whose position is to be found from its own links cannot be left out.
        known = np.isin(records.device, sorted(records.anchors))
        _several(records.device[known], by)
        index = np.full(len(records), -1)
        index[known] = _spread(records.device[known], rng)
        return Folds(by, index)
    if by != "block":
        raise BadInput(f"links cannot be held out by {by!r}; allowed are auto, {', '.join(WAYS)}")
    ends = (records.receiver_m, np.nan_to_num(records.device_m[records.device]))
    blocks = [np.unique(np.floor(end[:, :2] / BLOCK_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
              for end in ends]
    block = max(blocks, key=lambda cells: cells.max())  # of the end that moves
    if block.max() + 1 < LEAST_CELLS:
        # Nothing moves: stretches of the file.
        block = np.arange(len(records)) * MOST_FOLDS * 4 // len(records)
    return Folds(by, _spread(block, rng))


def _several(index: np.ndarray, by: str) -> np.ndarray:
    if len(np.unique(index)) < 2:
        raise BadInput(f"links cannot be held out by {by}: fewer than two are{' declared' * (by == 'device')} "
                       "there; "
                       "hold them out by block, or leave the choice to auto")
    return index


def evidence_blocks(records: Records) -> np.ndarray:
    """(n,) index of the piece of evidence that a link belongs to: links of one device and receiver, close to each
    other on the ground and in one flight, err alike and count as one."""
    ends = [np.floor(end[:, :2] / EVIDENCE_M).astype(np.int64) for end in
            (records.receiver_m, np.nan_to_num(records.device_m[records.device]))]
    keys = np.column_stack([*ends, records.receiver, records.flight])
    if len(records.device_names) <= 1000:
        keys = np.column_stack([keys, records.device])
    return pd.DataFrame(keys).groupby(list(range(keys.shape[1]))).ngroup().to_numpy()


def _flights_are_alike(records: Records) -> bool:
    if len(np.unique(records.flight)) < FEWEST_FLIGHTS:
        return False
    seen = np.bincount(records.flight[np.isfinite(records.level_db)])
    if seen.max() > 0.5 * seen.sum():  # what is left without that flight would not tell much
        return False
    for end in (records.device, records.receiver):
        pairs = np.unique(np.column_stack([end, records.flight]), axis=0)
        ends, place = np.unique(end, return_inverse=True)
        flights = np.bincount(np.searchsorted(ends, pairs[:, 0]))
        # Very many ends are one that moves, and it need not come back to where it was.
        if len(ends) <= MOST_ENDS and np.median(flights[place]) < FEWEST_FLIGHTS:
            return False
    return True


def _spread(block: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blocks dealt to folds, the largest first, each to the fold that is smallest so far."""
    blocks, index, size = np.unique(block, return_inverse=True, return_counts=True)
    folds = min(MOST_FOLDS, len(blocks))
    load, dealt = np.zeros(folds), np.empty(len(blocks), dtype=int)
    for b in sorted(rng.permutation(len(blocks)), key=lambda b: -size[b]):
        dealt[b] = load.argmin()
        load[dealt[b]] += size[b]
    return dealt[index.ravel()]
