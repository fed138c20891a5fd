"""A base with effects, fitted to all links and, for each fold, to all links outside it.

Folds say which links are held out together. A base is a kind of twin that can be fitted to any of
the links; its residual on held-out links is what effects have to explain.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp
from typing_extensions import override

from radiotwin.effects.arrays import subsample
from radiotwin.errors import BadInput
from radiotwin.inference.held_out import deal_groups
from radiotwin.inference.student import mean_if_detected
from radiotwin.links import Links, with_evidence
from radiotwin.links.correlation import moving_end_m
from radiotwin.links.evidence import evidence_width_m
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.scene import Scene
from radiotwin.twin.fit_links import fit_known, fit_links, reliable_m
from radiotwin.twin.fit_paths import LOST_M, best_dof, fit_paths, relocation_from
from radiotwin.twin.localize import TwinDevice
from radiotwin.twin.model.model import Fit, Model
from radiotwin.twin.twin import Twin

WAYS = ("flight", "block", "quadrant", "device")
MIN_FLIGHTS = 4  # that most devices and receivers must be in, for flights to be held out
MAX_FOLDS = 6
BLOCK_M = 60.0  # side of a block on the ground
MIN_BLOCKS = 10
MIN_CLUSTERS = 6  # places that are held out one by one
STRETCHES = 4  # of each fold, where nothing moves
MAX_ENDS = 500  # more are positions of one end that moves, and need not return
QUALITIES = 16  # quantiles of the column `quality` that a map's prediction is averaged over
MAX_RADIUS_M = 100.0  # of a device's circle by the law, for paths to be followed to locate it
FIRST_LOOK_LINKS = 300  # whose paths are followed first; minutes on a map of many buildings
MIN_GAIN_DB = 0.1  # of the error of these, for the paths of all to be followed


@dataclass(frozen=True, eq=False)
class Folds:
    """A partition of n links.

    Attributes:
        by: one of `WAYS`.
        index: (n,) fold of each link; -1 = never held out.
    """

    by: str
    index: np.ndarray

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.index.max()) + 1


def make_folds(links: Links, seed: int, by: str = "auto") -> Folds:
    """Return which links are held out together.

    Args:
        links: n links.
        seed: of which go together.
        by: one of `WAYS`; or `auto`: by flight where most links are of devices and receivers that
            are in at least `MIN_FLIGHTS`, else by blocks on the ground.

    Raises:
        BadInput: an unknown way, or one that these data do not allow.
    """
    rng = np.random.default_rng(seed)
    if by == "auto":
        by = "flight" if _flights_are_alike(links) else "block"
    if by in ("flight", "quadrant"):
        groups = links.flight if by == "flight" else _quadrants(links)
        return Folds(by, deal_groups(_require_several(groups, by), MAX_FOLDS, rng))
    if by == "device":
        # A device whose position is to be found from its own links cannot be left out.
        known = np.isin(links.device, sorted(links.anchors))
        _require_several(links.device[known], by)
        index = np.full(len(links), -1)
        index[known] = deal_groups(links.device[known], MAX_FOLDS, rng)
        return Folds(by, index)
    if by != "block":
        raise BadInput(f"links cannot be held out by {by!r}; allowed are auto, {', '.join(WAYS)}")
    return Folds(by, deal_groups(_blocks(links), MAX_FOLDS, rng))


def _blocks(links: Links) -> np.ndarray:
    """Return labels (n,) of squares of ground of the end that moves, or of stretches of time.

    Where `BLOCK_M` is too wide for `MIN_BLOCKS`, squares are smaller. Clusters of positions that no
    square parts are held out as they are; where there are too few of them, stretches are.
    """
    width_m = evidence_width_m(links, BLOCK_M, MIN_BLOCKS)
    cell = np.floor(moving_end_m(links)[:, :2] / width_m).astype(np.int64)
    block = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    if block.max() + 1 >= MIN_CLUSTERS:
        return block
    order = np.lexsort((np.arange(len(links)), links.time_s, links.flight))
    stretch = np.empty(len(links), dtype=int)
    stretch[order] = np.arange(len(links)) * MAX_FOLDS * STRETCHES // len(links)
    return stretch


def _quadrants(links: Links) -> np.ndarray:
    """Return labels (n,) of the four parts of the area on either side of its middle link.

    Each is a piece of ground that no other link is near to: what is learnt has to extrapolate.
    """
    end_m = moving_end_m(links)[:, :2]
    east, north = (end_m > np.median(end_m, axis=0)).T
    return 2 * east + north


def _require_several(index: np.ndarray, by: str) -> np.ndarray:
    if len(np.unique(index)) < 2:
        declared = " declared" * (by == "device")
        raise BadInput(f"links cannot be held out by {by}: there are fewer than two{declared}; "
                       "hold them out by block, or leave the choice to auto")
    return index


def _flights_are_alike(links: Links) -> bool:
    if len(np.unique(links.flight)) < MIN_FLIGHTS:
        return False
    seen = np.bincount(links.flight[np.isfinite(links.level_db)])
    if seen.max() > 0.5 * seen.sum():  # what is left without that flight would say little
        return False
    for end in (links.device, links.receiver):
        pairs = np.unique(np.column_stack([end, links.flight]), axis=0)
        ends, row = np.unique(end, return_inverse=True)
        flights = np.bincount(np.searchsorted(ends, pairs[:, 0]))
        if len(ends) <= MAX_ENDS and np.median(flights[row]) < MIN_FLIGHTS:
            return False
    return True


class Base(ABC):
    """A kind of twin.

    Attributes:
        max_radius_m: devices with a wider circle say nothing about the channel [m].
    """

    name: ClassVar[str]
    max_radius_m: ClassVar[float] = np.inf

    @abstractmethod
    def fit(self, links: Links) -> Twin:
        """Fit to links.

        Raises:
            BadInput: they are too few or of no use.
        """

    def device_m(self, twin: Twin) -> np.ndarray:
        """Return positions (k, 3) of a twin's devices that may be relied on [m]; else NaN."""
        return reliable_m(twin.devices, self.max_radius_m)


