"""Cross-validate a base model and its effects: folds, bases, held-out predictions.

A base is a channel model with a way to locate unknown devices. It is fitted to all links, and once
for each fold to the links outside that fold. Effects, causes that the base lacks, have to explain
its held-out residual.
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
from radiotwin.inference.student import ReadingLaw
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
MIN_FLIGHTS = 4  # flights in which a typical device or receiver must be, to hold out flights
MAX_FOLDS = 6
BLOCK_M = 60.0  # side of a ground block [m]
MIN_BLOCKS = 10
MIN_CLUSTERS = 6  # with fewer separate places, stretches of time are held out instead
STRETCHES = 4  # stretches of time in each fold
MAX_ENDS = 500  # more "devices" are positions of one moving device, which need not recur in flights
QUALITIES = 16  # quantiles of the column `quality` over which a map's prediction is averaged
MAX_RADIUS_M = 100.0  # the law's credible radius up to which paths are used to locate a device [m]
FIRST_LOOK_LINKS = 300  # sample on which paths are tried: they take minutes on a large map
MIN_GAIN_DB = 0.1  # RMSE reduction on that sample from which the paths of all links are followed


@dataclass(frozen=True, eq=False)
class Folds:
    """Assignment of n links to folds.

    Attributes:
        by: what is held out together, one of `WAYS`.
        index: (n,) fold of each link; -1 = never held out.
    """

    by: str
    index: np.ndarray

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.index.max()) + 1


def make_folds(links: Links, seed: int, by: str = "auto") -> Folds:
    """Assign links to folds that are held out one after the other.

    Args:
        links: n links.
        seed: random seed of the assignment.
        by: one of `WAYS`; or `auto`: by flight if devices and receivers typically are in at least
            `MIN_FLIGHTS` flights, else by blocks of ground or of time. By device, links of unknown
            devices are never held out.

    Raises:
        BadInput: an unknown way, or too few flights, quadrants or anchors for it.
    """
    rng = np.random.default_rng(seed)
    if by == "auto":
        by = "flight" if _can_hold_out_flights(links) else "block"
    if by in ("flight", "quadrant"):
        groups = links.flight if by == "flight" else _quadrants(links)
        return Folds(by, deal_groups(_require_several(groups, by), MAX_FOLDS, rng))
    if by == "device":
        # An unknown device is located by its own links, so they cannot all be held out.
        known = np.isin(links.device, sorted(links.anchors))
        _require_several(links.device[known], by)
        index = np.full(len(links), -1)
        index[known] = deal_groups(links.device[known], MAX_FOLDS, rng)
        return Folds(by, index)
    if by != "block":
        raise BadInput(f"links cannot be held out by {by!r}; allowed are auto, {', '.join(WAYS)}")
    return Folds(by, deal_groups(_blocks(links), MAX_FOLDS, rng))


def _blocks(links: Links) -> np.ndarray:
    """Label links (n,) by ground square of the moving end, or by stretch of time.

    Squares are smaller than `BLOCK_M` if the area has fewer than `MIN_BLOCKS` of them. If even so
    the moving end was in fewer than `MIN_CLUSTERS`, consecutive stretches of time are used.
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
    """Label links (n,) by quadrant around the median position of the moving end.

    Few links outside a quadrant are near it, so a model has to extrapolate into it.
    """
    end_m = moving_end_m(links)[:, :2]
    east, north = (end_m > np.median(end_m, axis=0)).T
    return 2 * east + north


def _require_several(index: np.ndarray, by: str) -> np.ndarray:
    """Return group labels (n,) unchanged; raise BadInput if there are fewer than two groups."""
    if len(np.unique(index)) < 2:
        declared = " declared" * (by == "device")
        raise BadInput(f"links cannot be held out by {by}: there are fewer than two{declared}; "
                       "hold them out by block, or leave the choice to auto")
    return index


def _can_hold_out_flights(links: Links) -> bool:
    """Return whether the median link's device and receiver are in `MIN_FLIGHTS` flights or more.

    False if one flight has over half of the detected links. Over `MAX_ENDS` ends are not checked.
    """
    if len(np.unique(links.flight)) < MIN_FLIGHTS:
        return False
    seen = np.bincount(links.flight[np.isfinite(links.level_db)])
    if seen.max() > 0.5 * seen.sum():  # without that flight too little is left to learn from
        return False
    for end in (links.device, links.receiver):
        pairs = np.unique(np.column_stack([end, links.flight]), axis=0)
        ends, row = np.unique(end, return_inverse=True)
        flights = np.bincount(np.searchsorted(ends, pairs[:, 0]))
        if len(ends) <= MAX_ENDS and np.median(flights[row]) < MIN_FLIGHTS:
            return False
    return True


