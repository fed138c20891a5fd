"""Other models on the same folds: laws, kriging, and regressions that know no physics."""

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
from radiotwin.runtime.pieces import kept
from radiotwin.twin.model.model import FittedModel

LAWS: tuple[type[ChannelModel], ...] = (LogDistance, SegmentedLogDistance, RegressionKriging)
EXTRA_TREES, BOOSTING = "extra_trees", "hist_gradient_boosting"
LEARNING_RATE = 0.1  # of 2 * TREES steps of boosting; of fewer steps as much more
MAX_TREE_LINKS = 30_000  # of more a sample: trees gain little by more, and take longer
TREES = 50  # a hundred err less by 0.5 %
MIN_LEAF = 3  # links in a leaf of the extremely randomised trees
MAX_FEATURES = 0.5  # share of the columns that a node may split: half the time of all, errors +1 %
MIN_INSIDE = 0.9  # share of links within a published law's validity, for it to be compared


@dataclass(frozen=True, eq=False)
class Part:
    """Links with what a regression is told of them, devices where a fold's base has them.

    Attributes:
        links: n links.
        known: (n, p) `features` where they are known already.
    """

    links: Links
    known: np.ndarray | None = None

    @cached_property
    def features(self) -> np.ndarray:
        """(n, p) of `link_features`."""
        return link_features(self.links) if self.known is None else self.known

    @property
    def common(self) -> np.ndarray:
        """(n, q) of them, without those that say which receiver it is."""
        devices = len(self.links.device_names)
        return self.features[:, :feature_count(devices, self.links.has_boresights)]

    def select(self, rows: np.ndarray) -> Part:
        """Return the links of an index array."""
        return Part(self.links.select(rows), self.features[rows])


def grow_trees(kind: str, features: np.ndarray, target: np.ndarray, seed: int,
               trees: int = TREES) -> Forest:
    """Fit an ensemble of regression trees.

    Args:
        kind: `EXTRA_TREES` (Geurts, Ernst and Wehenkel 2006, Machine Learning 63), or `BOOSTING`
            (histogram-based, as LightGBM: Ke et al. 2017, NIPS).
        features: (n, p).
        target: (n,).
        seed: of the trees, and of the sample that is taken of very many rows.
        trees: number of them; boosting takes twice as many.
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
    # Folds have threads of their own, and OpenMP's wait for each other busily: where a core has
    # other work, several take a hundred times as long as one.
    with _openmp().limit(limits=1):
        return Forest.of_boosting(boosting.fit(features, target))


@cache
def _openmp() -> ThreadpoolController:
    """Return what sets the threads of OpenMP, once scikit-learn is loaded."""
    return ThreadpoolController().select(user_api="openmp")


def trees_db(kind: str, part: Part, train: np.ndarray, test: np.ndarray, seed: int) -> np.ndarray:
    """Return what trees that were grown on some detected links predict of others [dB].

    Blanks are left out: with them at the level that kriging gives them, trees predict detected
    links worse. What they predict is therefore the level of a link that is detected.

    Args:
        kind: as of `grow_trees`.
        part: n links.
        train: (n,) bool or rows, to learn from.
        test: (m,) rows.
        seed: as of `grow_trees`.
    """
    rows = np.arange(len(part.links))[train]
    rows = rows[np.isfinite(part.links.level_db[rows])]

    def grow() -> np.ndarray:
        forest = grow_trees(kind, part.features[rows], part.links.level_db[rows], seed)
        return forest.predict(part.features[test])

    inputs = kind, part.features[rows], part.links.level_db[rows], part.features[test], seed, TREES
    return kept("trees", inputs, grow, lambda found: ({"mean_db": found}, None),
                lambda arrays, _: arrays["mean_db"])


def fitted_law(kind: type[ChannelModel], links: Links, train: np.ndarray,
               like: ChannelModel | None = None) -> ChannelModel:
    """Return a channel model that is fitted to some links.

    Args:
        kind: of model.
        links: n links.
        train: (n,) bool or rows, to learn from.
        like: kriging whose correlation is taken; None: it is fitted.
    """
    geometry, gain_db, limit_db = links.select(train).gains()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of classes with few links
        if isinstance(like, RegressionKriging):
            return like.refit(geometry, gain_db, limit_db)
        return fit_once(kind, geometry, gain_db, limit_db, 0)


def law_db(law: ChannelModel, links: Links, test: np.ndarray) -> np.ndarray:
    """Return the mean readings of rows (m,) of links [dB], as a twin of the model predicts them."""
    return FittedModel.of_channel(law).predict(links.select(test)).reading_db


def held_out_baselines(model: CrossFit, parts: list[Part], seed: int
                       ) -> tuple[dict[str, np.ndarray], list[dict[str, ChannelModel]]]:
    """Return the held-out prediction of other models.

    Args:
        model: whose folds are used, and whose devices.
        parts: the links of each fold.
        seed: of the trees.

    Returns:
        (n,) prediction by each [dB], by name; and the `LAWS` of each fold, by name.
    """
    laws: list[dict[str, ChannelModel]] = []
    published = published_laws(model.links.select(model.whole.usable))
    names = [*(kind.name for kind in LAWS), EXTRA_TREES, BOOSTING,
             *(law.name for law in published)]
    result = {name: np.full(len(model.links), np.nan) for name in names}
    for number, (fold, part) in enumerate(zip(model.folds, parts, strict=True)):
        test = np.flatnonzero((model.index == number) & fold.usable)
        laws.append({kind.name: fitted_law(kind, part.links, fold.train) for kind in LAWS})
        for name, law in laws[-1].items():
            result[name][test] = law_db(law, part.links, test)
        for learner in (EXTRA_TREES, BOOSTING):
            result[learner][test] = trees_db(learner, part, fold.train, test, seed)
        for law in published:  # a device of unknown position is where the fold has it
            result[law.name][test] = law_db(law, part.links, test)
    return result, laws


def published_laws(links: Links) -> list[PublishedLaw]:
    """Return laws of recommendations, fitted to nothing.

    Of those that hold at the frequency and for most of the heights and distances. Levels must be
    gains, or powers of devices whose transmit power is declared: no recommendation knows it.

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
        except BadInput:  # another frequency, or no map
            continue
        if law.inside(data[0]).mean() >= MIN_INSIDE:
            laws.append(law)
    return laws
