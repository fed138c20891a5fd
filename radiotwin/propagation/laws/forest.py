"""Forest: regression trees of scikit-learn as plain arrays that are safe to store and load.

scikit-learn stores trees as pickles, which run code when they are loaded. These arrays are data,
and predict the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from radiotwin.io.budgets import TREE_NODES
from radiotwin.propagation.laws.base import MAX_DB, require_array, require_names, require_number

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

BATCH = 4000  # rows predicted at a time: bounds memory
_ARRAYS = ("root", "feature", "threshold", "left", "right", "value")


@dataclass(frozen=True, eq=False)
class Forest:
    """The sum of t regression trees with m nodes in all; a leaf is its own child.

    Attributes:
        root: (t,) index of each tree's first node.
        feature: (m,) feature column that a node compares.
        threshold: (m,) values up to this go to the left child.
        left, right: (m,) index of the children, greater than the node's; of a leaf, its own.
        value: (m,) prediction of a leaf.
        constant: added to the sum.
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
        """Convert fitted extra trees, whose prediction is the mean of the trees."""
        trees, count = [tree.tree_ for tree in fitted.estimators_], len(fitted.estimators_)
        return cls._joined([(tree.children_left, tree.children_right, tree.feature, tree.threshold,
                             tree.value[:, 0, 0] / count) for tree in trees], 0.0)

    @classmethod
    def of_boosting(cls, fitted: HistGradientBoostingRegressor) -> Self:
        """Convert fitted gradient boosting; its features must not contain NaN."""
        trees: list[tuple[np.ndarray, ...]] = []
        for (predictor,) in fitted._predictors:  # the library has no public way to its nodes
            nodes = predictor.nodes
            leaf = nodes["is_leaf"].astype(bool)
            trees.append((np.where(leaf, -1, nodes["left"].astype(int)),
                          np.where(leaf, -1, nodes["right"].astype(int)), nodes["feature_idx"],
                          nodes["num_threshold"], nodes["value"]))
        return cls._joined(trees, float(np.ravel(fitted._baseline_prediction)[0]))

    @classmethod
    def _joined(cls, trees: list[tuple[np.ndarray, ...]], constant: float) -> Self:
        """Join trees, given as (left, right, feature, threshold, value); left < 0 at a leaf."""
        sizes = [len(tree[0]) for tree in trees]
        root = np.cumsum([0, *sizes[:-1]])
        node = np.arange(sum(sizes))
        left, right, feature, threshold, value = (np.concatenate(arrays) for arrays in zip(
            *trees, strict=True))
        leaf, shift = left < 0, np.repeat(root, sizes)
        return cls(root.astype(np.int32), np.where(leaf, 0, feature).astype(np.int16),
                   np.where(leaf, 0.0, threshold),
                   np.where(leaf, node, left + shift).astype(np.int32),
                   np.where(leaf, node, right + shift).astype(np.int32),
                   np.where(leaf, value, 0.0), constant)

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Return the prediction (n,) of the summed trees for feature rows (n, p)."""
        features = np.asarray(features, dtype=np.float32)  # as scikit-learn compares them
        total = np.full(len(features), self.constant)
        for start in range(0, len(features), BATCH):
            rows = slice(start, start + BATCH)
            batch = features[rows]
            node = np.broadcast_to(self.root, (len(batch), len(self.root)))
            index = np.arange(len(batch))[:, None]
            while True:
                goes_left = batch[index, self.feature[node]] <= self.threshold[node]
                child = np.where(goes_left, self.left[node], self.right[node])
                if (child == node).all():
                    break
                node = child
            total[rows] += self.value[node].sum(axis=1)
        return total

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays by name, and settings that JSON can hold, for `from_state`."""
        return {name: getattr(self, name) for name in _ARRAYS}, {"constant": self.constant}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   width: int) -> Self:
        """Restore a forest over `width` feature columns from its `state`, after checking it.

        BadInput if there are too many nodes; ValueError or KeyError if it is damaged.
        """
        require_names("arrays", arrays, _ARRAYS)
        require_names("settings", settings, ["constant"])
        nodes = len(arrays["value"])
        TREE_NODES.check(nodes, "the learnt residual")
        root = require_array(arrays, "root", (None,), 0, nodes - 1)
        feature = require_array(arrays, "feature", (nodes,), 0, width - 1)
        left, right = (require_array(arrays, name, (nodes,), 0, nodes - 1)
                       for name in ("left", "right"))
        node = np.arange(nodes)
        leaf = left == node
        # Children have greater indices than their parent, so that the descent ends.
        if not ((right == node) == leaf).all() or not (
                (left > node) & (right > node) | leaf).all():
            raise ValueError("a tree has a cycle")
        if any(array.dtype.kind not in "iu" for array in (root, feature, left, right)):
            raise ValueError("indices of nodes are not integers")
        return cls(root, feature, require_array(arrays, "threshold", (nodes,), -1e9, 1e9), left,
                   right, require_array(arrays, "value", (nodes,), -MAX_DB, MAX_DB),
                   require_number(settings, "constant", -MAX_DB, MAX_DB))
