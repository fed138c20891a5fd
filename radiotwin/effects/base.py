"""Contract of effects: base class, stages, terms of the regression, and the view of residuals.

An effect is a cause that changes levels. It acts in one stage; a level passes them in this order:

    paths      adds power to the channel's prediction, before any gain
    gain       adds decibels
    receiver   maps the arriving level to the reading
    limit      sets the limit of detection, below which a link is blank
    detection  blanks or weakens links at random, independent of their level

An effect proposes parameters from a `ResidualView` of the training links. Everything that the loop
and the pages need from an effect is a method or an attribute of `Effect`, with a default;
`docs/add-an-effect.md` lists them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self

import numpy as np

from radiotwin.effects.arrays import LinkCache, add_power
from radiotwin.effects.params import (
    Allowed,
    EffectParams,
    Estimate,
    Parameter,
    Variation,
    quantities,
)
from radiotwin.effects.places import Correction, Mark
from radiotwin.inference.student import DOF, Losses
from radiotwin.links import Links, design_effect, evidence_blocks

if TYPE_CHECKING:
    from collections.abc import Iterable

    from radiotwin.effects.patterns import Pattern
    from radiotwin.scene.citymap import CityMap


@dataclass(frozen=True, eq=False)
class Term:
    """Contribution of an effect to the mean level of n links, for given parameters.

    Attributes:
        offset_db: (n,) fixed part [dB].
        columns: (n, q) design matrix of the part that the regression fits.
        prior_sd_db: (q,) prior standard deviation of each coefficient around zero.
        inputs: (n, …) input of the effect's `response` for each link; None = no response.
        random_effect_sd_db: (n,) standard deviation of an independent random effect of each link
            [dB]; None = none.
        unheard_sd_db: (n,) standard deviation of a level shared by links for which no reading
            exists, e.g. of a device that was never heard [dB]; None = none.
    """

    offset_db: np.ndarray
    columns: np.ndarray
    prior_sd_db: np.ndarray
    inputs: np.ndarray | None = None
    random_effect_sd_db: np.ndarray | None = None
    unheard_sd_db: np.ndarray | None = None

    @property
    def acts(self) -> np.ndarray:
        """(n,) bool, links whose level the term may change."""
        return (self.offset_db != 0) | (self.columns != 0).any(axis=1)

    def select(self, rows: np.ndarray) -> Term:
        """Return the term for some links only, given by a mask or indices."""
        inputs, scatter_db, unheard_db = (
            None if values is None else values[rows]
            for values in (self.inputs, self.random_effect_sd_db, self.unheard_sd_db))
        return Term(self.offset_db[rows], self.columns[rows], self.prior_sd_db, inputs,
                    scatter_db, unheard_db)

    @classmethod
    def of_columns(cls, columns: np.ndarray, prior_sd_db: float) -> Term:
        """Build a term of fitted columns (n, q), all with one prior standard deviation [dB]."""
        sd_db = np.full(columns.shape[1], float(prior_sd_db))
        return cls(np.zeros(len(columns)), columns, sd_db)

    @classmethod
    def of_offset(cls, offset_db: np.ndarray) -> Term:
        """Build a term of a fixed offset (n,) [dB], without coefficients."""
        return cls(offset_db, np.zeros((len(offset_db), 0)), np.zeros(0))

    @classmethod
    def of_inputs(cls, inputs: np.ndarray) -> Term:
        """Build a term that adds 0 dB and carries the inputs (n, …) of the effect's response."""
        n = len(inputs)
        return cls(np.zeros(n), np.zeros((n, 0)), np.zeros(0), inputs)


# How a term gets the channel's levels: by the quick law, from paths followed before, or by
# following paths again.
Levels = Literal["quick", "known_paths", "exact"]