class LogDistanceBase(Base):
    """One exponent and one intercept for all links (ITU-R P.1411: basic transmission loss)."""

    name = "log-distance"

    def __init__(self, scene: Scene | None, seed: int) -> None:
        self._scene, self._seed = scene, seed

    @override
    def fit(self, links: Links) -> Twin:
        if np.isfinite(links.device_m).all():
            return fit_known(links, LogDistance, self._seed)
        assert self._scene is not None  # without one, links of unlocated devices are left out
        return fit_links(links, self._scene, LogDistance, self._seed)


class TwinBase(Base):
    """The segmented law, and devices where it locates them."""

    name = "twin"
    max_radius_m = LOST_M

    def __init__(self, scene: Scene | None, seed: int) -> None:
        self.scene, self._seed = scene, seed
        # The base that follows paths asks for the same fits again.
        self._fitted: WeakKeyDictionary[Links, Twin] = WeakKeyDictionary()

    @override
    def fit(self, links: Links) -> Twin:
        if links not in self._fitted:
            if self.scene is None:
                self._fitted[links] = fit_known(links, SegmentedLogDistance, self._seed)
            else:
                self._fitted[links] = fit_links(links, self.scene, SegmentedLogDistance, self._seed)
        return self._fitted[links]


class RaytraceBase(Base):
    """Paths over the 3D map, and unknown devices where they explain the levels best.

    A device stays where the law has it if that is less sure than `MAX_RADIUS_M`: one that is surely
    elsewhere, because of what the map lacks, would be taken for an effect. All parts of the links
    are fitted in one process, as they ask for the same paths.
    """

    name = "raytrace"
    max_radius_m = LOST_M

    def __init__(self, law: TwinBase) -> None:
        assert law.scene is not None
        self._law, self._scene = law, law.scene
        self._relocation = relocation_from(law.scene, MAX_RADIUS_M)

    @override
    def fit(self, links: Links) -> Twin:
        return fit_paths(links, self._scene, self._law.fit(links), self._relocation)

    def locate(self, links: Links, channel: ImagePaths) -> list[TwinDevice]:
        """Return the devices where paths over the map of links put them, by a fitted channel."""
        return self._relocation.relocate(links, self._law.fit(links).devices, channel)