class Base(ABC):
    """A channel model with a way to locate unknown devices.

    Attributes:
        max_radius_m: links of devices with a larger credible radius are not used [m].
    """

    name: ClassVar[str]
    max_radius_m: ClassVar[float] = np.inf

    @abstractmethod
    def fit(self, links: Links) -> Twin:
        """Fit the channel and locate the unknown devices from links.

        Raises:
            BadInput: too few usable links.
        """

    def device_m(self, twin: Twin) -> np.ndarray:
        """Return a twin's device positions (k, 3) [m]; NaN if uncertain by over `max_radius_m`."""
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
        # Cached, since `RaytraceBase` starts from the same fits.
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
    """Paths over the 3D map; unknown devices are located where the paths explain the levels best.

    A device keeps the law's position if the law's credible radius is over `MAX_RADIUS_M`. Otherwise
    an error of the map could move it far away, and its links would look like an effect.
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
        """Locate unknown devices by paths over the links' own map, with a fitted channel."""
        return self._relocation.relocate(links, self._law.fit(links).devices, channel)


BASES = (TwinBase.name, RaytraceBase.name, LogDistanceBase.name)


def make_bases(scene: Scene | None, seed: int) -> dict[str, Base]:
    """Return all bases that are possible with a scene (None: no map), by name."""
    twin = TwinBase(scene, seed)
    bases: dict[str, Base] = {twin.name: twin, LogDistanceBase.name: LogDistanceBase(scene, seed)}
    if scene is not None:
        bases[RaytraceBase.name] = RaytraceBase(twin)
    return bases


