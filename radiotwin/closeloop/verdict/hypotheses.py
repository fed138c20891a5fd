"""Evidence for causes of a residual: marginal likelihoods with an effect over that without.

Each hypothesis includes nuisance terms: level and slope for LoS and NLoS links, tolerances of
devices, receivers and flights, and a correlated field over positions (`radiotwin.inference`). The
usual tolerance of a kind of ends is estimated robustly, so that the few faulty ones do not widen it
(empirical Bayes; Efron 2008, 'Microarrays, empirical Bayes and the two-groups model', Stat. Sci.
23).

Unnamed causes are curves over each variable, for all links, each receiver or each device. If a
curve explains more than any effect of the catalogue, the cause is not in the catalogue.
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
from radiotwin.inference.gaussian import MAD_SD
from radiotwin.links import Links
from radiotwin.twin.model.correlated_shadowing import receivers_move
from radiotwin.twin.model.model import Fit

MAX_Z = 3.0  # residuals are clipped to this many scales from the median of their neighbours
NEIGHBOURS = 9
LEVEL_SD_DB, SLOPE_SD_DB = 20.0, 10.0  # prior sd of a level at 100 m [dB] and a slope [dB/decade]
# Prior tolerance of devices, receivers or flights [dB], and the number of ends it counts for.
SPREAD_DB, SPREAD_ENDS = 0.5, 4
MAX_ENDS = 40  # more devices, receivers, tracks or flights get no terms of their own
MIN_STEPS = 3  # differences of successive tracks from which their median is that of a drift
CURVE_KNOTS, NUISANCE_SD_DB = 6, 2.0  # base's error over prediction and elevation: knots, sd [dB]
KNOTS = 8  # knots of an unnamed curve
TIME_KNOTS = 24  # knots of one over time
CURVE_SD_DB = 4.0  # prior sd of an unnamed curve [dB]
MAX_COLUMNS = 250  # larger hypotheses are not tested
MAX_SUBSET = 6  # of sparse effects, all subsets of the largest 1 to 6 coefficients are tried
STEP_SHARE = 0.3  # finite-difference step over a parameter's typical uncertainty


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Evidence for further causes, on the n training links of one fit.

    Attributes:
        evidence: marginal likelihood of its residuals with a correlated field.
        links: the training links.
        scale_db: (n,) error scale, by which all residuals are divided.
        nuisance: design columns of usual errors of a base, fitted with every cause [scales].
        base_z: (n,) residuals of the fit [scales], outliers clipped.
        mean_db: (n,) predicted mean [dB].
        coefficients: coefficients of the fit, levels first.
        near: (n, `NEIGHBOURS`) rows of the nearest links of the same series.
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
        """Prepare the evidence for effects that a fit lacks.

        Args:
            fit: the base with the effects that were found so far.
            seed: random seed of the sample of links, if there are many.
        """
        training = fit.model.training
        links, predicted = fit.links.select(fit.train), training.predict(fit)
        nuisance, families = _nuisance(links, predicted.mean_db)
        nuisance = Columns(nuisance.values / predicted.scale_db[:, None], nuisance.prior_sd)
        residual_db = training.residual_db(fit)
        # A blank that the model predicts contains no information.
        informative = np.isfinite(training.level_db) | (residual_db < 0)
        residual_db = np.where(informative, residual_db, np.nan)
        moving = receivers_move(links)
        series = links.device if moving else links.receiver
        position_m = links.receiver_m if moving else links.device_m[links.device]
        near = _nearest_links(series, links.track, position_m, np.isfinite(residual_db))
        z = _clip_outliers(residual_db / predicted.scale_db, near)
        evidence = CorrelatedEvidence.fit(series, position_m, z, nuisance, seed)
        nuisance = _with_estimated_tolerances(evidence, z, nuisance, families)
        return cls(evidence, links, predicted.scale_db, nuisance, z, predicted.mean_db,
                   fit.coefficients, near)

    @cached_property
    def _decorrelated_nuisance(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Decorrelated nuisance columns; log likelihood and log variances without a further effect.

        The (2,) variances are those of noise and of the field that is correlated over positions.
        """
        columns = self.evidence.rotated(self.nuisance.values)
        found = self.evidence.of_rotated(self.evidence.rotated(self.base_z), columns,
                                         self.nuisance.prior_sd)
        return columns, *found

    @property
    def rest_and_noise_db(self) -> tuple[float, float]:
        """Standard deviations of the place-bound residual and of noise [dB]."""
        _, _, theta = self._decorrelated_nuisance
        noise_db = np.exp(0.5 * theta[0]) * float(np.median(self.scale_db))
        return noise_db * np.exp(0.5 * theta[1]), noise_db

    def gain_nats(self, z: np.ndarray, columns: Columns,
                  widening: np.ndarray | None = None) -> float:
        """Return the evidence for an effect: log marginal likelihood ratio over the fit [nats].

        Args:
            z: (n,) residuals to be explained by the effect and the nuisances [error scales].
            columns: design columns of the effect, divided by the error scales.
            widening: (n,) factor by which the effect widens the error scales, by which `z` and
                `columns` are divided; None: 1.
        """
        nuisance, base, theta = self._decorrelated_nuisance
        if widening is not None:
            nuisance = self.evidence.rotated(self.nuisance.values / widening[:, None])
            widened = np.log(widening[self.evidence.rows])
            base += widened.sum() + 0.5 * np.log(np.maximum(np.count_nonzero(widened), 1))
        both = np.hstack([nuisance, self.evidence.rotated(columns.values)])
        sd = np.concatenate([self.nuisance.prior_sd, columns.prior_sd])
        return self.evidence.of_rotated(self.evidence.rotated(z), both, sd, theta)[0] - base

    def information(self, pattern_db: np.ndarray) -> float:
        """Return the Fisher information on the size of a pattern (n,) of unit size [1/size²]."""
        columns, _, theta = self._decorrelated_nuisance
        pattern = self.evidence.rotated(pattern_db / self.scale_db)
        return self.evidence.information(pattern, columns, self.nuisance.prior_sd, theta)

    def effect_evidence_nats(self, fit: Fit) -> float:
        """Return the evidence for the last effect of a fit, over the model without it [nats].

        Coefficients are integrated over their priors, and so are the searched parameters, whose
        effect on levels is linearised (Laplace's approximation; MacKay 2003, 'Information theory,
        inference, and learning algorithms', Ch. 28).

        Args:
            fit: the fit of this object with one more effect.
        """
        effect, coefficients = fit.effects[-1], fit.coefficients_of(-1)
        term = fit.model.terms[-1].select(fit.train)
        scale_db, widening = self.scale_db, None
        if term.random_effect_sd_db is not None:  # the effect adds scatter to readings
            scale_db = np.hypot(scale_db, term.random_effect_sd_db)
            widening = scale_db / self.scale_db
        z = _clip_outliers(fit.model.training.residual_db(fit) / scale_db, self.near)
        # Add the fitted contribution of the effect's columns, and of the levels that changed with
        # it, to the residual again, since the likelihood integrates over both.
        contribution_db = term.columns @ coefficients
        levels = fit.model.level_columns[fit.train]
        p = levels.shape[1]
        contribution_db += levels @ (fit.coefficients[:p] - self.coefficients[:p])
        z += contribution_db / scale_db
        columns = Columns(term.columns / scale_db[:, None], term.prior_sd_db)
        if effect.sparse:
            return self._sparse_evidence_nats(z, columns, coefficients)
        slopes = _slopes(fit)
        return self.gain_nats(z, columns.beside(
            Columns(slopes.values / scale_db[:, None], slopes.prior_sd)), widening)

    def _sparse_evidence_nats(self, z: np.ndarray, columns: Columns,
                              coefficients: np.ndarray) -> float:
        """Return the evidence for a sparse effect: only some devices (or receivers) deviate [nats].

        Each column belongs to one of them. The subsets tried are the 1, 2, … columns whose
        coefficients (q,) are farthest from the median, and all; the best one counts.

        The prior is uniform over the subset's size, and over the subsets of one size (Scott and
        Berger 2010, 'Bayes and empirical-Bayes multiplicity adjustment in the variable-selection
        problem', Ann. Stat. 38), so that one faulty end is not penalised for all good ones.
        """
        order, q = np.argsort(-np.abs(coefficients - np.median(coefficients))), len(coefficients)
        found = []
        for count in sorted({*range(1, min(q, MAX_SUBSET) + 1), q}):
            subset = Columns(columns.values[:, order[:count]], columns.prior_sd[order[:count]])
            found.append(self.gain_nats(z, subset) - log(comb(q, count)) - log(q))
        return max(found)

    def group_evidence_nats(self, group: np.ndarray) -> float:
        """Return the evidence for an unnamed cause that acts only on a group of links, at least 0.

        `group` is (n,) bool. The cause is a smooth curve over one variable, such as time; the
        likelihoods are averaged over all variables [nats].
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
        """Evidence for an unnamed curve over each variable [nats], by its name."""
        found: dict[str, float] = {}
        for name, values in self._curves():
            scaled = values / self.scale_db[:, None]
            columns = Columns(scaled, np.full(values.shape[1], CURVE_SD_DB))
            found[name] = self.gain_nats(self.base_z, columns)
        return found

    def _variables(self) -> dict[str, tuple[np.ndarray, int, bool]]:
        """Return the variables of unnamed curves: values (n,), number of knots, whether an angle.

        Left out are variables that under half of the links have, or with too few distinct values.
        """
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
        """Yield name and design columns (n, q) of each kind of cause that has no name.

        First a level of each (receiver, flight), and of each (device, flight); then, for each
        variable, a curve common to all links, one for each receiver, one for each device. Kinds
        with more than `MAX_COLUMNS` columns, or of a single receiver or device, are left out.
        """
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
    """Return derivatives (n, q) of levels [dB] by the last effect's searched parameters, if any.

    Their prior sds are those of uniform distributions over the allowed ranges.
    """
    model, effect = fit.model, fit.effects[-1]
    variation = effect.variation()
    if variation is None:
        return Columns(np.zeros((int(model.train.sum()), 0)), np.zeros(0))
    centre = variation.effect(variation.values)
    if not centre.is_same(effect):  # varied with faster levels than it was fitted with
        model = model.with_effect_at(-1, centre)
    mean_db, slopes_db = model.training.predict(fit).mean_db, []
    # For paths, take the step that the folds use, for which the paths are computed already.
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


def _nearest_links(series: np.ndarray, track: np.ndarray, position_m: np.ndarray,
                   known: np.ndarray) -> np.ndarray:
    """Return the rows (n, `NEIGHBOURS`) of the nearest links, by the position of the moving end.

    They are of the same fixed end and track, or of any track if this has too few: another flight
    may scatter less. A link whose fixed end has too few gets its own row in all places.
    """
    near = np.repeat(np.arange(len(series))[:, None], NEIGHBOURS, axis=1)
    for labels in (series[:, None], np.column_stack([series, track])):
        member = np.unique(labels, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(member, kind="stable")
        for rows in np.split(order, np.cumsum(np.bincount(member))[:-1]):
            usable = rows[known[rows]]
            if len(usable) >= NEIGHBOURS:
                tree = cKDTree(position_m[usable])
                near[rows] = usable[tree.query(position_m[rows], NEIGHBOURS)[1]]
    return near


def _clip_outliers(z: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Clip each residual (n,) to `MAX_Z` scales from the median of its neighbours.

    The scale is the robust sd of the neighbours (rows `near`), at least 1: a level or scatter that
    neighbours share is no outlier.
    """
    median = np.median(z[near], axis=1)
    scale = np.maximum(MAD_SD * np.median(np.abs(z[near] - median[:, None]), axis=1), 1.0)
    return median + np.clip(z - median, -MAX_Z * scale, MAX_Z * scale)


