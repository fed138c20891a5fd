"""Of very many links a sample: neighbours err alike, and a loop over all would take hours."""

from dataclasses import replace

import numpy as np

from radiotwin.links import LinkData

MAX_LINKS = 120_000  # up to which all are used
SAMPLE_LINKS = 60_000  # of more: takes minutes


def thin_links(links: LinkData, seed: int) -> LinkData:
    """Return the links, or a sample of very many, with a note that says so.

    The links of each flight, device and receiver are taken in the order of their times, and of as
    many as go into the sample once, one is drawn. So all flights, devices, receivers, times and
    blanks have the share that they have of all links, and means over the sample are not biased.

    Args:
        links: n links.
        seed: of the draw.
    """
    n = len(links)
    if n <= MAX_LINKS:
        return links
    order = np.lexsort((np.arange(n), links.time_s, links.receiver, links.device, links.flight))
    first = np.arange(SAMPLE_LINKS + 1) * n // SAMPLE_LINKS
    rows = np.sort(order[np.random.default_rng(seed).integers(first[:-1], first[1:])])
    note = (f"of {n:,} links {len(rows):,} are used, drawn evenly from all flights, devices, "
            f"receivers and times, as above {MAX_LINKS:,} the loop would take hours; errors, "
            "evidence and residuals are those of the sample")
    return replace(links.select(rows), notes=[*links.notes, note])
