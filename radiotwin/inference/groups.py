"""Groups that are held out together."""

import numpy as np
from sklearn.model_selection import GroupKFold


def deal_groups(group: np.ndarray, max_folds: int, rng: np.random.Generator) -> np.ndarray:
    """Deal groups to folds of about equal size.

    Args:
        group: (n,) label of the group; at least two.
        max_folds: fewer where there are fewer groups.
        rng: decides among groups of equal size.

    Returns:
        (n,) fold.
    """
    groups, index = np.unique(group, return_inverse=True)
    # `GroupKFold` deals the largest groups first, and equal ones in the order of their labels.
    label = rng.permutation(len(groups))[index.ravel()]
    fold = np.empty(len(label), dtype=int)
    splitter = GroupKFold(min(max_folds, len(groups)))
    for number, (_, held_out) in enumerate(splitter.split(label, groups=label)):
        fold[held_out] = number
    return fold
