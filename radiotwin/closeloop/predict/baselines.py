"""Baselines on the same folds: path-loss laws, kriging, published laws and tree ensembles."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from threadpoolctl import ThreadpoolController

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.errors import BadInput
from radiotwin.links import Links
from radiotwin.links.variables import feature_count, link_features
from radiotwin.propagation.laws import ChannelModel
from radiotwin.propagation.laws.forest import Forest
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.propagation.laws.published import PublishedLaw
from radiotwin.propagation.laws.registry import BUILT_IN, fit_once
from radiotwin.runtime.pieces import cached
from radiotwin.twin.model.model import FittedModel

LAWS: tuple[type[ChannelModel], ...] = (LogDistance, SegmentedLogDistance, RegressionKriging)
EXTRA_TREES, BOOSTING = "extra_trees", "hist_gradient_boosting"
LEARNING_RATE = 0.1  # of boosting with 2 * TREES steps; with fewer steps proportionally more
MAX_TREE_LINKS = 30_000  # more links are sampled: they hardly reduce the error
TREES = 50  # 100 reduce the error by 0.5 %
MIN_LEAF = 3  # links in a leaf of the extremely randomised trees
MAX_FEATURES = 0.5  # share of the columns tried in a node: half the time of all, errors +1 %
MIN_INSIDE = 0.9  # least share of links within a published law's range of validity


@dataclass(frozen=True, eq=False)
class Part:
    """Links with the features of tree ensembles; unknown devices are where a fold located them.

    Attributes:
        links: n links.
        known: (n, p) `features`, if they were computed already.
    """

    links: Links
    known: np.ndarray | None = None

    @cached_property
    def features(self) -> np.ndarray:
        """(n, p) features of the links, see `link_features`."""
        return link_features(self.links) if self.known is None else self.known

    @property
    def common(self) -> np.ndarray:
        """(n, q) features without the columns that identify the receiver."""
        devices = len(self.links.device_names)
        return self.features[:, :feature_count(devices, self.links.has_boresights)]

    def select(self, rows: np.ndarray) -> Part:
        """Return the part with the rows of an index array."""
        return Part(self.links.select(rows), self.features[rows])


def grow_trees(kind: str, features: np.ndarray, target: np.ndarray, seed: int,
               trees: int = TREES) -> Forest:
    """Fit an ensemble of regression trees.

    Args:
        kind: `EXTRA_TREES` (Geurts, Ernst and Wehenkel 2006, Machine Learning 63), or `BOOSTING`
            (histogram-based, as LightGBM: Ke et al. 2017, NIPS).
        features: (n, p) features.
        target: (n,) values to predict, such as levels [dB].
        seed: random seed of the trees, and of the sample of rows.
        trees: number of trees; boosting grows twice as many.
    """
    from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

    if len(target) > MAX_TREE_LINKS:
        rows = np.sort(np.random.default_rng(seed).choice(len(target), MAX_TREE_LINKS, False))
        features, target = features[rows], target[rows]
    if kind == EXTRA_TREES:
        return Forest.of_extra_trees(ExtraTreesRegressor(
            trees, min_samples_leaf=MIN_LEAF, max_features=MAX_FEATURES, random_state=seed,
            n_jobs=1).fit(features, target))
    boosting = HistGradientBoostingRegressor(
        learning_rate=LEARNING_RATE * TREES / trees, max_iter=2 * trees, early_stopping=False,
        random_state=seed)
    # OpenMP's threads wait busily: together with the folds' threads they take up to 100 times as
    # long as a single one.
    with _openmp().limit(limits=1):
        return Forest.of_boosting(boosting.fit(features, target))


@cache
def _openmp() -> ThreadpoolController:
    """Return the controller of OpenMP's threads; call it after scikit-learn is loaded."""
    return ThreadpoolController().select(user_api="openmp")


