"""Cross-validation: deal groups to folds, and stack predictions by held-out errors.

Stacking weights are not negative and sum to one (Breiman 1996, 'Stacked regressions', Machine
Learning 24; van der Laan, Polley and Hubbard 2007, 'Super learner', Statistical Applications in
Genetics and Molecular Biology 6). There are two sets of weights, and each row blends them linearly
by its share of the second.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

SUM_WEIGHT = 1e4  # weight of the equation "weights sum to one", relative to the errors


def deal_groups(group: np.ndarray, max_folds: int, rng: np.random.Generator) -> np.ndarray:
    """Deal groups (n,) to folds (n,) of about equal size, largest first, each to the smallest.

    As scikit-learn's `GroupKFold`, but groups of equal size come in random order; fewer folds where
    there are fewer groups.
    """
    groups, index, size = np.unique(group, return_inverse=True, return_counts=True)
    load = np.zeros(min(max_folds, len(groups)))
    fold = np.empty(len(groups), dtype=int)
    for g in sorted(rng.permutation(len(groups)), key=lambda g: -size[g]):
        fold[g] = load.argmin()
        load[fold[g]] += size[g]
    return fold[index.ravel()]


def convex_weights(error: np.ndarray, share: np.ndarray, pull: float) -> np.ndarray:
    """Fit stacking weights (each set ≥ 0, sum 1) by least squares, shrunk to the best prediction.

    Minimises mean((error @ w)^2) / m + pull * |w - best|^2, summed over both sets of weights, where
    m is the mean square error of the best single prediction. With equal shares, another prediction
    must have a mean square error lower by 4 `pull` m to be taken instead. Errors are (n, k), shares
    of the second set (n,) in 0..1, weights (2, k).
    """
    n, k = error.shape
    square = np.square(error).mean(axis=0)
    best = int(square.argmin())
    columns = np.hstack([error * (1 - share)[:, None], error * share[:, None]])
    columns /= np.sqrt(n * max(float(square[best]), 1e-12))
    upper = np.linalg.qr(columns, mode="r")
    wanted = np.tile(np.arange(k) == best, 2).astype(float)
    sums = SUM_WEIGHT * np.kron(np.eye(2), np.ones(k))
    weights, _ = nnls(np.vstack([upper, np.sqrt(pull) * np.eye(2 * k), sums]),
                      np.concatenate([np.zeros(len(upper)), np.sqrt(pull) * wanted,
                                      np.full(2, SUM_WEIGHT)]))
    weights = weights.reshape(2, k)
    return weights / weights.sum(axis=1, keepdims=True)


def combine(predictions: np.ndarray, share: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Combine predictions (n, k) by two sets of weights (2, k), blended by shares (n,)."""
    blended = (1 - share)[:, None] * weights[0] + share[:, None] * weights[1]
    return (blended * predictions).sum(axis=1)
