"""Fewer links where more say nothing new: piles at one place, and samples of very many."""

from __future__ import annotations

import numpy as np

from radiotwin.links import Links
from radiotwin.links.correlation import moving_end_m, pair_of_ends

PLACE_M = 5.0  # side of a square of ground that counts as one place
PILE, MIN_PILE = 5, 20  # times the usual number of readings at one place is a pile; and at least
MIN_SURPLUS = 0.05  # share of all links in piles, to thin them
MAX_LINKS = 120_000  # up to which all are used
SAMPLE_LINKS = 60_000  # of more: takes minutes


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
