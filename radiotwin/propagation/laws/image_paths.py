"""The channel that follows reflected and diffracted paths over the 3D map.

With it: levels of paths over a map whose frame, materials or shapes may be other than declared, and
the level and error scale of links with, and without, line of sight over such a map.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize
from typing_extensions import override

from radiotwin.inference import student
from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.inference.student import DOF
from radiotwin.links import LinkGeometry, Links, design_effect
from radiotwin.propagation.laws.base import (
    ANY_LEVEL_SD_DB,
    ChannelModel,
    require_names,
    require_number,
)
from radiotwin.propagation.laws.followed_paths import (
    declared_antenna_db,
    free_space,
    interaction_gains,
    path_gains,
)
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.propagation.laws.published import free_space_db

BLOCK_M = 100.0  # side of the ground within which the links of a device err alike
MIN_NLOS = 30  # links without line of sight that the diffuse power is fitted to
DIFFUSE_DEFAULT = (-150.0, 3.0)  # nearly nothing; the exponent then does not matter
DIFFUSE_BOUNDS = np.array([[-150.0, 2.0], [-60.0, 6.0]])
NEAR_QUANTILE = 0.05  # of links that are nearer than where diffuse power is bounded
MIN_LOSS_DB = 6.0  # of diffuse power beside free space: one reflection at concrete loses as much
DIFFUSE_STARTS_DB = (-100.0, -110.0, -120.0, -130.0)
LOS_SLOPE_SD_DB, NLOS_SLOPE_SD_DB = 1.0, 5.0  # prior: how wrong the fall may be [dB per decade]
ERROR_SCALE_DB = 4.0  # of the Cauchy loss of the fit of the diffuse power
OFFSET_SD_DB = 6.0  # prior of what reflections and diffractions lie above those of the map
MAX_OFFSET_DB = 20.0
Offsets = tuple[float, float]
"""Levels of reflected and of diffracted paths above those of the map [dB]."""


def scale_db(class_scale_db: float | np.ndarray, square_db: np.ndarray) -> np.ndarray:
    """Return the Student-t scale (n,) [dB] of links over a map with errors.

    Args:
        class_scale_db: scale of the class where errors of the map do nothing [dB].
        square_db: (n,) mean square of what errors of the map do [dB²].
    """
    return np.sqrt(class_scale_db**2 + square_db * (DOF - 2) / DOF)


def fit_class(level_db: np.ndarray, limits_db: np.ndarray, paths: np.ndarray,
              square_db: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Fit level and error scale of the links of one class (maximum likelihood).

    Args:
        level_db: (n,) measured levels [dB]; NaN: not detected.
        limits_db: (n,) below which levels are not detected [dB].
        paths: (n,) levels of the followed paths [dB].
        square_db: (n,) mean square of what errors of the map do [dB²].
        start: result of an earlier fit to start from; None: the median offset.

    Returns:
        (2,) offset of measured levels from those of the paths [dB], and logarithm of the error
        scale where errors of the map do nothing.
    """
    if start is None:
        seen = np.isfinite(level_db)
        start = np.array([np.median((level_db - paths)[seen]), 0.5])

    def nll(numbers: np.ndarray) -> float:
        class_scale_db = float(np.exp(np.clip(numbers[1], -3, 4)))
        return float(student.censored_nll(level_db, limits_db, paths + numbers[0],
                                          scale_db(class_scale_db, square_db), DOF).sum())

    found = minimize(nll, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
    return np.array([found.x[0], np.clip(found.x[1], -3, 4)])


class LinkFit:
    """Repeated fits of both classes of some links, each started from the result of the last one.

    Attributes:
        level_db: (n,) [dB]; NaN: not detected.
        limits_db: (n,) below which levels are not detected [dB].
    """

    def __init__(self, level_db: np.ndarray, limit_db: Limit) -> None:
        self.level_db = level_db
        self.limits_db = limits_of(limit_db, len(level_db))
        self._start: dict[bool, np.ndarray] = {}

    def fit(self, los: np.ndarray, paths_db: np.ndarray, square_db: np.ndarray | None = None
            ) -> tuple[np.ndarray, np.ndarray]:
        """Fit both classes.

        Args:
            los: (n,) bool, class of each link.
            paths_db: (n,) levels of the followed paths [dB].
            square_db: (n,) mean square of what the map's errors do [dB²]; None: nothing.

        Returns:
            negative log-likelihood of each link (n,) [nats], and residuals over their scale (n,), 0
            where not detected.
        """
        nll, z = np.zeros((2, len(self.level_db)))
        square_db = np.zeros(len(los)) if square_db is None else square_db
        for state in (False, True):
            of_class = los == state
            if not np.isfinite(self.level_db[of_class]).any():
                continue
            level_db, limits_db = self.level_db[of_class], self.limits_db[of_class]
            offset_db, log_scale = self._start[state] = fit_class(
                level_db, limits_db, paths_db[of_class], square_db[of_class],
                self._start.get(state))
            mean_db = paths_db[of_class] + offset_db
            errors_db = scale_db(float(np.exp(log_scale)), square_db[of_class])
            nll[of_class] = student.censored_nll(level_db, limits_db, mean_db, errors_db, DOF)
            z[of_class] = np.nan_to_num((level_db - mean_db) / errors_db)
        return nll, z


def links_as_one(links: LinkGeometry, z: np.ndarray) -> float:
    """Return how many links carry the information of one, as neighbours err alike.

    Args:
        links: n links.
        z: (n,) residuals over their scale.
    """
    block = np.column_stack([links.device, np.floor(links.receiver_m[:, :2] / BLOCK_M)])
    label = np.unique(block, axis=0, return_inverse=True)[1].reshape(-1)
    return design_effect(label, z)


class ImagePaths(ChannelModel):
    """Power of the paths over the map (`radiotwin.propagation.paths`) plus diffuse power.

    The diffuse power stands for what reaches any position on ways that are not followed: more
    bounces and edges, rough walls. It falls with distance by a law of its own. Levels and slopes,
    one for each class of line of sight, are fitted with the effects.

    Attributes:
        law: fitted to the same links; predicts what small changes do, quickly, and the
            size of the errors.
        diffuse: gain of the diffuse power at 100 m [dB], and the exponent of its fall.
    """

    name = "image_paths"
    uses_map = True
    follows_paths = True

    def __init__(self, law: ChannelModel | None = None,
                 diffuse: tuple[float, float] = DIFFUSE_DEFAULT) -> None:
        self.law: ChannelModel = SegmentedLogDistance() if law is None else law
        self.diffuse = diffuse

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        self.law.fit(links, level_db, limit_db, seed)
        return self.fit_diffuse(links, level_db, limit_db)

    def fit_diffuse(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                    antenna_db: np.ndarray | float = 0.0) -> Self:
        """Fit the diffuse power and a level to the links without line of sight.

        Args:
            links: n links.
            level_db: (n,) as in `fit` [dB].
            limit_db: as in `fit` [dB].
            antenna_db: (n,) what antennas add to the power of the followed paths [dB].
        """
        nlos = links.select(~links.los)
        level_db = level_db[~links.los]
        blank = np.isnan(level_db)
        limits_db = limits_of(limit_db, len(links))[~links.los]
        level_db = np.where(blank, limits_db, level_db)
        known = np.isfinite(level_db)
        # Links that were not detected alone only say that it is weak: take the weakest
        if known.sum() < MIN_NLOS or blank[known].all():
            self.diffuse = DIFFUSE_DEFAULT
            return self
        power = path_gains(nlos)
        power = power * 10 ** (np.broadcast_to(antenna_db, len(links))[~links.los] / 10)
        near_m = min(float(np.quantile(links.distance_m, NEAR_QUANTILE)), 100.0)

        def loss(numbers: np.ndarray) -> float:
            clipped = _clip_diffuse(numbers, near_m, links.frequency_hz)
            error_db = level_db - _with_diffuse_db(power, nlos.distance_m, *clipped)
            error_db = error_db - np.median(error_db[known & ~blank])
            error_db = np.where(blank, np.minimum(error_db, 0.0), error_db)[known]
            misfit = np.log1p((error_db / ERROR_SCALE_DB) ** 2).sum()
            return float(misfit + np.abs(numbers - clipped).sum())

        starts = [np.array([start_db, DIFFUSE_DEFAULT[1]]) for start_db in DIFFUSE_STARTS_DB]
        found = minimize(loss, min(starts, key=loss), method="Nelder-Mead",
                         options={"xatol": 0.1, "fatol": 0.5}).x
        gain_db, exponent = _clip_diffuse(found, near_m, links.frequency_hz)
        self.diffuse = float(gain_db), float(exponent)
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        return self.level_db(_seen_gains(links), links), self.law.predict(links)[1]

    def level_db(self, power: np.ndarray, links: LinkGeometry) -> np.ndarray:
        """Return the mean level (n,) [dB] of links whose paths carry these powers (n,)."""
        return _with_diffuse_db(power, links.distance_m, *self.diffuse)

    @override
    def declared_db(self, links: Links) -> np.ndarray | float:
        """Return the same with antennas along each path; diffuse power has their mean, 0 dBi."""
        if not links.declared.has_antennas:
            return links.declared_db
        geometry, power = links.geometry, _seen_gains(links.geometry)
        through = power * 10 ** (declared_antenna_db(links) / 10)
        return links.declared.fed_db[links.device] + self.level_db(through, geometry) \
            - self.level_db(power, geometry)

    @property
    @override
    def quick(self) -> ChannelModel:
        return self.law

    @override
    def level_columns(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        # Slopes: what the map's materials and walls lack adds up on the way.
        los, slope = links.los, np.log10(links.distance_m / 100.0)
        columns = np.column_stack([los, ~los, los * slope, ~los * slope])
        return columns.astype(float), np.array([ANY_LEVEL_SD_DB] * 2 + [LOS_SLOPE_SD_DB,
                                                                         NLOS_SLOPE_SD_DB])

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, settings = self.law.state()
        return arrays, {"law": self.law.name, "law_settings": settings,
                        "diffuse": list(self.diffuse)}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        require_names("settings", settings, ["law", "law_settings", "diffuse"])
        if settings["law"] != SegmentedLogDistance.name:
            raise ValueError(f"law is not {SegmentedLogDistance.name!r}")
        return cls(SegmentedLogDistance.from_state(arrays, settings["law_settings"]),
                   stored_diffuse(settings["diffuse"]))


def _seen_gains(links: LinkGeometry) -> np.ndarray:
    """Return the power (n,) of the paths over a map, with the links' own lines of sight.

    A link's line of sight may differ from the map's: an effect adds or removes an obstacle, or the
    paths start beside an estimated position. Then the direct path is dropped, or added as in free
    space; all other paths stay.
    """
    gains = interaction_gains(links)
    other = (gains[:, 0] > 0) != links.los
    gains[other, 0] = np.where(links.los[other], free_space(links)[other], 0.0)
    return gains.sum(axis=1)


def stored_diffuse(value: Any) -> tuple[float, float]:
    """Return gain at 100 m [dB] and exponent of stored diffuse power; ValueError if damaged."""
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("the diffuse power is not a gain and an exponent")
    named = dict(zip(("gain", "exponent"), value, strict=True))
    return require_number(named, "gain", -300.0, 100.0), require_number(named, "exponent", 0, 20)


def _clip_diffuse(numbers: np.ndarray, near_m: float, frequency_hz: float) -> np.ndarray:
    """Clip gain [dB] and exponent (2,) of diffuse power to weaker than free space beyond `near_m`.

    Without that limit, diffuse power would replace paths that explain no measurement, and then
    the paths of links with line of sight, too: the level of links without line of sight is fitted
    together with it.
    """
    gain_db, exponent = np.clip(numbers, *DIFFUSE_BOUNDS)
    most_db = -free_space_db(np.array(100.0), frequency_hz) - MIN_LOSS_DB \
        + 10 * (exponent - 2.0) * np.log10(near_m / 100.0)
    return np.array([np.clip(gain_db, None, most_db), exponent])


def _with_diffuse_db(power: np.ndarray, distance_m: np.ndarray, gain_db: float,
                    exponent: float) -> np.ndarray:
    """Return the level (n,) [dB] of followed power (n,), linear, and of diffuse power."""
    return 10 * np.log10(power + 10 ** (gain_db / 10) * (distance_m / 100.0) ** -exponent)


def paths_db(links: LinkGeometry, diffuse: tuple[float, float], offsets_db: Offsets = (0.0, 0.0)
             ) -> np.ndarray:
    """Return the level (n,) [dB] of followed paths and diffuse power, see `ImagePaths`."""
    return _level_db(interaction_gains(links), links.distance_m, diffuse, offsets_db)


def moved(links: LinkGeometry, east_m: float, north_m: float) -> LinkGeometry:
    """Return links with both ends moved over their map, and the line of sight there."""
    step_m = np.array([east_m, north_m, 0.0])
    device_m, receiver_m = links.device_m + step_m, links.receiver_m + step_m
    los = links.los if links.city is None else links.city.line_of_sight(device_m, receiver_m)
    return replace(links, device_m=device_m, receiver_m=receiver_m, los=los)


def fit_offsets(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                diffuse: tuple[float, float]) -> Offsets:
    """Estimate how much stronger reflections and diffractions are than over the map [dB].

    Maximum a posteriori under a normal prior of `OFFSET_SD_DB`, which keeps both at 0 where levels
    cannot tell them apart, since each class of line of sight has a level of its own.

    Args:
        links: n links.
        level_db: (n,) as in `ImagePaths.fit` [dB].
        limit_db: as in `ImagePaths.fit` [dB].
        diffuse: as in `ImagePaths`.
    """
    fit, gains = LinkFit(level_db, limit_db), interaction_gains(links)
    distance_m = links.distance_m
    undisturbed_db = _level_db(gains, distance_m, diffuse, np.zeros(2))
    as_one = links_as_one(links, fit.fit(links.los, undisturbed_db)[1])

    def loss(offsets_db: np.ndarray) -> float:
        clipped_db = np.clip(offsets_db, -MAX_OFFSET_DB, MAX_OFFSET_DB)
        prior = 0.5 * (offsets_db**2).sum() / OFFSET_SD_DB**2
        level_db = _level_db(gains, distance_m, diffuse, clipped_db)
        return fit.fit(links.los, level_db)[0].sum() / as_one + float(prior)

    simplex = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])
    found = minimize(loss, np.zeros(2), method="Nelder-Mead",
                     options={"xatol": 0.1, "fatol": 0.02, "initial_simplex": simplex})
    reflected_db, diffracted_db = np.clip(found.x, -MAX_OFFSET_DB, MAX_OFFSET_DB).tolist()
    return reflected_db, diffracted_db


def _level_db(gains: np.ndarray, distance_m: np.ndarray, diffuse: tuple[float, float],
              offsets_db: Offsets | np.ndarray) -> np.ndarray:
    """Return the level (n,) [dB] of `interaction_gains` (n, 3) and diffuse power."""
    factor = 10 ** (np.array([0.0, *offsets_db]) / 10)
    return _with_diffuse_db(gains @ factor, distance_m, *diffuse)