BASES = (TwinBase.name, RaytraceBase.name, LogDistanceBase.name)


def make_bases(scene: Scene | None, seed: int) -> dict[str, Base]:
    """Return every kind of base that a scene allows, by name."""
    twin = TwinBase(scene, seed)
    bases: dict[str, Base] = {twin.name: twin, LogDistanceBase.name: LogDistanceBase(scene, seed)}
    if scene is not None:
        bases[RaytraceBase.name] = RaytraceBase(twin)
    return bases


@dataclass(eq=False)
class CrossFit:
    """A base with effects, of all links and of each fold's others.

    Attributes:
        whole: learnt from all links.
        folds: learnt from all but one fold each.
        index: (n,) fold of each link.
        twin: the base as it was fitted to all links.
    """

    whole: Fit
    folds: tuple[Fit, ...]
    index: np.ndarray
    twin: Twin

    @property
    def each(self) -> tuple[Fit, ...]:
        """The whole, then the folds."""
        return (self.whole, *self.folds)

    @property
    def links(self) -> Links:
        """The n links, with the devices where the base has them."""
        return self.whole.links

    def extended(self, whole: Fit, folds: Iterable[Fit]) -> CrossFit:
        """Return the same base with other effects."""
        return CrossFit(whole, tuple(folds), self.index, self.twin)

    def map(self, function: Callable[..., Fit], *further: Iterable[Any]) -> CrossFit:
        """Return what a function makes of the whole, then of the folds, as `extended` does.

        Args:
            function: of a fit, and of its own of each of the `further` arguments.
            further: for the whole, then for the folds.
        """
        whole, *folds = (function(*own) for own in zip(self.each, *further, strict=True))
        return self.extended(whole, folds)

    def held_out(self, of: Callable[[Fit], np.ndarray]) -> np.ndarray:
        """Return values (…, n) of each link, from the fold that has not seen it."""
        of_folds = [of(fold) for fold in self.folds]
        result = np.full(of_folds[0].shape, np.nan)
        for number, values in enumerate(of_folds):
            result[..., self.index == number] = values[..., self.index == number]
        return result

    @cached_property
    def held_out_reading(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) predicted reading and (n,) its error scale [dB], with shadowing; NaN = none."""
        mean_db, scale_db, unheard_db = self._held_out_parts
        shift, left = self.held_out_shadowing
        return mean_db + shift * scale_db, np.hypot(scale_db * left, unheard_db)

    @property
    def held_out_scales(self) -> np.ndarray:
        """(2, n) error scale without shadowing, and sd of unheard levels [dB]; NaN = none."""
        return self._held_out_parts[1:]

    @cached_property
    def _held_out_parts(self) -> np.ndarray:
        return self.held_out(lambda fold: np.array(fold.reading_parts()))

    @cached_property
    def held_out_nll(self) -> np.ndarray:
        """(n,) negative log-likelihood [nats]; NaN where there is none."""
        reading = self.held_out_reading
        return self.held_out(lambda fold: np.where(
            fold.usable, fold.model.regression().nll_at(*reading), np.nan))

    @cached_property
    def held_out_mean_db(self) -> np.ndarray:
        """(n,) predicted level of a link that is detected [dB]; NaN where there is none."""
        reading = self.held_out_reading
        return self.held_out(lambda fold: np.where(
            fold.usable, mean_if_detected(*reading, fold.model.limit_db, fold.model.dof,
                                          fold.model.losses), np.nan))

    @property
    def reads_quality(self) -> bool:
        """Whether an effect reads the links' own quality, which no map has."""
        return self.links.quality is not None and any(
            "quality" in each.uses for each in self.whole.effects)

    @cached_property
    def on_map(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) held-out mean [dB] and (n,) negative log-likelihood [nats], as a map has them.

        A map does not know a link's own quality: the prediction is averaged over that of the
        training links.
        """
        if not self.reads_quality:
            return self.held_out_mean_db, self.held_out_nll
        shares = (np.arange(QUALITIES) + 0.5) / QUALITIES
        each = [_with_quality(self, share) for share in shares.tolist()]
        return (np.mean([model.held_out_mean_db for model in each], axis=0),
                np.log(QUALITIES) - logsumexp([-model.held_out_nll for model in each], axis=0))

    @cached_property
    def unforeseen(self) -> np.ndarray:
        """(n,) bool, links on which a fault acts that was not there when their fold learnt.

        What happens on a flight cannot be known before it: such links say nothing of the rest.
        """
        found = np.zeros(len(self.index), dtype=bool)
        for number, fold in enumerate(self.folds):
            for effect, term, place in zip(self.whole.effects, self.whole.model.terms,
                                           same_effects(self.whole, fold), strict=True):
                if effect.within_flights and place is None:
                    found |= (self.index == number) & term.acts
        return found

    def rmse_db(self, rows: np.ndarray | None = None) -> float:
        """Return the held-out RMSE of the detected links of a mask (n,), or of all [dB]."""
        return _rms(self.links.level_db - self.held_out_mean_db, rows)

    def rmse_on_map_db(self) -> float:
        """Return the held-out RMSE of all detected links, as a map has it [dB]."""
        return _rms(self.links.level_db - self.on_map[0])

    @cached_property
    def held_out_shadowing(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) what shadowing adds [error scales], and (n,) the share left of the scale."""
        shift, left = np.zeros(len(self.index)), np.ones(len(self.index))
        for number, fold in enumerate(self.folds):
            own = np.flatnonzero(self.index == number)
            if fold.shadowing is not None:
                shift[own], left[own] = fold.shadowing.at(fold.links.select(own))
        return shift, left


