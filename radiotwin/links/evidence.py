"""Links that err alike: pieces of evidence, and how many links count as one."""

import numpy as np
import pandas as pd

from radiotwin.links.link_data import LinkData

EVIDENCE_M = 100.0  # side of the square of ground within which links of one pair of ends err alike
MAX_DEVICES = 1000  # more devices are positions of one that moves, and are no key of their own


def evidence_blocks(links: LinkData) -> np.ndarray:
    """Return the piece of evidence that each link belongs to.

    Links of one device and receiver that are close to each other on the ground and in one flight
    have nearly the same shadowing, and count as one.

    Args:
        links: n links.

    Returns:
        (n,) int label.
    """
    ends = [np.floor(end[:, :2] / EVIDENCE_M).astype(np.int64) for end in
            (links.receiver_m, np.nan_to_num(links.device_m[links.device]))]
    keys = np.column_stack([*ends, links.receiver, links.flight])
    if len(links.device_names) <= MAX_DEVICES:
        keys = np.column_stack([keys, links.device])
    return pd.DataFrame(keys).groupby(list(range(keys.shape[1]))).ngroup().to_numpy()


def design_effect(block: np.ndarray, z: np.ndarray, max_z: float = 4.0) -> float:
    """Return how many links count as one (Kish 1965, 'Survey sampling', Sec. 5.4).

    The variance of the blocks' means over what it would be for independent links, at least 1.

    Args:
        block: (n,) label of the piece of evidence.
        z: (n,) residuals over their scale.
        max_z: outliers count as this many scales.
    """
    z = np.clip(z, -max_z, max_z)
    size = np.bincount(block)
    mean = np.bincount(block, weights=z) / size
    between = (size * (mean - z.mean()) ** 2).sum() / max((size > 0).sum(), 1)
    return max(float(between / max(z.var(), 1e-9)), 1.0)
