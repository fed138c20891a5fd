"""Links that err alike: pieces of evidence, how many links count as one, and which to leave out."""

from __future__ import annotations

import numpy as np
import pandas as pd

from radiotwin.links.correlation import (
    correlation_length_m,
    moving_end_m,
    pair_of_ends,
    step_m,
)
from radiotwin.links.links import Links

LENGTHS = 1.0  # side of a piece over the correlation length
# Side of a place over it: a square of the area over which exp(-d/L) adds up to 1, 2 pi L².
PLACE_LENGTHS = 2.5
UNKNOWN_M = 100.0  # side of a piece while no residual has been looked at
MIN_PLACES = 6  # that the ground of a campaign is cut into, where it is wide enough
NARROWER = 0.8  # from one width that is tried to the next
LITTLE = 30  # places: fewer are little evidence
PLACE_M = 5.0  # side of a square of ground that counts as one place
PILE, MIN_PILE = 5, 20  # times the usual number of readings at one place is a pile; and at least
MIN_SURPLUS = 0.05  # share of all links in piles, to thin them
MAX_LINKS = 120_000  # up to which all are used
SAMPLE_LINKS = 60_000  # of more: takes minutes


def evidence_blocks(links: Links) -> np.ndarray:
    """Return the piece of evidence (n,) that each link belongs to, an integer.

    Links of one device and receiver that are close to each other on the ground and in one flight
    have nearly the same shadowing, and count as one. How close, `with_evidence` has found out; on
    links that it has not seen, the pieces are `UNKNOWN_M` wide.
    """
    return _evidence(links)[:, 0]


def places(links: Links) -> np.ndarray:
    """Return the place (n,) of each link, an integer: squares of ground that both its ends are in.

    What stands beside a way shadows every flight that comes along it again, whatever the receiver,
    so that more flights over the same ground tell no more of what belongs to a device.
    """
    return _evidence(links)[:, 1]


def _evidence(links: Links) -> np.ndarray:
    if links.evidence is not None:
        return links.evidence
    width_m = fitting_width_m(links, UNKNOWN_M)
    return _pieces(links, width_m, width_m)


def with_evidence(links: Links, z: np.ndarray) -> Links:
    """Return links with pieces of evidence as wide as a residual (n,) is correlated, with notes.

    The residual is that of the base, divided by its scale: all later scores use the same pieces.
    """
    length_m = correlation_length_m(links, z)
    width_m = fitting_width_m(links, LENGTHS * length_m)
    pieces = _pieces(links, width_m, fitting_width_m(links, PLACE_LENGTHS * length_m))
    squares, notes = _occupied(moving_end_m(links), width_m), []
    if squares < LITTLE:
        notes.append(f"links within {width_m:.0f} m of each other err alike, and the campaign has "
                     f"been at {squares} such places only, so evidence is little")
    return links.with_columns(evidence=pieces).with_notes(*notes)


def fitting_width_m(links: Links, wanted_m: float, places: int = MIN_PLACES) -> float:
    """Return the side of the squares that the ground is cut into [m].

    It is `wanted_m`, or less if the end that moves would then be in fewer than `places` squares; at
    least the usual step between its positions.
    """
    position_m, least_m = moving_end_m(links), max(step_m(links), 0.1)
    width_m = max(wanted_m, least_m)
    while width_m > least_m and _occupied(position_m, width_m) < places:
        width_m = max(NARROWER * width_m, least_m)
    return float(width_m)


def _occupied(position_m: np.ndarray, width_m: float) -> int:
    """Return the number of squares of ground with positions (n, 3) in them."""
    return len(np.unique(np.floor(position_m[:, :2] / width_m), axis=0))


def _pieces(links: Links, width_m: float, place_m: float) -> np.ndarray:
    """Return labels (n, 2): squares of one pair of ends and flight, and larger ones of all."""
    pieces, squares = (np.column_stack([np.floor(end[:, :2] / side_m).astype(np.int64) for end in
                                        (links.receiver_m,
                                         np.nan_to_num(links.device_m[links.device]))])
                       for side_m in (width_m, place_m))
    pieces = np.column_stack([pieces, pair_of_ends(links), links.flight])
    return np.column_stack([pd.DataFrame(keys).groupby(list(range(keys.shape[1]))).ngroup()
                            for keys in (pieces, squares)])


def design_effect(block: np.ndarray, z: np.ndarray, max_z: float = 4.0) -> float:
    """Return the design effect: how many links count as one (Kish 1965, 'Survey sampling', 5.4).

    It is the variance of the means of blocks (n,) over that of independent links, at least 1.
    Residuals (n,) are divided by their scale, and clipped to `max_z`.
    """
    z = np.clip(z, -max_z, max_z)
    size = np.bincount(block)
    mean = np.bincount(block, weights=z) / np.maximum(size, 1)
    between = (size * (mean - z.mean()) ** 2).sum() / max((size > 0).sum(), 1)
    return max(float(between / max(z.var(), 1e-9)), 1.0)


def thin_piles(links: Links) -> Links:
    """Return links of which no place has far more than the others have, with a note.

    A receiver that hovers reads one and the same error many times. What a place (of one pair of
    ends, on one flight) has beyond `PILE` times the usual number is left out, evenly in time.
    """
    cell = np.floor(moving_end_m(links)[:, :2] / PLACE_M).astype(np.int64)
    keys = np.column_stack([cell, pair_of_ends(links), links.flight])
    order = np.lexsort((np.arange(len(links)), links.time_s, *keys.T))
    starts = np.flatnonzero(np.r_[True, np.diff(keys[order], axis=0).any(axis=1)])
    count = np.diff(np.r_[starts, len(links)])
    most = max(PILE * float(np.median(count)), MIN_PILE)
    if np.maximum(count - most, 0).sum() < MIN_SURPLUS * len(links):
        return links
    share = np.repeat(np.minimum(most / count, 1.0), count)
    place = np.arange(len(links)) - np.repeat(starts, count)
    kept = np.sort(order[np.floor((place + 1) * share) > np.floor(place * share)])
    note = (f"receivers stayed at {(count > most).sum():,} places, where "
            f"{len(links) - len(kept):,} of {len(links):,} links are left out, evenly in time: "
            f"readings at one place err alike and count as one; {most:.0f} of them are used")
    return links.select(kept).with_notes(note)


def thin_links(links: Links, seed: int) -> Links:
    """Return the links, or a sample of very many, with a note that says so.

    The links of each flight, device and receiver are taken in the order of their times, and of as
    many as go into the sample once, one is drawn. So all flights, devices, receivers, times and
    blanks have the share that they have of all links, and means over the sample are not biased.
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
