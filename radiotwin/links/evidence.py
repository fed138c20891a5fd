"""Links with correlated errors: pieces of evidence, the design effect, and thinning of links."""

from __future__ import annotations

import numpy as np
import pandas as pd

from radiotwin.links.correlation import (
    MAX_Z,
    MIN_STEP_M,
    correlation_length_m,
    median_step_m,
    moving_end_m,
    pair_label,
)
from radiotwin.links.links import Links

# Side of a place in correlation lengths L: a square with the integral of exp(-d/L), 2 pi L².
PLACE_LENGTHS = 2.5
UNKNOWN_M = 100.0  # side of a piece before the correlation length is known
MIN_PLACES = 6  # squares that a campaign is divided into, if it is wide enough
NARROWER = 0.8  # ratio of one trial width to the one before
FEW_SQUARES = 30  # a campaign over fewer squares gets a note
PLACE_M = 5.0  # side of the squares in which readings are counted for thinning
PILE, MIN_PILE = 5, 20  # readings at one place, over the median and at least, that make a pile
MIN_SURPLUS = 0.05  # surplus of all piles over the number of links, below which none is thinned
MAX_LINKS = 120_000  # larger campaigns are sampled
SAMPLE_LINKS = 60_000  # links in the sample; the loop takes minutes on them


def evidence_blocks(links: Links) -> np.ndarray:
    """Return the index (n,) of the piece of evidence to which each link belongs.

    A piece is a group of links whose errors are alike, so that scores count it as one observation:
    links of one device, receiver and flight on one square of ground. Its side is about the
    correlation length that `with_evidence` estimated, or `UNKNOWN_M` before that.
    """
    return _evidence(links)[:, 0]


def places(links: Links) -> np.ndarray:
    """Return an index (n,) of each link's place: the squares of ground on which its two ends are.

    An obstacle beside a route shadows every flight along it, with any receiver. Further flights
    over the same ground are therefore no new evidence about a device.
    """
    return _evidence(links)[:, 1]


def _evidence(links: Links) -> np.ndarray:
    if links.evidence is not None:
        return links.evidence
    width_m = evidence_width_m(links, UNKNOWN_M)
    return _group_indices(links, width_m, width_m)


def with_evidence(links: Links, z: np.ndarray) -> Links:
    """Group links whose errors are alike into pieces of evidence, which scores count as one.

    A piece is as wide as the distance over which residuals `z` (n,) of the base model are
    correlated. A note is added if there are fewer than `FEW_SQUARES` squares.
    """
    length_m = correlation_length_m(links, z)
    width_m = evidence_width_m(links, length_m)
    pieces = _group_indices(links, width_m, evidence_width_m(links, PLACE_LENGTHS * length_m))
    squares, notes = _squares_occupied(moving_end_m(links), width_m), []
    if squares < FEW_SQUARES:
        notes.append(f"links within {width_m:.0f} m of each other err alike, and the campaign has "
                     f"been at {squares} such places only, so evidence is little")
    return links.with_columns(evidence=pieces).with_notes(*notes)


def evidence_width_m(links: Links, wanted_m: float, places: int = MIN_PLACES) -> float:
    """Choose the side [m] of the squares of ground that hold one piece of evidence each.

    It is `wanted_m`, reduced until the moving end occupies at least `places` squares, but not below
    the median step between its positions.
    """
    position_m, least_m = moving_end_m(links), max(median_step_m(links), MIN_STEP_M)
    width_m = max(wanted_m, least_m)
    while width_m > least_m and _squares_occupied(position_m, width_m) < places:
        width_m = max(NARROWER * width_m, least_m)
    return float(width_m)


def _squares_occupied(position_m: np.ndarray, width_m: float) -> int:
    """Count the squares of ground that contain positions (n, 3) [m]."""
    return len(np.unique(np.floor(position_m[:, :2] / width_m), axis=0))