@dataclass(eq=False)
class CrossFit:
    """A base with effects, fitted to all links and once without each fold.

    Attributes:
        whole: fit to all n links.
        folds: fits to the links outside each fold.
        index: (n,) fold of each link; -1 = never held out.
        twin: the base without effects, fitted to all links.
    """

    whole: Fit
    folds: tuple[Fit, ...]
    index: np.ndarray
    twin: Twin

    @property
    def fits(self) -> tuple[Fit, ...]:
        """The fit to all links, then the fit without each fold."""
        return (self.whole, *self.folds)

    @property
    def links(self) -> Links:
        """The n links, with unknown devices where the base located them."""
        return self.whole.links

    def with_fits(self, whole: Fit, folds: Iterable[Fit]) -> CrossFit:
        """Return the same base and folds with other fits, such as with one more effect."""
        return CrossFit(whole, tuple(folds), self.index, self.twin)

    def map(self, function: Callable[..., Fit], *further: Iterable[Any]) -> CrossFit:
        """Apply a function to the fit to all links and to the fit without each fold.

        Args:
            function: called with a fit, and with its element of each `further` argument.
            further: one element for each of `fits`.
        """
        whole, *folds = (function(*each) for each in zip(self.fits, *further, strict=True))
        return self.with_fits(whole, folds)

    def held_out(self, predict: Callable[[Fit], np.ndarray]) -> np.ndarray:
        """Predict each link by the fit to the links outside of its fold.

        Args:
            predict: returns values (…, n) of all links by one fold's fit.

        Returns:
            (…, n) values; NaN for links that are never held out.
        """
        predictions = [predict(fold) for fold in self.folds]
        result = np.full(predictions[0].shape, np.nan)
        for number, values in enumerate(predictions):
            result[..., self.index == number] = values[..., self.index == number]
        return result

    @cached_property
    def held_out_reading(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) held-out level, predicted as if there were no limit of detection; its scale [dB].

        Interpolated shadowing is included. NaN if never held out, or the device is not located.
        """
        mean_db, scale_db, unheard_db = self._held_out_parts
        shift, scale_left = self.held_out_shadowing
        return mean_db + shift * scale_db, np.hypot(scale_db * scale_left, unheard_db)

    @property
    def held_out_scales(self) -> np.ndarray:
        """(2, n) held-out error scale without shadowing, and sd of unheard levels [dB]; or NaN."""
        return self._held_out_parts[1:]

    @cached_property
    def _held_out_parts(self) -> np.ndarray:
        return self.held_out(lambda fold: np.array(fold.reading_parts()))

    @cached_property
    def held_out_nll(self) -> np.ndarray:
        """(n,) held-out negative log-likelihood [nats]; NaN without a prediction."""
        reading = self.held_out_reading
        return self.held_out(lambda fold: np.where(
            fold.usable, fold.model.regression().nll_at(*reading), np.nan))

    @cached_property
    def held_out_mean_db(self) -> np.ndarray:
        """(n,) held-out mean level, given that the link is detected [dB]; NaN if not predicted."""
        reading = self.held_out_reading
        return self.held_out(lambda fold: np.where(
            fold.usable, ReadingLaw(*reading, fold.model.limit_db, fold.model.dof,
                                    fold.model.losses).reading_db, np.nan))

    @property
    def reads_quality(self) -> bool:
        """Whether an effect depends on the column `quality`, which a map does not have."""
        return self.links.quality is not None and any(
            "quality" in each.uses for each in self.whole.effects)

    @cached_property
    def on_map(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) held-out mean [dB] and (n,) negative log-likelihood [nats], as a map would predict.

        A map does not know the column `quality` of a link, so the prediction is averaged over the
        qualities of the training links.
        """
        if not self.reads_quality:
            return self.held_out_mean_db, self.held_out_nll
        quantiles = (np.arange(QUALITIES) + 0.5) / QUALITIES
        models = [_with_quality(self, quantile) for quantile in quantiles.tolist()]
        return (np.mean([model.held_out_mean_db for model in models], axis=0),
                np.log(QUALITIES) - logsumexp([-model.held_out_nll for model in models], axis=0))

    @cached_property
    def not_learnable(self) -> np.ndarray:
        """(n,) bool, links affected by a fault that no training link of their fold shows.

        A fault of one flight cannot be predicted from other flights, so such links are not scored.
        """
        found = np.zeros(len(self.index), dtype=bool)
        for number, fold in enumerate(self.folds):
            for effect, term, match in zip(self.whole.effects, self.whole.model.terms,
                                           match_effects(self.whole, fold), strict=True):
                if effect.within_flights and match is None:
                    found |= (self.index == number) & term.acts
        return found

    @cached_property
    def learnable(self) -> np.ndarray:
        """(n,) bool, links that can be predicted from others: no fault or change lies between."""
        found = ~self.not_learnable
        for number, fold in enumerate(self.folds):
            for effect in self.whole.effects:
                found &= (self.index != number) | ~effect.untold(self.links, fold.train)
        return found

    def rmse_db(self, rows: np.ndarray | None = None) -> float:
        """Return the held-out RMSE of detected links in a mask (n,) [dB]; None: of all links."""
        return _rms(self.links.level_db - self.held_out_mean_db, rows)

    def rmse_on_map_db(self, rows: np.ndarray | None = None) -> float:
        """Return `rmse_db` of the prediction as a map has it [dB]."""
        return _rms(self.links.level_db - self.on_map[0], rows)

    @cached_property
    def held_out_shadowing(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) held-out interpolated shadowing over the error scale; (n,) scale left, 0 to 1."""
        shift, scale_left = np.zeros(len(self.index)), np.ones(len(self.index))
        for number, fold in enumerate(self.folds):
            rows = np.flatnonzero(self.index == number)
            if fold.shadowing is not None:
                shift[rows], scale_left[rows] = fold.shadowing.at(fold.links.select(rows))
        return shift, scale_left


def match_effects(whole: Fit, fold: Fit) -> list[int | None]:
    """Find each effect of the fit to all links among the effects of a fold's fit.

    Effects of one kind are paired so that the links on which both act overlap most. Pairs without
    a common link count only if both fits have equally many effects of that kind.

    Returns:
        for each effect of `whole`, its index in `fold.effects`; None if the fold lacks it.
    """
    matches: list[int | None] = [None] * len(whole.effects)
    for entry in dict.fromkeys(each.entry for each in whole.effects):
        in_whole, in_fold = ([number for number, each in enumerate(model.effects)
                              if each.entry is entry] for model in (whole, fold))
        as_many = len(in_whole) == len(in_fold)
        # Equal overlaps are matched in the order in which the effects were found.
        overlap = np.eye(len(in_whole), len(in_fold)) * 1e-9
        for row, number in enumerate(in_whole):
            acts = whole.model.terms[number].acts
            for column, other in enumerate(in_fold):
                acts_in_fold = fold.model.terms[other].acts
                overlap[row, column] += ((acts & acts_in_fold).sum()
                                         / max((acts | acts_in_fold).sum(), 1))
        for row, column in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            if as_many or overlap[row, column] > 1e-9:
                matches[in_whole[row]] = in_fold[column]
    return matches


def _rms(error: np.ndarray, rows: np.ndarray | None = None) -> float:
    """Return the RMS of the known values of an error (n,) in a mask (n,); NaN if none is known."""
    error = error if rows is None else error[rows]
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan


def _with_quality(model: CrossFit, quantile: float) -> CrossFit:
    """Set the quality of held-out links to a quantile (0 to 1) of the training links'; no refit."""
    def with_quantile(each: Fit) -> Fit:
        quality = each.links.quality
        assert quality is not None
        known = quality[each.train & np.isfinite(quality)]
        usual = float(np.quantile(known, quantile)) if len(known) else np.nan
        links = each.links.with_columns(quality=np.where(each.train, quality, usual))
        terms = tuple(term if "quality" not in effect.uses
                      else effect.term(links, each.model.level_at)
                      for effect, term in zip(each.effects, each.model.terms, strict=True))
        return replace(each, model=replace(each.model, links=links, terms=terms))

    return model.map(with_quantile)