class Effect(ABC):
    """One effect of the catalogue; subclass one of the stages below.

    Attributes:
        name: name in `closeloop.json`.
        variant: physical form, if the name has several.
        in_words: how the cause is called in a sentence; "" = its name.
        stage: stage of the chain, see the module.
        Params: class of its parameters, a subclass of `EffectParams`.
        figure: key of the figure that shows it (`radiotwin.report`); "" = residual against the
            variable that it depends on.
        nlos_only: whether it acts only on links without line of sight.
        confused_with: names of effects with similar residuals.
        repeatable: whether there may be several; each step of the search finds one.
        sparse: whether each coefficient belongs to one device or receiver, and most may be zero.
        of_device: whether it belongs to one device (its level or antenna).
        of_receiver: whether it belongs to a receiver.
        is_cause: whether it is a physical cause, not only a description of the residual.
        within_flights: whether it acts at certain times only, so that other flights do not show it:
            then it is scored on devices, or blocks of ground, held out in all flights.
        is_declared: whether the tables declare it, or every map has it. Then it is no candidate
            cause: it is part of the base if it lowers the held-out error.
        in_paths: whether a base that follows paths contains it; then it is no candidate there.
        always_exact: whether every candidate may be refined by `exactly`, not only the kept ones.
        uses: columns of the measurements that it reads and that maps lack, e.g. `quality`.
        needs_map: whether its term needs the 3D map.
        needs_frequency: whether its term needs the frequency.
        settled_by: measurement that would confirm or exclude it; "the device" is replaced by the
            device's name.
        parameter_labels: printed names of reported parameters (without the member), if not made
            from their keys.
        acts_on: families of groups (`radiotwin.closeloop.scan`) that it may cause to stand out.
        of_groups: whether it is searched only for a group that stands out.
        calibrated_like: effect whose calibration of the evidence it uses if it has none itself;
            "" = the calibration over all effects.
        params: fitted parameters, an instance of `Params`; the catalogue's instances have none.
        levels: how its term gets the channel's levels, see `Levels`.
        of_links: cache of values derived from links that do not depend on its parameters.
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
    needs_frequency: ClassVar[bool] = False
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
        """The effect of the catalogue that proposed this one, or itself."""
        return vars(self).get("_entry", self)

    def with_params(self, params: EffectParams, levels: Levels | None = None) -> Self:
        """Copy the effect with new parameters, and `levels` if given; it keeps its `entry`."""
        found = copy(self)
        found.params, found.levels = params, levels or self.levels
        vars(found)["_entry"] = self.entry
        return found

    def changed(self, **update: Any) -> Self:
        """Return a copy of the effect with some parameters changed, without validation."""
        return self.with_params(self.params.model_copy(update=update))

    def record(self) -> dict[str, Any]:
        """Return the effect as a dictionary for JSON; `levels` only if not the default."""
        usual = self.levels == type(self).levels
        return {"name": self.name, "variant": self.variant,
                "params": self.params.model_dump(mode="json")} | (
                    {} if usual else {"levels": self.levels})

    @property
    def is_exact(self) -> bool:
        """Whether its term follows paths again, see `Levels`."""
        return self.levels == "exact"

    def is_same(self, other: Effect | None) -> bool:
        """Check whether another effect of this class has the same parameters and `levels`."""
        return other is not None and self.params == other.params and self.levels == other.levels

    @classmethod
    def of_variant(cls, variant: str) -> Effect | None:
        """Return a new effect of a variant named in a twin's file; None if it has no such one."""
        return cls() if variant == cls.variant else None

    def unavailable(self, links: Links) -> str | None:
        """Return why the links do not allow a search for this effect; None if they do.

        By default: the effect needs a map or the frequency, and there is none.
        """
        if self.needs_map and links.city is None:
            return "there is no 3D map"
        if self.needs_frequency and not np.isfinite(links.frequency_hz):
            return "the frequency is not known; give frequency_hz in devices.csv"
        return None

    def kind(self) -> Any:
        """Return a label of its kind of parameters; the search starts once from each kind."""
        return None

    def propose(self, view: ResidualView) -> list[Any]:
        """Propose parameters from the residuals, best first; empty if nothing fits.

        By default one proposal, the default parameters.
        """
        return [self.Params()]

    def propose_for_fold(self, view: ResidualView) -> list[Any]:
        """Propose parameters for one fold, given that all links led to this effect."""
        return self.propose(view)

    @abstractmethod
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Compute what the effect (e.g. a wrong map, an antenna) changes in the level of n links.

        Args:
            links: n links.
            level_at: predicts the channel's levels for any links, e.g. with moved devices.
        """

    def variation(self) -> Variation | None:
        """Return the parameters as a vector for a numerical search; None if none is searched.

        By default all parameters declared with `quantity`, kept within their bounds.
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
        """Check whether maps, which have neither receivers nor times, contain the effect."""
        return not self.of_receiver

    def between_flights(self) -> Effect | None:
        """Return the effect restricted to changes between flights; None if it has none in time.

        Such a change is searched separately, as held-out flights cannot show it.
        """
        return None

    def untold(self, links: Links, train: np.ndarray) -> np.ndarray:
        """Return (n,) bool, links whose levels cannot be predicted from the training links.

        A receiver that changed between two flights is an example: if the last flight before the
        change is held out, the time of the change is not known there. By default none.

        Args:
            links: n links.
            train: (n,) bool, links that a fold is fitted to.
        """
        return np.zeros(len(links), dtype=bool)

    def reading_offsets_db(self, coefficients: np.ndarray) -> dict[int, float]:
        """Return receiver index -> by how much the effect shifts all its readings [dB].

        The receiver's limit of detection shifts by as much. By default empty: no shift.

        Args:
            coefficients: (q,) fitted coefficients of its term.
        """
        return {}

    def reach(self, links: Links) -> np.ndarray | None:
        """Return the mask (n,) of links that similar parameters may act on; None: any link."""
        return None

    def exactly(self) -> Effect | None:
        """Return the effect with exact levels, see `Levels`; None if nothing would change."""
        return None

    def corrected_map(self, city: CityMap) -> CityMap:
        """Return the map corrected by the effect; by default the same object."""
        return city

    def neg_log_prior(self) -> float:
        """Compute the negative log prior of the parameters, 0 at its maximum [nats].

        By default normal around the default, for parameters with a `prior_sd`.
        """
        return sum(0.5 * ((getattr(self.params, name) - each["default"]) / each["prior_sd"]) ** 2
                   for name, each in quantities(self.Params).items() if each["prior_sd"])

    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why the fit makes no physical sense by the effect's own rule; by default None.

        Args:
            coefficients: (q,) fitted coefficients of its term.
        """
        return None

    def contradicted(self, links: Links) -> str | None:
        """Return why the map of the links contradicts the fitted effect; None if it does not."""
        return None

    def rivals(self, links: Links, parameters: Mapping[str, Parameter]) -> list[str]:
        """List by name the effects that would explain these links equally well; default: none.

        E.g. an offset of a device that only one receiver heard may as well be that receiver's.

        Args:
            links: links of the fit.
            parameters: reported parameters, see `parameters`.
        """
        return []

    def contradicted_declarations(self, links: Links) -> list[str]:
        """Return one sentence for each declared value that the fit contradicts; default none."""
        return []

    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Return name -> fitted value with 90 % interval; by default those made with `quantity`."""
        return {name: Parameter.normal(getattr(self.params, name), sd, field["unit"],
                                       Allowed.of(field))
                for (name, field), sd in zip(quantities(self.Params).items(), estimate.params_sd,
                                             strict=True)}

    def mark(self, links: Links) -> Mark | None:
        """Return the mark of its place on maps; None if it has no place."""
        return None

    def correction(self, links: Links) -> Correction:
        """Return the corrections of the declared scene that follow from it; by default none."""
        return Correction()

    def typical_patterns(self, view: ResidualView) -> Iterable[Pattern]:
        """Yield the level changes that typical examples of this effect would cause on the links.

        From each follows the smallest size that these data would reveal. By default none: then no
        detectable size is reported.
        """
        return ()

    def like(self, other: Any) -> Effect:
        """Return the same effect, in those equivalent parameters that are closest to another's.

        Several parameters may mean the same, e.g. a box turned by 90° with its sides exchanged.
        """
        return self