def trees_db(kind: str, part: Part, train: np.ndarray, test: np.ndarray, seed: int) -> np.ndarray:
    """Grow trees on the detected links of some rows, and predict the levels of others (m,) [dB].

    Blanks are left out, so the prediction is the level given that the link is detected. Imputing
    blanks made predictions of detected links worse.

    Args:
        kind: see `grow_trees`.
        part: n links.
        train: (n,) bool or rows of the training links.
        test: (m,) rows to predict.
        seed: random seed, see `grow_trees`.
    """
    rows = np.arange(len(part.links))[train]
    rows = rows[np.isfinite(part.links.level_db[rows])]

    def grow() -> np.ndarray:
        forest = grow_trees(kind, part.features[rows], part.links.level_db[rows], seed)
        return forest.predict(part.features[test])

    inputs = kind, part.features[rows], part.links.level_db[rows], part.features[test], seed, TREES
    return cached("trees", inputs, grow, lambda found: ({"mean_db": found}, None),
                  lambda arrays, _: arrays["mean_db"])


def fitted_law(kind: type[ChannelModel], links: Links, train: np.ndarray,
               like: ChannelModel | None = None) -> ChannelModel:
    """Fit a channel model to some rows of links.

    Args:
        kind: class of the channel model.
        links: n links.
        train: (n,) bool or rows of the training links.
        like: kriging whose correlation function is reused; None: everything is fitted.
    """
    geometry, gain_db, limit_db = links.select(train).gains()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of few LoS or NLoS links
        if isinstance(like, RegressionKriging):
            return like.refit(geometry, gain_db, limit_db)
        return fit_once(kind, geometry, gain_db, limit_db, 0)


def law_db(law: ChannelModel, links: Links, test: np.ndarray) -> np.ndarray:
    """Predict the mean readings (m,) [dB] of rows (m,) of links by a channel model alone."""
    return FittedModel.of_channel(law).predict(links.select(test)).reading_db


def held_out_baselines(model: CrossFit, parts: list[Part], seed: int
                       ) -> tuple[dict[str, np.ndarray], list[dict[str, ChannelModel]]]:
    """Predict held-out links by each baseline.

    Args:
        model: cross-validated fit with the folds and device positions to use.
        parts: the links with the device positions of each fold.
        seed: random seed of the trees.

    Returns:
        (n,) predictions [dB] by the baseline's name; and the fitted `LAWS` of each fold, by name.
    """
    laws: list[dict[str, ChannelModel]] = []
    published = published_laws(model.links.select(model.whole.usable))
    names = [*(kind.name for kind in LAWS), EXTRA_TREES, BOOSTING,
             *(law.name for law in published)]
    result = {name: np.full(len(model.links), np.nan) for name in names}
    for number, (fold, part) in enumerate(zip(model.folds, parts, strict=True)):
        test = np.flatnonzero((model.index == number) & fold.usable)
        laws.append({kind.name: fitted_law(kind, part.links, fold.train) for kind in LAWS})
        for law in (*laws[-1].values(), *published):
            result[law.name][test] = law_db(law, part.links, test)
        for learner in (EXTRA_TREES, BOOSTING):
            result[learner][test] = trees_db(learner, part, fold.train, test, seed)
    return result, laws


def published_laws(links: Links) -> list[PublishedLaw]:
    """Return the published laws (recommendations) that are valid for most links; nothing is fitted.

    Empty for power readings without declared transmit powers, which no recommendation can predict.

    Args:
        links: n links.
    """
    if not links.has_gains or np.isnan(links.frequency_hz):
        return []
    laws, data = [], links.gains()
    for kind in BUILT_IN:
        if not issubclass(kind, PublishedLaw):
            continue
        try:
            law = kind().fit(*data)
        except BadInput:  # not valid at the frequency, or the law needs a map
            continue
        if law.inside(data[0]).mean() >= MIN_INSIDE:
            laws.append(law)
    return laws
