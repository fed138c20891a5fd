"""The contract of effects: causes that change levels, proposed from residuals and fitted.

An effect belongs to one stage. In this order a level passes through them:

    paths      power that is added to what the channel predicts, before any gain
    gain       decibels that are added
    receiver   what the receiver makes of the level that arrives
    limit      below which level a link is blank
    detection  which links are blank, or weaker, now and then whatever their level

What an effect sees of the training links is a `ResidualView`. All that the loop and the pages ask
of an effect is a method or an attribute here, with a default; `docs/add-an-effect.md` lists them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, Self

import numpy as np

from radiotwin.effects.arrays import LinkCache
from radiotwin.effects.params import (
    Allowed,
    EffectParams,
    Estimate,
    Parameter,
    Variation,
    quantities,
)
from radiotwin.effects.places import Correction, Mark
from radiotwin.inference.student import Losses
from radiotwin.links import Links, design_effect, evidence_blocks

if TYPE_CHECKING:
    from collections.abc import Iterable

    from radiotwin.effects.patterns import Pattern
    from radiotwin.scene.citymap import CityMap


@dataclass(frozen=True, eq=False)
class Term:
    """Contribution of an effect to the mean level of n links, for given parameters.

    Attributes:
        offset_db: (n,) added as it is [dB].
        columns: (n, q) added times coefficients, which the regression fits.
        prior_sd_db: (q,) prior standard deviation of each coefficient around zero.
        inputs: (n, …) what the effect's `response` needs of each link; None = nothing.
        random_effect_sd_db: (n,) standard deviation of what it adds to each link by itself [dB];
            None = nothing.
        unheard_sd_db: (n,) standard deviation of a level that links have in common and of which
            nothing was learnt, as of a device without a reading [dB]; None = all are known.
    """

    offset_db: np.ndarray
    columns: np.ndarray
    prior_sd_db: np.ndarray
    inputs: np.ndarray | None = None
    random_effect_sd_db: np.ndarray | None = None
    unheard_sd_db: np.ndarray | None = None

    @property
    def acts(self) -> np.ndarray:
        """(n,) bool, links whose level it may change."""
        return (self.offset_db != 0) | (self.columns != 0).any(axis=1)

    def select(self, rows: np.ndarray) -> Term:
        """Return the term of the links of a mask or an index array."""
        inputs, scatter_db, unheard_db = (
            None if each is None else each[rows]
            for each in (self.inputs, self.random_effect_sd_db, self.unheard_sd_db))
        return Term(self.offset_db[rows], self.columns[rows], self.prior_sd_db, inputs,
                    scatter_db, unheard_db)

    @classmethod
    def of_columns(cls, columns: np.ndarray, prior_sd_db: float) -> Term:
        """Return a term that is all linear: columns (n, q)."""
        sd_db = np.full(columns.shape[1], float(prior_sd_db))
        return cls(np.zeros(len(columns)), columns, sd_db)

    @classmethod
    def of_offset(cls, offset_db: np.ndarray) -> Term:
        """Return a term without coefficients: (n,) [dB]."""
        return cls(offset_db, np.zeros((len(offset_db), 0)), np.zeros(0))

    @classmethod
    def of_inputs(cls, inputs: np.ndarray) -> Term:
        """Return a term that adds nothing and carries inputs (n, …) of a response."""
        n = len(inputs)
        return cls(np.zeros(n), np.zeros((n, 0)), np.zeros(0), inputs)


# Levels of the channel that a term is made of: quick ones, those of paths that are known already,
# or those of paths that are followed anew.
Levels = Literal["quick", "known_paths", "exact"]


class Change(NamedTuple):
    """A change in time of one receiver or device.

    Attributes:
        end: (n,) index of the receiver, or the device, of each link.
        member: the one that changed.
        when_s: from when on it is otherwise [s].
    """

    end: np.ndarray
    member: int
    when_s: float


class Effect(ABC):
    """One effect of the catalogue. Subclass one of the stages below, not this.

    Attributes:
        name: as in `closeloop.json`.
        variant: which of several physical forms of that name.
        in_words: what is said to be the cause where it is one; "" = its name.
        stage: where in the chain it acts, see the module.
        Params: its parameters, a subclass of `EffectParams`.
        figure: key of the figure that shows it (`radiotwin.report`); "" = residual against the
            variable that it acts through.
        nlos_only: acts on links without line of sight only.
        confused_with: names of effects that may look alike.
        repeatable: whether there may be several, each found in a step of its own.
        sparse: whether each of its coefficients belongs to one end, and any few may be there.
        of_device: whether it is a device's own level or antenna, which another need not have.
        of_receiver: whether it belongs to a receiver.
        is_cause: whether it is a physical cause, not merely a description of what is left.
        within_flights: whether it acts at certain times only, so that other flights do not show it:
            it is scored on devices, or blocks of ground, that are held out in all flights.
        is_declared: whether the tables declare it, or every map has it, so that only its numbers
            are open: it is no candidate cause but a part of the base, where held-out links gain by
            it.
        in_paths: whether a base that follows paths has it, so that it is no candidate there.
        always_exact: whether `exactly` may be asked of every candidate, not only of what is kept.
        uses: columns of the measurements that it reads and that no map has, such as `quality`.
        needs_map: whether its term needs the 3D map.
        settled_by: what to measure, to settle whether it is there; "the device" is replaced by the
            device's name.
        parameter_labels: printed names of reported parameters (without the member), where those
            made from their own names do not do.
        acts_on: families of groups (`radiotwin.closeloop.scan`) that it may be the cause of.
        of_groups: whether it is looked for only where a group stands out.
        calibrated_like: name of the effect whose calibration it takes where it has none of its own,
            because it has not been traced; "" = it is judged as effects are on the whole.
        params: of one that was found, an instance of `Params`; the catalogue's own have none.
        levels: which levels of the channel its term asks for, see `Levels`.
        of_links: what it has derived from links, whatever its parameters.
    """

    name: ClassVar[str]
    variant: ClassVar[str] = ""
    in_words: ClassVar[str] = ""
    stage: ClassVar[str]
    Params: ClassVar[type[EffectParams]] = EffectParams
    figure: ClassVar[str] = ""
    nlos_only: ClassVar[bool] = False
    confused_with: ClassVar[tuple[str, ...]] = ()
    repeatable: ClassVar[bool] = False
    sparse: ClassVar[bool] = False
    of_device: ClassVar[bool] = False
    of_receiver: ClassVar[bool] = False
    is_cause: ClassVar[bool] = True
    within_flights: ClassVar[bool] = False
    is_declared: ClassVar[bool] = False
    in_paths: ClassVar[bool] = False
    always_exact: ClassVar[bool] = False
    uses: ClassVar[tuple[str, ...]] = ()
    needs_map: ClassVar[bool] = False
    settled_by: ClassVar[str] = ""
    parameter_labels: ClassVar[Mapping[str, str]] = {}
    acts_on: ClassVar[tuple[str, ...]] = ()
    of_groups: ClassVar[bool] = False
    calibrated_like: ClassVar[str] = ""

    params: EffectParams
    levels: Levels = "quick"

    def __init__(self) -> None:
        self.of_links = LinkCache()

    @property
    def label(self) -> str:
        """Printed name."""
        return self.name.replace("_", " ")

    @property
    def entry(self) -> Effect:
        """The effect of the catalogue that this one was found by, or itself."""
        return vars(self).get("_entry", self)

    def with_params(self, params: EffectParams, levels: Levels | None = None) -> Self:
        """Return the effect with parameters; `levels` None: as this one has them."""
        found = copy(self)
        found.params, found.levels = params, levels or self.levels
        vars(found)["_entry"] = self.entry
        return found

    def changed(self, **update: Any) -> Self:
        """Return the effect with some parameters changed, which are not checked."""
        return self.with_params(self.params.model_copy(update=update))

    def record(self) -> dict[str, Any]:
        """Return what files have of it, for JSON: name, variant, params, and unusual `levels`."""
        usual = self.levels == type(self).levels
        return {"name": self.name, "variant": self.variant,
                "params": self.params.model_dump(mode="json")} | (
                    {} if usual else {"levels": self.levels})

    @property
    def is_exact(self) -> bool:
        """Whether its term is of paths that are followed anew."""
        return self.levels == "exact"

    def is_same(self, other: Effect | None) -> bool:
        """Return whether another one of this kind has the same parameters and kind of levels."""
        return other is not None and self.params == other.params and self.levels == other.levels

    @classmethod
    def of_variant(cls, variant: str) -> Effect | None:
        """Return the effect in the form that a twin's file names; None if it has no such form."""
        return cls() if variant == cls.variant else None

    def unavailable(self, links: Links) -> str | None:
        """Return why the data do not allow this effect to be looked for; None where they do.

        By default, because it needs a map and there is none.
        """
        return "there is no 3D map" if self.needs_map and links.city is None else None

    def kind(self) -> Any:
        """Return of which kind its parameters are: a search begins at the best of each kind."""
        return None

    def propose(self, view: ResidualView) -> list[Any]:
        """Return parameters worth trying, best first; empty where the residual does not fit.

        By default, every parameter's default.
        """
        return [self.Params()]

    def propose_like(self, view: ResidualView) -> list[Any]:
        """Return the same for a part of the data, once all of it has led to this effect."""
        return self.propose(view)

    @abstractmethod
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return what it adds to the mean level of n links.

        Args:
            links: n links.
            level_at: the channel's levels of other links, such as with devices elsewhere.
        """

    def variation(self) -> Variation | None:
        """Return how the parameters may be refined; None where they are fixed.

        By default, every parameter made with `quantity` is, within its bounds.
        """
        fields = quantities(self.Params)
        if not fields:
            return None
        values, steps, low, high = (np.array(column, dtype=float) for column in zip(
            *((getattr(self.params, name), each["step"], each["low"], each["high"])
              for name, each in fields.items()), strict=True))

        def varied(numbers: np.ndarray) -> Effect:
            inside = np.clip(numbers, low, high).tolist()
            return self.changed(**dict(zip(fields, inside, strict=True)))

        return Variation(values, steps, low, high, varied)

    def is_on_maps(self) -> bool:
        """Return whether a map, which has neither receivers nor times, is drawn with it."""
        return not self.of_receiver

    def between_flights(self) -> Effect | None:
        """Return the effect as one that changes between flights; None: it is no change in time.

        Held-out flights do not show such a change, so it is looked for in a search of its own.
        """
        return None

    def change(self, links: Links) -> Change | None:
        """Return what changed, and when; None: it is no change in time."""
        return None

    def reading_offsets_db(self, coefficients: np.ndarray) -> dict[int, float]:
        """Return how much more receivers read than others, by index [dB]; by default nothing.

        A receiver hears the same signals, so its limit of detection moves with its readings.

        Args:
            coefficients: (q,) of the columns of its term.
        """
        return {}

    def reach(self, links: Links) -> np.ndarray | None:
        """Return which (n,) links similar parameters may act on; None for any."""
        return None

    def exactly(self) -> Effect | None:
        """Return the same, asking the channel for exact levels; None where nothing changes."""
        return None

    def corrected_map(self, city: CityMap) -> CityMap:
        """Return the map as the effect has it; by default the same object."""
        return city

    def neg_log_prior(self) -> float:
        """Return how much less likely parameters are than the likeliest, before data [nats].

        By default, of every parameter with a `prior_sd`, normal around its default.
        """
        return sum(0.5 * ((getattr(self.params, name) - each["default"]) / each["prior_sd"]) ** 2
                   for name, each in quantities(self.Params).items() if each["prior_sd"])

    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why what was fitted cannot be this effect; None where it can.

        Args:
            coefficients: (q,) of the columns of its term.
        """
        return None

    def contradicted(self, links: Links) -> str | None:
        """Return what in the map of n links speaks against it as fitted; None for nothing."""
        return None

    def same_as(self, links: Links, parameters: Mapping[str, Parameter]) -> list[str]:
        """Return names of effects that n links cannot tell from it, as no two ends of it part.

        Args:
            links: that it was fitted to.
            parameters: what was found, as of `parameters`.
        """
        return []

    def contradicted_declarations(self, links: Links) -> list[str]:
        """Return what of the tables its fit contradicts, a sentence each; by default nothing."""
        return []

    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Return what was found, by name; by default every parameter made with `quantity`."""
        return {name: Parameter.normal(getattr(self.params, name), sd, each["unit"],
                                       Allowed.of(each))
                for (name, each), sd in zip(quantities(self.Params).items(), estimate.params_sd,
                                            strict=True)}

    def mark(self, links: Links) -> Mark | None:
        """Return how maps mark where it is; None where it has no place."""
        return None

    def correction(self, links: Links) -> Correction:
        """Return what it says of the declared scene, to be corrected; by default nothing.

        A device that it moves is not where it was declared.
        """
        return Correction()

    def typical_patterns(self, view: ResidualView) -> Iterable[Pattern]:
        """Return what typical effects of this kind would change, over the links of a view.

        From each follows the least size that would have been found; by default there is none, and
        nothing is said of what was not found.
        """
        return ()

    def like(self, other: Any) -> Effect:
        """Return the same cause in the form closest to another effect of this kind.

        For parameters of which several forms mean the same, such as a box turned by 90°.
        """
        return self


class GainEffect(Effect):
    """An effect that adds decibels; override `gain_db`, or `term` where coefficients are fitted."""

    stage = "gain"

    def gain_db(self, links: Links) -> np.ndarray:
        """Return what it adds to each link (n,) [dB]; a loss is negative."""
        raise NotImplementedError(f"{type(self).__name__} defines neither gain_db nor term")

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return `gain_db` as a term without coefficients."""
        return Term.of_offset(self.gain_db(links))