class GainEffect(Effect):
    """An effect that adds decibels; override `gain_db`, or `term` where coefficients are fitted."""

    stage = "gain"

    def gain_db(self, links: Links) -> np.ndarray:
        """Compute the gain added to each link (n,) [dB]; a loss is negative."""
        raise NotImplementedError(f"{type(self).__name__} defines neither gain_db nor term")

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return `gain_db` as a term without coefficients."""
        return Term.of_offset(self.gain_db(links))


class _ResponseEffect(Effect):
    """An effect with a response, level in -> level out; override `inputs`, or `term`.

    By default it adds a power, its inputs (n,), linear; 1 is 0 dB.
    """

    def inputs(self, links: Links) -> np.ndarray:
        """Compute the inputs (n, …) of `response` for each link."""
        raise NotImplementedError(f"{type(self).__name__} defines neither inputs nor term")

    def response(self, level_db: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Map the mean levels before this stage of reception to the levels after it.

        Args:
            level_db: (n,) level that enters [dB].
            inputs: (n, …) from `inputs`.

        Returns:
            (n,) level that leaves [dB], and (n,) its derivative by `level_db`, positive.
        """
        return add_power(level_db, inputs)

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return a term that adds 0 dB and carries the inputs."""
        return Term.of_inputs(self.inputs(links))


class PathEffect(_ResponseEffect):
    """An effect that adds power to the channel's prediction, before any gain."""

    stage = "paths"


