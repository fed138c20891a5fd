"""Regression trees as plain arrays, evaluated without the library that grew them.

scikit-learn keeps its trees as pickled objects, which run code when they are loaded. These arrays
are data, and predict the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from radiotwin.io.budgets import TREE_NODES
from radiotwin.propagation.laws.base import MAX_DB, require_array, require_names

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

BATCH = 4000  # rows that are predicted at a time: bounds memory
MAX_FEATURES = 10_000


@dataclass(frozen=True, eq=False)
class Forest:
    """The sum of t trees with m nodes in all; a leaf is its own child.

    Attributes:
        root: (t,) node that each tree begins with.
        feature: (m,) column that a node asks for.
        threshold: (m,) up to which the way goes left.
        left, right: (m,) nodes, after the node itself; of a leaf the node itself.
        value: (m,) what a leaf adds.
        constant: added to all.
    """

    root: np.ndarray
    feature: np.ndarray
    threshold: np.ndarray
    left: np.ndarray
    right: np.ndarray
    value: np.ndarray
    constant: float = 0.0

    @classmethod
    def of_extra_trees(cls, fitted: ExtraTreesRegressor) -> Self:
        """Return the trees of a fitted ensemble, whose mean is its prediction."""
        trees, count = [each.tree_ for each in fitted.estimators_], len(fitted.estimators_)
        return cls._of([(each.children_left, each.children_right, each.feature, each.threshold,
                         each.value[:, 0, 0] / count) for each in trees], 0.0)

    @classmethod
    def of_boosting(cls, fitted: HistGradientBoostingRegressor) -> Self:
        """Return the trees of fitted boosting on numbers without gaps."""
        trees: list[tuple[np.ndarray, ...]] = []
        for (predictor,) in fitted._predictors:  # the library has no public way to its nodes
            nodes = predictor.nodes
            leaf = nodes["is_leaf"].astype(bool)
            trees.append((np.where(leaf, -1, nodes["left"].astype(int)),
                          np.where(leaf, -1, nodes["right"].astype(int)), nodes["feature_idx"],
                          nodes["num_threshold"], nodes["value"]))
        return cls._of(trees, float(np.ravel(fitted._baseline_prediction)[0]))

    @classmethod
    def _of(cls, trees: list[tuple[np.ndarray, ...]], constant: float) -> Self:
        """Join trees: left and right (negative at a leaf), feature, threshold, value of nodes."""
        sizes = [len(each[0]) for each in trees]
        first = np.cumsum([0, *sizes[:-1]])
        own = np.arange(sum(sizes))
        left, right, feature, threshold, value = (np.concatenate(each) for each in zip(
            *trees, strict=True))
        leaf, shift = left < 0, np.repeat(first, sizes)
        return cls(first.astype(np.int32), np.where(leaf, 0, feature).astype(np.int16),
                   np.where(leaf, 0.0, threshold),
                   np.where(leaf, own, left + shift).astype(np.int32),
                   np.where(leaf, own, right + shift).astype(np.int32),
                   np.where(leaf, value, 0.0), constant)

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Return the sum of the leaves (n,) that rows (n, p) of features fall into."""
        features = np.asarray(features, dtype=np.float32)  # as scikit-learn compares them
        total = np.full(len(features), self.constant)
        for start in range(0, len(features), BATCH):
            rows = slice(start, start + BATCH)
            own = features[rows]
            node = np.broadcast_to(self.root, (len(own), len(self.root)))
            index = np.arange(len(own))[:, None]
            while True:
                goes_left = own[index, self.feature[node]] <= self.threshold[node]
                below = np.where(goes_left, self.left[node], self.right[node])
                if (below == node).all():
                    break
                node = below
            total[rows] += self.value[node].sum(axis=1)
        return total

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays by name, and settings that JSON can hold, for `from_state`."""
        names = ("root", "feature", "threshold", "left", "right", "value")
        return {name: getattr(self, name) for name in names}, {"constant": self.constant}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   width: int) -> Self:
        """Return what `state` described.

        Args:
            arrays: of `state`.
            settings: of `state`.
            width: number of columns p that it may ask for.

        Raises:
            BadInput: too many nodes.
            ValueError: damaged, such as nodes in a circle.
            KeyError: a part is missing.
        """
        require_names("arrays", arrays,
                      ["root", "feature", "threshold", "left", "right", "value"])
        require_names("settings", settings, ["constant"])
        nodes = len(arrays["value"])
        TREE_NODES.check(nodes, "the learnt residual")
        root = require_array(arrays, "root", (None,), 0, nodes - 1)
        feature = require_array(arrays, "feature", (nodes,), 0, width - 1)
        left, right = (require_array(arrays, name, (nodes,), 0, nodes - 1)
                       for name in ("left", "right"))
        own = np.arange(nodes)
        leaf = left == own
        # A child comes after its parent, so that every way ends.
        if not ((right == own) == leaf).all() or not (
                (left > own) & (right > own) | leaf).all():
            raise ValueError("a tree runs in a circle")
        if any(each.dtype.kind not in "iu" for each in (root, feature, left, right)):
            raise ValueError("nodes are counted in whole numbers")
        constant = settings["constant"]
        if isinstance(constant, bool) or not isinstance(constant, int | float) \
                or not abs(constant) <= MAX_DB:
            raise ValueError("constant is no level")
        return cls(root, feature, require_array(arrays, "threshold", (nodes,), -1e9, 1e9), left,
                   right, require_array(arrays, "value", (nodes,), -MAX_DB, MAX_DB),
                   float(constant))
