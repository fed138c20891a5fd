"""Groups that are held out together."""

import numpy as np


def deal_groups(group: np.ndarray, max_folds: int, rng: np.random.Generator) -> np.ndarray:
    """Deal groups to folds of about equal size.

    The largest group comes first, and each goes to the fold that is smallest so far, as in
    scikit-learn's `GroupKFold`; groups of equal size come in random order.

    Args:
        group: (n,) label of the group.
        max_folds: fewer where there are fewer groups.
        rng: decides among groups of equal size.

    Returns:
        (n,) fold.
    """
    groups, index, size = np.unique(group, return_inverse=True, return_counts=True)
    load = np.zeros(min(max_folds, len(groups)))
    fold = np.empty(len(groups), dtype=int)
    for g in sorted(rng.permutation(len(groups)), key=lambda g: -size[g]):
        fold[g] = load.argmin()
        load[fold[g]] += size[g]
    return fold[index.ravel()]