class _ResponseEffect(Effect):
    """An effect that maps one level to another; override `inputs`, or `term` that carries them."""

    def inputs(self, links: Links) -> np.ndarray:
        """Return what `response` needs of each link (n, …)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither inputs nor term")

    @abstractmethod
    def response(self, level_db: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what becomes of mean levels.

        Args:
            level_db: (n,) [dB].
            inputs: (n, …) of the links.

        Returns:
            (n,) [dB], and its slope in `level_db` (n,), above zero.
        """

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return a term that adds nothing and carries the inputs."""
        return Term.of_inputs(self.inputs(links))


class PathEffect(_ResponseEffect):
    """An effect that adds power to what the channel predicts, before any gain."""

    stage = "paths"


class ReceiverEffect(_ResponseEffect):
    """An effect of the receiver's on the level that arrives."""

    stage = "receiver"
    of_receiver = True


class _BlankingEffect(Effect):
    """An effect of the receiver's that leaves levels as they are."""

    of_receiver = True

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return a term that adds nothing."""
        return Term.of_offset(np.zeros(len(links)))


class DetectionEffect(_BlankingEffect):
    """An effect that loses links, or some of their level, now and then whatever their level."""

    stage = "detection"

    @abstractmethod
    def losses(self, links: Links) -> Losses:
        """Return what becomes of n links; each value (n,), probabilities below 1."""


class LimitEffect(_BlankingEffect):
    """An effect that leaves levels as they are and makes links blank below a level."""

    stage = "limit"

    @abstractmethod
    def limits_db(self, links: Links) -> np.ndarray:
        """Return the level (n,) below which links are blank; -inf where the declared one holds."""


class LevelAt(Protocol):
    """Levels (n,) [dB] that the channel predicts for other links, such as with moved devices."""

    def __call__(self, links: Links, exact: bool = False) -> np.ndarray:
        """Return them quickly, or exactly (following paths, where the channel does)."""


@dataclass(frozen=True, eq=False)
class ResidualView:
    """Training links, and the residual of the model so far.

    Attributes:
        links: n links.
        residual_db: (n,) measured minus predicted [dB]; of blanks, how far below the prediction
            they lie at least.
        scale_db: (n,) scale of the errors [dB].
        mean_db: (n,) predicted level [dB].
        level_at: the channel's levels of other links, such as with devices elsewhere.
        found: the effects so far.
        group: (n,) bool, links that read otherwise than their peers; None: any may.
    """

    links: Links
    residual_db: np.ndarray
    scale_db: np.ndarray
    mean_db: np.ndarray
    level_at: LevelAt
    found: tuple[Effect, ...] = ()
    group: np.ndarray | None = None

    def of_group(self, group: np.ndarray) -> ResidualView:
        """Return the view with a residual only where the cause of a group (n,) may act.

        That is on all links of the device, the receiver or the flight that the group has in common;
        all others are the reference. Everywhere, where it has none of them in common.
        """
        links = self.links
        ends = [label == label[group][0] for label in (links.device, links.receiver)
                if (label[group] == label[group][0]).all()]
        if not ends and (links.flight[group] == links.flight[group][0]).all():
            ends = [links.flight == links.flight[group][0]]
        may_act = np.all(ends, axis=0) if ends else np.ones(len(links), dtype=bool)
        found = replace(self, residual_db=np.where(may_act, self.residual_db, 0.0), group=group)
        vars(found)["design_effect"] = self.design_effect
        return found

    def in_group(self, label: np.ndarray) -> list[int]:
        """Return the labels (n,) of the group's links, in order; all labels without a group."""
        return np.unique(label if self.group is None else label[self.group]).tolist()

    def found_params(self, name: str, parameter: str) -> list[Any]:
        """Return the values of a parameter of the effects of that name that were found before."""
        return [getattr(each.params, parameter) for each in self.found
                if each.name == name and hasattr(each.params, parameter)]

    @cached_property
    def design_effect(self) -> float:
        """How many links count as one, because links close to each other err alike."""
        return design_effect(evidence_blocks(self.links), self.residual_db / self.scale_db)

    @cached_property
    def weight(self) -> np.ndarray:
        """(n,) weight of each link's square [1/dB²].

        1 / variance, less for outliers, divided by the design effect: sums of weighted squares are
        nats that can be believed.
        """
        z = self.residual_db / self.scale_db
        return 5.0 / (4.0 + z * z) / self.scale_db**2 / self.design_effect

    def gain_nats(self, rows: np.ndarray, change_db: np.ndarray) -> np.ndarray:
        """Return how much likelier links become if their mean changes (r,) [nats].

        With heavy tails before and after: `weight` knows the old outliers only, and a change makes
        others. A blank is satisfied with any level that is below the limit of detection.

        Args:
            rows: (r,) links.
            change_db: (r,) change of the mean [dB].
        """
        scale_db, blank = self.scale_db[rows], np.isnan(self.links.level_db[rows])
        before = (self.residual_db[rows] / scale_db) ** 2
        # That of a blank is cut off at 0; how far it may rise, its distance to the limit says.
        spare_db = self.links.limit_db[rows] - self.mean_db[rows]
        spare_db = np.where(np.isfinite(spare_db), spare_db, np.inf)
        # It may be blank for another reason than its level, by as much as its residual is less.
        share = np.where(spare_db < 0, self.residual_db[rows] / np.minimum(spare_db, -1e-9), 1.0)
        rest_db = np.where(blank, share * np.minimum(spare_db - change_db, 0.0),
                           self.residual_db[rows] - change_db)
        after = (rest_db / scale_db) ** 2
        return 2.5 * (np.log1p(before / 4.0) - np.log1p(after / 4.0)) / self.design_effect

    def score(self, term: Term) -> float:
        """Return how much a term would help [nats].

        Half of the drop of the weighted squares, after its coefficients and a level for each class
        of line of sight are fitted.
        """
        weight = self.weight
        target = self.residual_db - term.offset_db
        level = np.column_stack([self.links.los, ~self.links.los]).astype(float)
        before = _weighted_squares(level, np.full(2, np.inf), self.residual_db, weight)
        prior_sd_db = np.concatenate([np.full(2, np.inf), term.prior_sd_db])
        after = _weighted_squares(np.hstack([level, term.columns]), prior_sd_db, target, weight)
        return 0.5 * (before - after)


def _weighted_squares(columns: np.ndarray, prior_sd: np.ndarray, target: np.ndarray,
                      weight: np.ndarray) -> float:
    weighted = columns.T * weight
    precision = 1.0 / np.square(prior_sd) + 1e-9
    moments = weighted @ target
    coefficients = np.linalg.solve(weighted @ columns + np.diag(precision), moments)
    return float(weight @ (target * target) - coefficients @ moments)
