"""ImagePaths: the channel model of reflected and diffracted paths over the 3D map.

Also: path levels over a map with a wrong frame, materials or shapes, and fits of level and error
scale for LoS and NLoS over such a map.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize
from typing_extensions import override

from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.inference.student import DOF, ReadingLaw
from radiotwin.links import LinkGeometry, Links, design_effect
from radiotwin.propagation.laws.base import (
    ANY_LEVEL_SD_DB,
    ChannelModel,
    ground_blocks,
    require_names,
    require_number,
)
from radiotwin.propagation.laws.followed_paths import (
    declared_antenna_db,
    free_space_gains,
    interaction_gains,
    path_gains,
)
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.propagation.laws.published import free_space_db

MIN_NLOS = 30  # NLoS links needed to fit the diffuse power
DIFFUSE_DEFAULT = (-150.0, 3.0)  # nearly no power; the exponent then does not matter
DIFFUSE_BOUNDS = np.array([[-150.0, 2.0], [-60.0, 6.0]])  # of gain at 100 m [dB] and exponent
NEAR_QUANTILE = 0.05  # share of links nearer than the distance at which diffuse power is bounded
MIN_LOSS_DB = 6.0  # of diffuse power below free space: one reflection at concrete loses as much
DIFFUSE_STARTS_DB = (-100.0, -110.0, -120.0, -130.0)
LOS_SLOPE_SD_DB, NLOS_SLOPE_SD_DB = 1.0, 5.0  # prior of errors of the slope [dB per decade]
ERROR_SCALE_DB = 4.0  # of the Cauchy loss in the fit of the diffuse power
OFFSET_SD_DB = 6.0  # prior of the offsets of reflected and diffracted paths
MAX_OFFSET_DB = 20.0
Offsets = tuple[float, float]
"""Measured minus computed level of reflected, and of diffracted, paths [dB]."""


def scale_db(class_scale_db: float | np.ndarray, square_db: np.ndarray) -> np.ndarray:
    """Return the Student-t error scale (n,) [dB] of links over a map with errors.

    `square_db` (n,) are the mean squares of the level changes that map errors cause [dB²].
    """
    return np.sqrt(class_scale_db**2 + square_db * (DOF - 2) / DOF)


def fit_class(level_db: np.ndarray, limits_db: np.ndarray, paths: np.ndarray,
              square_db: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Fit level offset and error scale of LoS, or of NLoS, links by maximum likelihood.

    Levels (n,) [dB], NaN: not detected, at least one detected, are compared with the levels `paths`
    (n,) [dB]; `square_db` (n,) as in `scale_db`. Starts from an earlier result, or the median
    offset. Returns (2,) offset [dB], and ln of the error scale [dB] over an exact map, in -3..4.
    """
    if start is None:
        detected = np.isfinite(level_db)
        start = np.array([np.median((level_db - paths)[detected]), 0.5])

    def nll(parameters: np.ndarray) -> float:
        class_scale_db = float(np.exp(np.clip(parameters[1], -3, 4)))
        law = ReadingLaw(paths + parameters[0], scale_db(class_scale_db, square_db), limits_db, DOF)
        return float(law.nll(level_db).sum())

    found = minimize(nll, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
    return np.array([found.x[0], np.clip(found.x[1], -3, 4)])


class LinkFit:
    """Fit level offset and error scale of LoS and NLoS again and again for other computed levels.

    Each fit starts from the result of the last fit.

    Attributes:
        level_db: (n,) measured levels [dB]; NaN: not detected.
        limits_db: (n,) limits of detection [dB].
    """

    def __init__(self, level_db: np.ndarray, limit_db: Limit) -> None:
        self.level_db = level_db
        self.limits_db = limits_of(limit_db, len(level_db))
        self._start: dict[bool, np.ndarray] = {}

    def fit(self, los: np.ndarray, paths_db: np.ndarray, square_db: np.ndarray | None = None
            ) -> tuple[np.ndarray, np.ndarray]:
        """Fit level offset and error scale to the LoS and to the NLoS links; return the misfit.

        `square_db` (n,) are mean squares of the level changes that map errors cause [dB²]. Returns
        the negative log-likelihood (n,) of each link [nats], and residuals (n,) over their scale, 0
        for links that were not detected. Both are 0 in a class without a detected link.
        """
        nll, z = np.zeros((2, len(self.level_db)))
        square_db = np.zeros(len(los)) if square_db is None else square_db
        for is_los in (False, True):
            of_class = los == is_los
            if not np.isfinite(self.level_db[of_class]).any():
                continue
            level_db, limits_db = self.level_db[of_class], self.limits_db[of_class]
            offset_db, log_scale = self._start[is_los] = fit_class(
                level_db, limits_db, paths_db[of_class], square_db[of_class],
                self._start.get(is_los))
            mean_db = paths_db[of_class] + offset_db
            errors_db = scale_db(float(np.exp(log_scale)), square_db[of_class])
            nll[of_class] = ReadingLaw(mean_db, errors_db, limits_db, DOF).nll(level_db)
            z[of_class] = np.nan_to_num((level_db - mean_db) / errors_db)
        return nll, z


class ImagePaths(ChannelModel):
    """Power of reflected and diffracted paths (`radiotwin.propagation.paths`) plus diffuse power.

    The diffuse power stands for paths that are not computed: more bounces and edges, rough walls.
    It has its own path loss exponent. Levels and slopes for LoS and NLoS are fitted together with
    the effects.

    Attributes:
        law: log-distance law fitted to the same links; predicts small changes quickly (`quick`),
            and the standard deviation of errors.
        diffuse: gain of the diffuse power at 100 m [dB], and its path loss exponent.
    """

    name = "paths"
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
        """Fit gain and exponent of the diffuse power to the NLoS links; a level offset is free.

        DIFFUSE_DEFAULT if fewer than MIN_NLOS of them have a level or limit, or none is detected.
        Arguments as in `fit`; `antenna_db` (n,) is added to the power of the paths [dB].
        """
        nlos = links.select(~links.los)
        level_db = level_db[~links.los]
        blank = np.isnan(level_db)
        limits_db = limits_of(limit_db, len(links))[~links.los]
        level_db = np.where(blank, limits_db, level_db)
        known = np.isfinite(level_db)
        # Without a detected link, the data only say that diffuse power is weak.
        if known.sum() < MIN_NLOS or blank[known].all():
            self.diffuse = DIFFUSE_DEFAULT
            return self
        power = path_gains(nlos)
        power = power * 10 ** (np.broadcast_to(antenna_db, len(links))[~links.los] / 10)
        near_m = min(float(np.quantile(links.distance_m, NEAR_QUANTILE)), 100.0)

        def loss(parameters: np.ndarray) -> float:
            clipped = _clip_diffuse(parameters, near_m, links.frequency_hz)
            error_db = level_db - _with_diffuse_db(power, nlos.distance_m, *clipped)
            error_db = error_db - np.median(error_db[known & ~blank])
            error_db = np.where(blank, np.minimum(error_db, 0.0), error_db)[known]
            misfit = np.log1p((error_db / ERROR_SCALE_DB) ** 2).sum()
            return float(misfit + np.abs(parameters - clipped).sum())

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
        """Return the mean level (n,) [dB] of path power (n,), linear, and diffuse power."""
        return _with_diffuse_db(power, links.distance_m, *self.diffuse)

    @override
    def declared_db(self, links: Links) -> np.ndarray | float:
        """Return what declared powers, cables and antennas add to levels, (n,) [dB]; 0: nothing.

        Antenna gains are those along each path; for diffuse power their mean, 0 dBi.
        """
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
        """Return a level and a slope for LoS and for NLoS; priors keep the slopes small."""
        # Slopes: errors of materials and walls add up along a path.
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
        """Restore the model from its `state`, after checking it."""
        require_names("settings", settings, ["law", "law_settings", "diffuse"])
        if settings["law"] != SegmentedLogDistance.name:
            raise ValueError(f"law is not {SegmentedLogDistance.name!r}")
        return cls(SegmentedLogDistance.from_state(arrays, settings["law_settings"]),
                   stored_diffuse(settings["diffuse"]))


def _seen_gains(links: LinkGeometry) -> np.ndarray:
    """Return the summed power gain (n,) of paths, linear; the direct path counts if `links.los`.

    That may differ from the map: an effect adds an obstacle, or paths start at a rounded position.
    """
    gains = interaction_gains(links)
    differs = (gains[:, 0] > 0) != links.los
    gains[differs, 0] = np.where(links.los[differs], free_space_gains(links)[differs], 0.0)
    return gains.sum(axis=1)


def stored_diffuse(value: Any) -> tuple[float, float]:
    """Return gain at 100 m [dB] and exponent of diffuse power in a file; ValueError if damaged."""
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("the diffuse power is not a gain and an exponent")
    named = dict(zip(("gain", "exponent"), value, strict=True))
    return require_number(named, "gain", -300.0, 100.0), require_number(named, "exponent", 0, 20)


def _clip_diffuse(parameters: np.ndarray, near_m: float, frequency_hz: float) -> np.ndarray:
    """Clip gain at 100 m [dB] and exponent (2,) of diffuse power to DIFFUSE_BOUNDS.

    Diffuse power must also stay MIN_LOSS_DB below free space beyond `near_m`. Otherwise it would
    replace the traced paths, also of LoS links, since the NLoS level is fitted together with it.
    """
    gain_db, exponent = np.clip(parameters, *DIFFUSE_BOUNDS)
    max_gain_db = -free_space_db(np.array(100.0), frequency_hz) - MIN_LOSS_DB \
        + 10 * (exponent - 2.0) * np.log10(near_m / 100.0)
    return np.array([np.clip(gain_db, None, max_gain_db), exponent])


def _with_diffuse_db(power: np.ndarray, distance_m: np.ndarray, gain_db: float,
                    exponent: float) -> np.ndarray:
    """Return the level (n,) [dB] of path power (n,), linear, plus diffuse power."""
    return 10 * np.log10(power + 10 ** (gain_db / 10) * (distance_m / 100.0) ** -exponent)


def paths_db(links: LinkGeometry, diffuse: tuple[float, float], offsets_db: Offsets = (0.0, 0.0)
             ) -> np.ndarray:
    """Return the level (n,) [dB] of links from their paths, with offsets, and diffuse power."""
    return _level_db(interaction_gains(links), links.distance_m, diffuse, offsets_db)


def moved(links: LinkGeometry, east_m: float, north_m: float) -> LinkGeometry:
    """Move both ends of links over their map [m]; without a map, line of sight stays as it is."""
    step_m = np.array([east_m, north_m, 0.0])
    device_m, receiver_m = links.device_m + step_m, links.receiver_m + step_m
    los = links.los if links.city is None else links.city.line_of_sight(device_m, receiver_m)
    return replace(links, device_m=device_m, receiver_m=receiver_m, los=los)


def fit_offsets(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                diffuse: tuple[float, float]) -> Offsets:
    """Estimate how much stronger reflected and diffracted paths are than computed [dB].

    Maximum a posteriori under a normal prior of `OFFSET_SD_DB`, within ±`MAX_OFFSET_DB`. The levels
    of LoS and NLoS links are fitted as well.
    """
    fit, gains = LinkFit(level_db, limit_db), interaction_gains(links)
    distance_m = links.distance_m
    undisturbed_db = _level_db(gains, distance_m, diffuse, np.zeros(2))
    variance_factor = design_effect(ground_blocks(links), fit.fit(links.los, undisturbed_db)[1])

    def loss(offsets_db: np.ndarray) -> float:
        clipped_db = np.clip(offsets_db, -MAX_OFFSET_DB, MAX_OFFSET_DB)
        prior = 0.5 * (offsets_db**2).sum() / OFFSET_SD_DB**2
        level_db = _level_db(gains, distance_m, diffuse, clipped_db)
        return fit.fit(links.los, level_db)[0].sum() / variance_factor + float(prior)

    simplex = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])
    found = minimize(loss, np.zeros(2), method="Nelder-Mead",
                     options={"xatol": 0.1, "fatol": 0.02, "initial_simplex": simplex})
    reflected_db, diffracted_db = np.clip(found.x, -MAX_OFFSET_DB, MAX_OFFSET_DB).tolist()
    return reflected_db, diffracted_db


def _level_db(gains: np.ndarray, distance_m: np.ndarray, diffuse: tuple[float, float],
              offsets_db: Offsets | np.ndarray) -> np.ndarray:
    """Return the level (n,) [dB] from `interaction_gains` (n, 3), see `paths_db`."""
    factor = 10 ** (np.array([0.0, *offsets_db]) / 10)
    return _with_diffuse_db(gains @ factor, distance_m, *diffuse)