@dataclass(frozen=True, eq=False)
class _Family:
    """Levels of k ends of one kind: devices, receivers, and tracks or flights.

    Attributes:
        columns: their columns in the nuisance.
        group: (k,) receiver of a track, about whose level its tracks scatter; else 0.
        start_s: (k,) time at which a track or flight begins [s]; NaN for others, or if unknown.
    """

    columns: slice
    group: np.ndarray
    start_s: np.ndarray

    def usual_variance(self, level_db: np.ndarray, covariance: np.ndarray,
                       seen: np.ndarray) -> tuple[float, int]:
        """Estimate the variance of the good ends' levels [dB²], and its degrees of freedom.

        The smaller one of two robust estimates counts: from deviations from the group's median,
        which a faulty flight does not widen, and from differences of successive tracks less their
        median, which a step or a drift does not widen (von Neumann 1941, 'Distribution of the ratio
        of the mean square successive difference to the variance', Ann. Math. Stat. 12). It is low
        by a fifth for many tracks and by half for groups of three, as faults must stand out. The
        error of the estimates is subtracted; what all levels of a group share, and no link
        determines, cancels.

        Args:
            level_db: (k,) estimated levels [dB].
            covariance: (k, k) their covariance [dB²].
            seen: (k,) bool, ends with a usable reading. Those alone in their group do not count.
        """
        member, size = np.unique(np.where(seen, self.group, -1), return_inverse=True,
                                 return_counts=True)[1:]
        used = seen & (size[member] > 1)
        group, start_s, level_db = self.group[used], self.start_s[used], level_db[used]
        covariance = covariance[np.ix_(used, used)]
        freedom = len(group) - len(np.unique(group)) - 1
        if freedom < 1:
            return 0.0, 0
        same = group[:, None] == group
        centred = np.eye(len(same)) - same / same.sum(axis=1)
        medians = np.array([np.median(level_db[each]) for each in same])
        ratio = len(same) / (freedom + 1)  # variance of levels over that of their deviations
        found = [ratio * ((MAD_SD * np.median(np.abs(level_db - medians))) ** 2
                          - np.median(np.diag(centred @ covariance @ centred.T)))]
        steps_db, variances = [], []
        for each in np.unique(group):
            rows = np.flatnonzero((group == each) & np.isfinite(start_s))
            contrast = np.diff(np.eye(len(same))[rows[np.argsort(start_s[rows])]], axis=0)
            step_db = contrast @ level_db
            steps_db.append(step_db - (np.median(step_db) if len(step_db) >= MIN_STEPS else 0.0))
            variances.append(np.diag(contrast @ covariance @ contrast.T))
        step_db, variance = np.concatenate(steps_db), np.concatenate(variances)
        if len(step_db) >= MIN_STEPS:
            found.append(0.5 * ((MAD_SD * np.median(np.abs(step_db))) ** 2 - np.median(variance)))
        return max(float(min(found)), 0.0), freedom