def _group_indices(links: Links, width_m: float, place_m: float) -> np.ndarray:
    """Return two group indices of each link, (n, 2): its piece of evidence, and its place.

    Links with both ends in the same squares, of side `width_m`, or `place_m`, have one index. A
    piece is also of one device, receiver and flight.
    """
    pieces, squares = (np.column_stack([np.floor(end[:, :2] / side_m).astype(np.int64) for end in
                                        (links.receiver_m,
                                         np.nan_to_num(links.device_m[links.device]))])
                       for side_m in (width_m, place_m))
    pieces = np.column_stack([pieces, pair_label(links), links.flight])
    return np.column_stack([pd.DataFrame(keys).groupby(list(range(keys.shape[1]))).ngroup()
                            for keys in (pieces, squares)])


def design_effect(block: np.ndarray, z: np.ndarray) -> float:
    """Estimate how many links count as one independent link, as errors within a block are alike.

    It is the variance of block means, relative to that of independent links, and at least 1 (design
    effect: Kish 1965, 'Survey sampling', 5.4). `block` (n,) is an index; `z` (n,) are residuals
    divided by their scale, clipped to ±`MAX_Z`.
    """
    z = np.clip(z, -MAX_Z, MAX_Z)
    count = np.bincount(block)
    mean = np.bincount(block, weights=z) / np.maximum(count, 1)
    between = (count * (mean - z.mean()) ** 2).sum() / max((count > 0).sum(), 1)
    return max(float(between / max(z.var(), 1e-9)), 1.0)


def thin_piles(links: Links) -> Links:
    """Leave out some links of receivers that stayed at one place, with a note.

    A receiver that hovers repeats one shadowing error. At each square of `PLACE_M`, a device,
    receiver and flight keep at most `PILE` times the median number of links (at least `MIN_PILE`),
    evenly in time. Nothing is left out if the surplus is below `MIN_SURPLUS` of all links.
    """
    cell = np.floor(moving_end_m(links)[:, :2] / PLACE_M).astype(np.int64)
    keys = np.column_stack([cell, pair_label(links), links.flight])
    order = np.lexsort((np.arange(len(links)), links.time_s, *keys.T))
    starts = np.flatnonzero(np.r_[True, np.diff(keys[order], axis=0).any(axis=1)])
    count = np.diff(np.r_[starts, len(links)])
    max_count = max(PILE * float(np.median(count)), MIN_PILE)
    if np.maximum(count - max_count, 0).sum() < MIN_SURPLUS * len(links):
        return links
    kept_share = np.repeat(np.minimum(max_count / count, 1.0), count)
    rank = np.arange(len(links)) - np.repeat(starts, count)
    kept = np.sort(order[np.floor((rank + 1) * kept_share) > np.floor(rank * kept_share)])
    note = (f"receivers stayed at {(count > max_count).sum():,} places, where "
            f"{len(links) - len(kept):,} of {len(links):,} links are left out, evenly in time: "
            f"readings at one place err alike and count as one; {max_count:.0f} of them are used")
    return links.select(kept).with_notes(note)


def thin_links(links: Links, seed: int) -> Links:
    """Leave out links of hovering receivers, and sample more than `MAX_LINKS` links, with notes.

    Links are ordered by flight, device, receiver and time, and one is drawn at random from each of
    `SAMPLE_LINKS` equal groups. Every flight, device, receiver and time keeps its share, so means
    over the sample are unbiased. The seed makes the sample repeatable.
    """
    links = thin_piles(links)
    n = len(links)
    if n <= MAX_LINKS:
        return links
    order = np.lexsort((np.arange(n), links.time_s, links.receiver, links.device, links.flight))
    first = np.arange(SAMPLE_LINKS + 1) * n // SAMPLE_LINKS
    rows = np.sort(order[np.random.default_rng(seed).integers(first[:-1], first[1:])])
    note = (f"of {n:,} links {len(rows):,} are used, drawn evenly from all flights, devices, "
            f"receivers and times, as above {MAX_LINKS:,} the loop would take hours; errors, "
            "evidence and residuals are those of the sample")
    return links.select(rows).with_notes(note)