class ReceiverEffect(_ResponseEffect):
    """An effect of the receiver on the arriving level, such as a noise floor."""

    stage = "receiver"
    of_receiver = True


class _BlankingEffect(Effect):
    """An effect of the receiver on detection, without a term of the mean level."""

    of_receiver = True

    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return a term of 0 dB."""
        return Term.of_offset(np.zeros(len(links)))


class DetectionEffect(_BlankingEffect):
    """An effect that blanks links, or lowers their level, at random."""

    stage = "detection"

    @abstractmethod
    def losses(self, links: Links) -> Losses:
        """Compute the probabilities of blanks and drops of n links, (n,) each and below 1."""


class LimitEffect(_BlankingEffect):
    """An effect that sets the limit of detection."""

    stage = "limit"

    @abstractmethod
    def limits_db(self, links: Links) -> np.ndarray:
        """Compute the limit of detection (n,) [dB]; -inf where the declared one holds."""


class LevelAt(Protocol):
    """Predictor of the channel's levels for any links, e.g. with moved devices."""

    def __call__(self, links: Links, exact: bool = False) -> np.ndarray:
        """Predict the levels (n,) [dB]; `exact`: by following paths, if the channel can."""


@dataclass(frozen=True, eq=False)
class ResidualView:
    """Training links and the residuals of the model so far.

    Attributes:
        links: n links.
        residual_db: (n,) measured minus predicted [dB]; for a blank the least residual that fits
            it, at most 0.
        scale_db: (n,) scale of the errors [dB].
        mean_db: (n,) predicted level [dB].
        level_at: predicts the channel's levels for any links.
        found: effects in the model.
        group: (n,) bool, links of the group that stands out from its peers; None: no such group.
    """

    links: Links
    residual_db: np.ndarray
    scale_db: np.ndarray
    mean_db: np.ndarray
    level_at: LevelAt
    found: tuple[Effect, ...] = ()
    group: np.ndarray | None = None

    def of_group(self, group: np.ndarray) -> ResidualView:
        """Return a view with residual 0 where the cause of an odd group (mask (n,)) cannot act.

        A cause may act on all links of the device and receiver that the group has in common, or
        else of its only flight; if the group has none of these in common, on all links.
        """
        links = self.links
        masks = [label == label[group][0] for label in (links.device, links.receiver)
                 if (label[group] == label[group][0]).all()]
        if not masks and (links.flight[group] == links.flight[group][0]).all():
            masks = [links.flight == links.flight[group][0]]
        may_act = np.all(masks, axis=0) if masks else np.ones(len(links), dtype=bool)
        found = replace(self, residual_db=np.where(may_act, self.residual_db, 0.0), group=group)
        vars(found)["design_effect"] = self.design_effect
        return found

    def in_group(self, label: np.ndarray) -> list[int]:
        """List the distinct labels (n,) of the group's links in order; without a group, all."""
        return np.unique(label if self.group is None else label[self.group]).tolist()

    def found_params(self, name: str, parameter: str) -> list[Any]:
        """List the values of a parameter of the effects of that name in the model."""
        return [getattr(effect.params, parameter) for effect in self.found
                if effect.name == name and hasattr(effect.params, parameter)]

    @cached_property
    def design_effect(self) -> float:
        """Number of neighbouring links that count as one, as their errors are correlated."""
        return design_effect(evidence_blocks(self.links), self.residual_db / self.scale_db)

    @cached_property
    def weight(self) -> np.ndarray:
        """(n,) robust weight of each squared residual [1/dB²].

        1 / variance, reduced for outliers (Student's t) and divided by the design effect: half of
        the weighted sum of squares is a log-likelihood [nats].
        """
        z = self.residual_db / self.scale_db
        return (DOF + 1) / (DOF + z * z) / self.scale_db**2 / self.design_effect

    def gain_nats(self, rows: np.ndarray, change_db: np.ndarray) -> np.ndarray:
        """Compute how each link's log-likelihood (r,) grows if its mean level changes [nats].

        By Student's t before and after, as a change makes new outliers that `weight` does not know;
        divided by the design effect. A blank (not detected) fits any level below the limit.

        Args:
            rows: (r,) indices of links.
            change_db: (r,) change of the mean level [dB].
        """
        scale_db, blank = self.scale_db[rows], np.isnan(self.links.level_db[rows])
        before = (self.residual_db[rows] / scale_db) ** 2
        # A blank has residual 0 until its mean exceeds the limit, `spare_db` above the prediction.
        spare_db = self.links.limit_db[rows] - self.mean_db[rows]
        spare_db = np.where(np.isfinite(spare_db), spare_db, np.inf)
        # Probability that its level made it blank; `residual_db` of a blank contains this factor.
        share = np.where(spare_db < 0, self.residual_db[rows] / np.minimum(spare_db, -1e-9), 1.0)
        rest_db = np.where(blank, share * np.minimum(spare_db - change_db, 0.0),
                           self.residual_db[rows] - change_db)
        after = (rest_db / scale_db) ** 2
        return 0.5 * (DOF + 1) * (np.log1p(before / DOF)
                                  - np.log1p(after / DOF)) / self.design_effect

    def score(self, term: Term) -> float:
        """Approximate the log-likelihood gain of adding an effect's term to the model [nats].

        Half of the reduction of the weighted squared residuals, with fitted coefficients and one
        level each for links with and without line of sight. The term's `inputs` are ignored.
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
    """Compute the weighted residual sum of squares, plus penalty, of a ridge regression."""
    weighted = columns.T * weight
    precision = 1.0 / np.square(prior_sd) + 1e-9
    moments = weighted @ target
    coefficients = np.linalg.solve(weighted @ columns + np.diag(precision), moments)
    return float(weight @ (target * target) - coefficients @ moments)