def same_effects(whole: Fit, fold: Fit) -> list[int | None]:
    """Return the place in a fold of each effect of the whole; None for what it has not found.

    Of several of a kind those are the same that act on the same links: one faulty flight is not
    another. Where a fold has as many, each is one of them, if in another order.
    """
    places: list[int | None] = [None] * len(whole.effects)
    for entry in dict.fromkeys(each.entry for each in whole.effects):
        of_whole, of_fold = ([place for place, each in enumerate(model.effects)
                              if each.entry is entry] for model in (whole, fold))
        for place, found in _on_the_same_links(whole, fold, of_whole, of_fold):
            places[place] = found
    return places


def _on_the_same_links(whole: Fit, fold: Fit, of_whole: list[int],
                       of_fold: list[int]) -> list[tuple[int, int]]:
    """Return pairs of places of one kind of effect whose links overlap most, all in all."""
    as_many = len(of_whole) == len(of_fold)
    if as_many and len(of_whole) == 1:
        return [(of_whole[0], of_fold[0])]
    # Where nothing tells them apart, the order in which they were found does.
    shared = np.eye(len(of_whole), len(of_fold)) * 1e-9
    for row, place in enumerate(of_whole):
        acts = whole.model.terms[place].acts
        for column, found in enumerate(of_fold):
            others = fold.model.terms[found].acts
            shared[row, column] += (acts & others).sum() / max((acts | others).sum(), 1)
    return [(of_whole[row], of_fold[column])
            for row, column in zip(*linear_sum_assignment(shared, maximize=True), strict=True)
            if as_many or shared[row, column] > 1e-9]


def _rms(error: np.ndarray, rows: np.ndarray | None = None) -> float:
    error = error if rows is None else error[rows]
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan


def _with_quality(model: CrossFit, share: float) -> CrossFit:
    """Return a model whose held-out links all have one quality, a quantile of the training links'.

    Nothing is fitted again.
    """
    def blind(each: Fit) -> Fit:
        own = each.links.quality
        assert own is not None
        known = own[each.train & np.isfinite(own)]
        usual = float(np.quantile(known, share)) if len(known) else np.nan
        links = each.links.with_columns(quality=np.where(each.train, own, usual))
        terms = tuple(term if "quality" not in effect.uses
                      else effect.term(links, each.model.level_at)
                      for effect, term in zip(each.effects, each.model.terms, strict=True))
        return replace(each, model=replace(each.model, links=links, terms=terms))

    return model.map(blind)


def training_parts(links: Links, folds: Folds) -> list[Links]:
    """Return the links outside each fold; the same objects serve every base."""
    return [links.select(folds.index != number) for number in range(folds.count)]


def cross_validate(links: Links, base: Base, folds: Folds,
                   parts: list[Links]) -> CrossFit:
    """Fit a base to all links, and to those outside each fold.

    Args:
        links: n links.
        base: kind of model.
        folds: of the links.
        parts: `training_parts` of both.

    Raises:
        BadInput: links that the base cannot be fitted to.
    """
    twin = base.fit(links)
    device_m = base.device_m(twin)
    dof = best_dof(links, twin.channel, device_m)
    whole = Model.build(links, twin.channel, dof, device_m=device_m)
    links = _with_evidence(links, whole)
    columns = {"evidence": links.evidence, "known_los": whole.links.los}
    whole = replace(whole, links=replace(whole.links.with_columns(**columns), notes=links.notes))
    models = []
    for number, part in enumerate(parts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit to all links has warned already
            fitted = base.fit(part)
        models.append(Model.build(links, fitted.channel, dof, device_m=base.device_m(fitted),
                                      train=folds.index != number))
    return CrossFit(whole.fit(), tuple(each.fit() for each in models), folds.index, twin)


def best_base(models: dict[str, CrossFit]) -> str:
    """Return the base with the least held-out error of the links that all can predict.

    One that cannot locate the devices that are hard to predict does not win by that. Of several
    without a link in common, the one that predicts most.
    """
    known = {name: np.isfinite(model.links.level_db - model.held_out_mean_db)
             for name, model in models.items()}
    in_common = np.all(list(known.values()), axis=0)
    if not in_common.any():
        return max(known, key=lambda name: known[name].sum())
    return min(models, key=lambda name: models[name].rmse_db(in_common))


def paths_gain_db(links: Links, scene: Scene, folds: Folds, seed: int) -> float:
    """Return by how much paths make the held-out error of a few links of anchors smaller [dB].

    Following those of all links takes minutes to hours, and over maps whose buildings are guesses
    paths explain no more than line of sight does.

    Args:
        links: n links.
        scene: its map.
        folds: of the links.
        seed: as of `make_bases`.

    Returns:
        the gain over the law; infinite if so few links cannot tell.
    """
    known = np.isin(links.device, sorted(links.anchors)) & np.isfinite(links.level_db)
    rows = subsample(np.flatnonzero(known & (folds.index >= 0)), FIRST_LOOK_LINKS)
    kept = np.unique(folds.index[rows], return_inverse=True)[1].ravel()
    few, bases = links.select(rows), make_bases(scene, seed)
    few_folds = Folds(folds.by, kept)
    if len(rows) < FIRST_LOOK_LINKS or few_folds.count < 2:
        return np.inf
    parts = training_parts(few, few_folds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit to all links warns
            law, paths = (cross_validate(few, bases[name], few_folds, parts)
                          for name in (TwinBase.name, RaytraceBase.name))
    except BadInput:
        return np.inf
    common = np.isfinite(law.held_out_mean_db + paths.held_out_mean_db)
    return law.rmse_db(common) - paths.rmse_db(common)


def _with_evidence(links: Links, whole: Model) -> Links:
    """Return links with pieces of evidence that fit the base's residual, if they have none yet."""
    if links.evidence is not None:
        return links
    view, z = whole.fit().view, np.full(len(links), np.nan)
    z[whole.train] = view.residual_db / view.scale_db
    located = with_evidence(whole.links, z)
    return replace(links.with_columns(evidence=located.evidence), notes=located.notes)