def _nuisance(links: Links, mean_db: np.ndarray) -> tuple[Columns, list[_Family]]:
    """Return design columns of usual errors of a base, which every hypothesis contains [dB].

    They are a level and a distance slope of LoS and of NLoS links, a curve over elevation and over
    the predicted `mean_db` (n,), as weak links arrive by paths that the base omits, and a level of
    each device, receiver and track (flight of a receiver), or flight if tracks are too many.

    Returns:
        the columns with prior sds, and the families of columns of the last three kinds.
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
    by_track = len(np.unique(links.track)) <= MAX_ENDS
    in_time = links.track if by_track else links.flight
    for label in (links.device, links.receiver, in_time):
        members, first, member = np.unique(label, return_index=True, return_inverse=True)
        if 1 < len(members) <= MAX_ENDS:
            blocks.append(one_hot(label, members.tolist()))
            columns = slice(len(prior_sd_db), len(prior_sd_db) + len(members))
            group, start_s = np.zeros(len(members)), np.full(len(members), np.nan)
            if label is in_time and by_track:
                group = links.receiver[first]
            if label is in_time and not links.time_restarts:
                np.fmin.at(start_s, member, links.time_s)
            families.append(_Family(columns, group, start_s))
            prior_sd_db += [SPREAD_DB] * len(members)
    return Columns(np.hstack(blocks), np.array(prior_sd_db)), families


def _with_estimated_tolerances(evidence: CorrelatedEvidence, z: np.ndarray, nuisance: Columns,
                               families: list[_Family]) -> Columns:
    """Set the prior sds of the levels of devices, receivers, tracks or flights to their tolerance.

    The levels of one kind are estimated with a wide prior. If fewer than half are faulty, their
    robust spread is the tolerance of the good ones. It is shrunk to `SPREAD_DB`, fully so for two
    of a kind.
    """
    for family in families:
        prior_sd = nuisance.prior_sd.copy()
        prior_sd[family.columns] = LEVEL_SD_DB
        level_db, covariance = evidence.coefficients(z, Columns(nuisance.values, prior_sd))
        # The level of an end without a usable reading is as uncertain as before.
        seen = (nuisance.values[evidence.rows, family.columns] != 0).any(axis=0)
        usual, freedom = family.usual_variance(level_db[family.columns],
                                               covariance[family.columns, family.columns], seen)
        spread = (SPREAD_ENDS * SPREAD_DB**2 + freedom * usual) / (SPREAD_ENDS + freedom)
        prior_sd[family.columns] = np.sqrt(spread)
        nuisance = replace(nuisance, prior_sd=prior_sd)
    return nuisance


def changes_levels(effect: Effect) -> bool:
    """Return whether an effect changes levels, and not only which links are blank."""
    return effect.stage not in ("limit", "detection")