def training_parts(links: Links, folds: Folds) -> list[Links]:
    """Return the training links of each fold; bases cache their fits by these objects."""
    return [links.select(folds.index != number) for number in range(folds.count)]


def cross_validate(links: Links, base: Base, folds: Folds,
                   parts: list[Links] | None = None) -> CrossFit:
    """Fit a base to all links, and to the links outside each fold.

    Args:
        links: n links.
        base: what to fit.
        folds: assignment of the links.
        parts: `training_parts(links, folds)`, if several bases share them; None: computed here.

    Raises:
        BadInput: too few usable links.
    """
    parts = training_parts(links, folds) if parts is None else parts
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
    """Return the name of the base with the least held-out RMSE on the links that all bases predict.

    So a base does not win by failing to locate difficult devices. If there is no such link, the
    base that predicts most links is returned.
    """
    known = {name: np.isfinite(model.links.level_db - model.held_out_mean_db)
             for name, model in models.items()}
    in_common = np.all(list(known.values()), axis=0)
    if not in_common.any():
        return max(known, key=lambda name: known[name].sum())
    return min(models, key=lambda name: models[name].rmse_db(in_common))


def paths_gain_db(links: Links, scene: Scene, folds: Folds, seed: int) -> float:
    """Return the held-out RMSE that following paths (reflections, …) saves on a sample [dB].

    Paths of all links take hours, and explain little over maps with guessed building heights.

    Args:
        links: n links.
        scene: 3D map and radio.
        folds: assignment of the links.
        seed: random seed, see `make_bases`.

    Returns:
        RMSE of the segmented law minus RMSE with paths, on detected links of anchors; inf if they
        are too few to fit.
    """
    known = np.isin(links.device, sorted(links.anchors)) & np.isfinite(links.level_db)
    rows = subsample(np.flatnonzero(known & (folds.index >= 0)), FIRST_LOOK_LINKS)
    fold = np.unique(folds.index[rows], return_inverse=True)[1].ravel()
    sample, bases = links.select(rows), make_bases(scene, seed)
    sample_folds = Folds(folds.by, fold)
    if len(rows) < FIRST_LOOK_LINKS or sample_folds.count < 2:
        return np.inf
    parts = training_parts(sample, sample_folds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit to all links warns
            law, paths = (cross_validate(sample, bases[name], sample_folds, parts)
                          for name in (TwinBase.name, RaytraceBase.name))
    except BadInput:
        return np.inf
    common = np.isfinite(law.held_out_mean_db + paths.held_out_mean_db)
    return law.rmse_db(common) - paths.rmse_db(common)


def _with_evidence(links: Links, whole: Model) -> Links:
    """Group links with correlated residuals into pieces of evidence, unless they have some."""
    if links.evidence is not None:
        return links
    view, z = whole.fit().view, np.full(len(links), np.nan)
    z[whole.train] = view.residual_db / view.scale_db
    located = with_evidence(whole.links, z)
    return replace(links.with_columns(evidence=located.evidence), notes=located.notes)
