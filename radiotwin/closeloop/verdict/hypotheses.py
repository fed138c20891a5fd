"""Competing explanations of a residual: nuisances of the base, unnamed and named causes.

Nuisances are always there: a level and a slope of each class of line of sight, tolerances of
devices, receivers and flights, and a field over positions (`radiotwin.inference`). How far ends of
a kind usually differ is estimated from most of them, so that the few that are off further are not
within the tolerance of the others (empirical Bayes; Efron 2008, 'Microarrays, empirical Bayes and
the two-groups model', Stat. Sci. 23).

Causes without a name are curves over each variable, for all links, each receiver or each device:
what one of them explains better than any named effect is not in the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb, log

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from radiotwin.effects.arrays import curve_columns, one_hot
from radiotwin.effects.base import Effect
from radiotwin.effects.params import NEAR_SHARE
from radiotwin.inference.correlated_evidence import Columns, CorrelatedEvidence
from radiotwin.inference.gaussian import MAD_SD, robust_sd
from radiotwin.links import Links
from radiotwin.twin.model.correlated_shadowing import receivers_move
from radiotwin.twin.model.model import Fit

MAX_Z = 3.0  # an outlier counts as this many scales from its neighbours
NEIGHBOURS = 9
LEVEL_SD_DB, SLOPE_SD_DB = 20.0, 10.0  # of a class of line of sight, at 100 m and per decade
# Usual spread of the levels of a kind of ends before any is seen, and how many ends it counts for.
SPREAD_DB, SPREAD_ENDS = 0.5, 4
MAX_ENDS = 40  # devices or receivers that have terms of their own
CURVE_KNOTS, NUISANCE_SD_DB = 6, 2.0  # of the base's errors over its prediction and elevation
KNOTS = 8  # of a curve over a variable
TIME_KNOTS = 24  # of one over time
CURVE_SD_DB = 4.0  # prior standard deviation of a curve
MAX_COLUMNS = 250  # of one hypothesis
MAX_FEW = 6  # ends of which each number is tried, before all of them
STEP_SHARE = 0.3  # of a number's typical uncertainty, for what it changes


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Evidence for causes, on the training links of one model.

    Attributes:
        evidence: of its residuals, with the field's length.
        links: n training links.
        scale_db: (n,) errors' scale, by which all residuals are divided.
        nuisance: what is fitted beside any cause, over that scale.
        base_z: (n,) residuals without any further cause.
        mean_db: (n,) the model's mean.
        coefficients: of its fit, levels first.
        near: (n, `NEIGHBOURS`) links of the same series that are nearest to each.
    """

    evidence: CorrelatedEvidence
    links: Links
    scale_db: np.ndarray
    nuisance: Columns
    base_z: np.ndarray
    mean_db: np.ndarray
    coefficients: np.ndarray
    near: np.ndarray

    @classmethod
    def of(cls, fit: Fit, seed: int) -> Hypotheses:
        """Return the hypotheses about what a model lacks.

        Args:
            fit: with what was found so far.
            seed: of the draw of links, where there are many.
        """
        training = fit.model.training
        links, predicted = fit.links.select(fit.train), training.predict(fit)
        nuisance, families = _nuisance(links, predicted.mean_db)
        nuisance = Columns(nuisance.values / predicted.scale_db[:, None], nuisance.prior_sd)
        residual_db = training.residual_db(fit)
        # A blank that was to be expected says nothing.
        says = np.isfinite(training.level_db) | (residual_db < 0)
        residual_db = np.where(says, residual_db, np.nan)
        moving = receivers_move(links)
        series = links.device if moving else links.receiver
        position_m = links.receiver_m if moving else links.device_m[links.device]
        near = _neighbours(series, links.track, position_m, np.isfinite(residual_db))
        z = _tamed(residual_db / predicted.scale_db, near)
        evidence = CorrelatedEvidence.fit(series, position_m, z, nuisance, seed)
        nuisance = _with_usual_spreads(evidence, z, nuisance, families)
        return cls(evidence, links, predicted.scale_db, nuisance, z, predicted.mean_db,
                   fit.coefficients, near)

    @cached_property
    def _rotated(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Nuisance columns, evidence and variances without any further cause."""
        columns = self.evidence.rotated(self.nuisance.values)
        found = self.evidence.of_rotated(self.evidence.rotated(self.base_z), columns,
                                         self.nuisance.prior_sd)
        return columns, *found

    @property
    def sizes_db(self) -> tuple[float, float]:
        """Standard deviations of the rest that belongs to places, and of noise [dB]."""
        _, _, theta = self._rotated
        noise_db = np.exp(0.5 * theta[0]) * float(np.median(self.scale_db))
        return noise_db * np.exp(0.5 * theta[1]), noise_db

    def gain_nats(self, z: np.ndarray, columns: Columns,
                  widening: np.ndarray | None = None) -> float:
        """Return how much likelier residuals are with columns than those of the model.

        Args:
            z: (n,) residuals with the effect [its error scales].
            columns: likewise.
            widening: (n,) error scales with the effect over those without; None: the same.
        """
        nuisance, base, theta = self._rotated
        if widening is not None:
            nuisance = self.evidence.rotated(self.nuisance.values / widening[:, None])
            widened = np.log(widening[self.evidence.rows])
            base += widened.sum() + 0.5 * np.log(np.maximum(np.count_nonzero(widened), 1))
        both = np.hstack([nuisance, self.evidence.rotated(columns.values)])
        sd = np.concatenate([self.nuisance.prior_sd, columns.prior_sd])
        return self.evidence.of_rotated(self.evidence.rotated(z), both, sd, theta)[0] - base

    def information(self, pattern_db: np.ndarray) -> float:
        """Return how sharply the data would show a change (n,) of unit size [1/size²]."""
        columns, _, theta = self._rotated
        pattern = self.evidence.rotated(pattern_db / self.scale_db)
        return self.evidence.information(pattern, columns, self.nuisance.prior_sd, theta)

    def of_named(self, fit: Fit) -> float:
        """Return the evidence for the last effect of a model [nats].

        Coefficients are integrated over their priors, and so are the numbers that were searched
        for, of which what they change is taken as linear (Laplace's approximation; MacKay 2003,
        'Information theory, inference, and learning algorithms', Ch. 28): what the data do not
        determine costs nothing, and what fits best without the rest is fitted again beside it.

        Args:
            fit: of this one's model with one more effect.

        Returns:
            NaN for an effect that residuals do not show.
        """
        effect, own = fit.effects[-1], fit.coefficients_of(-1)
        term = fit.model.terms[-1].select(fit.train)
        scale_db, widening = self.scale_db, None
        if term.random_effect_sd_db is not None:  # an effect that makes errors larger
            scale_db = np.hypot(scale_db, term.random_effect_sd_db)
            widening = scale_db / self.scale_db
        z = _tamed(fit.model.training.residual_db(fit) / scale_db, self.near)
        # What its columns brought, and what levels gave way for it, is integrated over again.
        shown_db = term.columns @ own
        levels = fit.model.level_columns[fit.train]
        p = levels.shape[1]
        shown_db += levels @ (fit.coefficients[:p] - self.coefficients[:p])
        z += shown_db / scale_db
        columns = Columns(term.columns / scale_db[:, None], term.prior_sd_db)
        if effect.sparse:
            return self._of_few(z, columns, own)
        slopes = _slopes(fit)
        return self.gain_nats(z, columns.beside(
            Columns(slopes.values / scale_db[:, None], slopes.prior_sd)), widening)

    def _of_few(self, z: np.ndarray, columns: Columns, coefficients: np.ndarray) -> float:
        """Return the evidence for the likeliest few of columns, largest coefficients (q,) first.

        Any number of them is as probable as any other, and any set of that number (Scott and Berger
        2010, 'Bayes and empirical-Bayes multiplicity adjustment in the variable-selection problem',
        Ann. Stat. 38): one end that is off does not pay for all that are not.
        """
        order, q = np.argsort(-np.abs(coefficients - np.median(coefficients))), len(coefficients)
        found = []
        for count in sorted({*range(1, min(q, MAX_FEW) + 1), q}):
            few = Columns(columns.values[:, order[:count]], columns.prior_sd[order[:count]])
            found.append(self.gain_nats(z, few) - log(comb(q, count)) - log(q))
        return max(found)

    def of_group(self, group: np.ndarray) -> float:
        """Return the evidence for a cause without a name that acts on a group of links (n,) only.

        It is a curve over any one variable, which is as probable as any other; or none of them, as
        what stands out need not be a curve.
        """
        found = []
        for value, knots, is_angle in self._variables().values():
            basis = curve_columns(np.where(group, value, np.nan), knots, is_angle)
            columns = Columns(basis / self.scale_db[:, None],
                              np.full(basis.shape[1], CURVE_SD_DB))
            found.append(self.gain_nats(self.base_z, columns))
        return max(float(logsumexp(found)) - log(len(found)), 0.0)

    @cached_property
    def unnamed_nats(self) -> dict[str, float]:
        """Evidence for a cause without a name over each variable [nats]."""
        found: dict[str, float] = {}
        for name, values in self._curves():
            scaled = values / self.scale_db[:, None]
            columns = Columns(scaled, np.full(values.shape[1], CURVE_SD_DB))
            found[name] = self.gain_nats(self.base_z, columns)
        return found

    def _variables(self) -> dict[str, tuple[np.ndarray, int, bool]]:
        """Return values (n,), number of knots, and whether it is an angle, of each variable."""
        links = self.links
        variables = {
            "time": (links.time_s, TIME_KNOTS, False),
            "time in flight": (links.time_in_flight_s, KNOTS, False),
            "azimuth": (links.azimuth_deg, KNOTS, True),
            "elevation": (links.elevation_deg, KNOTS, False),
            "body azimuth": (links.body_azimuth_deg, KNOTS, True),
            "distance": (links.distance_m, KNOTS, False),
            "predicted level": (self.mean_db, KNOTS, False),
            "altitude": (links.receiver_m[:, 2], KNOTS, False)}
        return {name: each for name, each in variables.items()
                if (known := np.isfinite(each[0])).mean() >= 0.5
                and len(np.unique(each[0][known])) >= KNOTS}  # else it is a label

    def _curves(self) -> Iterator[tuple[str, np.ndarray]]:
        links = self.links
        ends = {"": None, "receiver": links.receiver, "device": links.device}
        flights = len(np.unique(links.flight))
        for name, label in ends.items():
            if label is not None and 1 < flights * len(np.unique(label)) <= MAX_COLUMNS:
                pairs = label * (links.flight.max() + 1) + links.flight
                if len(np.unique(pairs)) > len(np.unique(label)):
                    yield f"flight, {name}", one_hot(pairs, np.unique(pairs).tolist())
        for variable, (value, knots, is_angle) in self._variables().items():
            basis = curve_columns(value, knots, is_angle)
            for name, label in ends.items():
                members = [None] if label is None else np.unique(label).tolist()
                if label is not None and len(members) < 2:
                    continue
                if len(members) * basis.shape[1] > MAX_COLUMNS:
                    continue
                blocks = [basis if member is None else basis * (label == member)[:, None]
                          for member in members]
                yield variable + (f", {name}" if name else ""), np.hstack(blocks)


def _slopes(fit: Fit) -> Columns:
    """Return what each number of the last effect changes (n, q) [dB], and how far it may (q,)."""
    model, effect = fit.model, fit.effects[-1]
    variation = effect.variation()
    if variation is None:
        return Columns(np.zeros((int(model.train.sum()), 0)), np.zeros(0))
    here = variation.effect(variation.values)
    if not here.is_same(effect):  # it varies with quicker levels than it has
        model = model.with_effect_at(-1, here)
    mean_db, slopes_db = model.training.predict(fit).mean_db, []
    # Of paths those that folds will ask for, too.
    share = NEAR_SHARE if variation.follows_paths else STEP_SHARE
    for number, step in enumerate(share * variation.steps):
        values = variation.values.copy()
        if values[number] + step > variation.high[number]:
            step = -step
        values[number] += step
        changed = model.with_effect_at(-1, variation.effect(values)).training.predict(fit)
        slopes_db.append((changed.mean_db - mean_db) / step)
    width = variation.high - variation.low
    return Columns(np.column_stack(slopes_db), width / np.sqrt(12.0))


def _neighbours(series: np.ndarray, track: np.ndarray, position_m: np.ndarray,
                known: np.ndarray) -> np.ndarray:
    """Return rows (n, `NEIGHBOURS`) that are known and nearest to each, of the same series.

    Of the same track (n,) where it has as many: what all links of a flight have in common, be it a
    scatter, is not measured by other flights.
    """
    near = np.repeat(np.arange(len(series))[:, None], NEIGHBOURS, axis=1)
    for labels in (series[:, None], np.column_stack([series, track])):
        member = np.unique(labels, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(member, kind="stable")
        for own in np.split(order, np.cumsum(np.bincount(member))[:-1]):
            there = own[known[own]]
            if len(there) >= NEIGHBOURS:
                near[own] = there[cKDTree(position_m[there]).query(position_m[own], NEIGHBOURS)[1]]
    return near


def _tamed(z: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return residuals (n,) without outliers: `MAX_Z` scales from its neighbours at most.

    The scale is their own where they scatter more: an outlier is a single link, and what neighbours
    have in common, level or scatter, is none.
    """
    common = np.median(z[near], axis=1)
    most = MAX_Z * np.maximum(MAD_SD * np.median(np.abs(z[near] - common[:, None]), axis=1), 1.0)
    return common + np.clip(z - common, -most, most)


def _nuisance(links: Links, mean_db: np.ndarray) -> tuple[Columns, list[slice]]:
    """Return what every base may be wrong in [dB], and which columns are of ends of one kind.

    Also over its prediction (n,): weak levels are those of ways that it does not follow.
    """
    slope = np.log10(links.distance_m / 100.0)
    blocks, prior_sd_db, families = [], [], []
    for members in (links.los, ~links.los):
        if members.any():
            blocks += [members[:, None].astype(float), (members * slope)[:, None]]
            prior_sd_db += [LEVEL_SD_DB, SLOPE_SD_DB]
    for values in (mean_db, links.elevation_deg):
        blocks.append(curve_columns(values, CURVE_KNOTS, circular=False))
        prior_sd_db += [NUISANCE_SD_DB] * blocks[-1].shape[1]
    for label in (links.device, links.receiver, links.track):
        members = np.unique(label)
        if 1 < len(members) <= MAX_ENDS:
            blocks.append(one_hot(label, members.tolist()))
            families.append(slice(len(prior_sd_db), len(prior_sd_db) + len(members)))
            prior_sd_db += [SPREAD_DB] * len(members)
    return Columns(np.hstack(blocks), np.array(prior_sd_db)), families


def _with_usual_spreads(evidence: CorrelatedEvidence, z: np.ndarray, nuisance: Columns,
                        families: list[slice]) -> Columns:
    """Return the nuisance with the spread of most ends of each kind as their prior.

    The levels of ends are estimated beside all else and a wide prior. Half of them are nearer to
    their median than those that are off, so the robust spread is that of the others; two tell
    nothing of how much most differ.
    """
    for family in families:
        prior_sd = nuisance.prior_sd.copy()
        prior_sd[family] = LEVEL_SD_DB
        level_db, error_db = evidence.coefficients(z, Columns(nuisance.values, prior_sd))
        level_db, error_db = level_db[family], error_db[family]
        freedom = len(level_db) - 2
        usual = robust_sd(level_db) ** 2 - float(np.median(error_db)) ** 2
        spread = (SPREAD_ENDS * SPREAD_DB**2 + freedom * max(usual, 0.0)) / (SPREAD_ENDS + freedom)
        prior_sd[family] = np.sqrt(spread)
        nuisance = replace(nuisance, prior_sd=prior_sd)
    return nuisance


def is_judged_by_levels(effect: Effect) -> bool:
    """Return whether an effect changes levels, so that residuals can show it."""
    return effect.stage not in ("limit", "detection")
