"""Blend: weighted mean of the fitted model, kriging and regression trees.

Near measurements, interpolation and trees predict best; far from them, physics does. So each
predictor has a weight near measurements and one far from them, found on held-out links by
`radiotwin.closeloop.predict.weights`. Folds of the loop predict by the same class as twins.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from scipy.spatial import cKDTree

from radiotwin.inference.held_out import combine
from radiotwin.inference.student import sd_of_scale
from radiotwin.links import Links
from radiotwin.links.plausible import MAX_ANGLE_DEG
from radiotwin.links.variables import feature_count, link_features
from radiotwin.propagation.laws.base import (
    MAX_POSITION_M,
    ChannelModel,
    require_array,
    require_names,
    require_number,
)
from radiotwin.propagation.laws.forest import Forest
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.twin.model.correlated_shadowing import moving_ends

NAMED, SHADOWED = "named", "named_and_rest"  # predictors: named effects without, with shadowing
FORESTS = ("named_and_trees", "named_and_boosting")  # trees of residuals of named effects
LEVEL_FORESTS = ("trees_of_levels", "boosting_of_levels")  # trees of levels
LAWS = {law.name: law for law in (SegmentedLogDistance, RegressionKriging)}
MAX_SD_RATIO = 100.0  # largest in a file


def far_share(away_m: np.ndarray, half_m: float) -> np.ndarray:
    """Return the share (n,) of far weights, 0 to 1, by distance to the nearest measurement [m]."""
    return 1 - half_m / (away_m + half_m)


def sd_factor(share: np.ndarray, sd_ratio: tuple[float, float]) -> np.ndarray:
    """Return the factor (n,) on error scales, from the ratios near and far from measurements."""
    near, far = np.square(sd_ratio)
    return np.sqrt((1 - share) * near + share * far)


def blended(predicted_db: np.ndarray, scales_db: np.ndarray, share: np.ndarray,
            weights: np.ndarray, sd_ratio: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Combine predictions and error scales (n, k) [dB] of k models to one of each (n,) [dB].

    Weights (2, k) are near measurements, and far from them, see `far_share` and `Blend`.
    """
    scale_db = np.sqrt(combine(np.square(scales_db), share, weights))
    return combine(predicted_db, share, weights), scale_db * sd_factor(share, sd_ratio)


@dataclass(frozen=True, eq=False)
class Blend:
    """Predictors beside the named effects, and the weights of all of them.

    Attributes:
        weights: weight of each predictor near measurements, and far from them; both sum to one.
        half_m: distance from measurements of equal near and far weights [m].
        sd_ratio: error scale over the weighted root mean square of the predictors' scales, near
            measurements, and far from them.
        receivers_move: True: receivers move and devices are fixed; False: the other way round.
        measured_m: (p, 3) measured positions of the moving end [m].
        measured_other: (p,) row of the fixed end in each of these measurements.
        forests: trees by name: of standardised residuals (`FORESTS`), or levels (`LEVEL_FORESTS`).
        laws: channel models fitted to the levels, by name.
        boresights_deg: (j, 2) device row and its declared azimuth [deg], a feature of the trees.
    """

    weights: dict[str, tuple[float, float]]
    half_m: float
    sd_ratio: tuple[float, float]
    receivers_move: bool
    measured_m: np.ndarray
    measured_other: np.ndarray
    forests: dict[str, Forest]
    laws: dict[str, ChannelModel]
    boresights_deg: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def away_m(self, links: Links) -> np.ndarray:
        """Return the distance (n,) [m] of each link's moving end from its nearest measurement.

        Only measurements with the same fixed end count; inf: none.
        """
        moving_m, fixed_end = moving_ends(links, self.receivers_move)
        away_m = np.full(len(links), np.inf)
        for label in np.unique(fixed_end):
            known_m, rows = self.measured_m[self.measured_other == label], fixed_end == label
            if len(known_m):
                away_m[rows] = cKDTree(known_m).query(moving_m[rows])[0]
        return away_m

    def predictions(self, links: Links, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                    shadowing: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return level (n, k) and error scale (n, k) [dB] of each model, in the order of `weights`.

        `mean_db` and `scale_db` (n,) are of channel and named effects, `shadowing` as of
        `CorrelatedShadowing.at`.
        """
        levels = {NAMED: mean_db, SHADOWED: mean_db + shadowing[0] * scale_db}
        scales = dict.fromkeys(self.weights, scale_db) | {SHADOWED: shadowing[1] * scale_db}
        if self.forests:
            features = link_features(self._declared(links), receivers=False)
            for name, forest in self.forests.items():
                predicted = forest.predict(features)
                levels[name] = predicted if name in LEVEL_FORESTS \
                    else mean_db + predicted * scale_db
        for name, law in self.laws.items():
            law_db, sd_db = law.predict(links.geometry)
            levels[name] = law_db + law.declared_db(links)
            scales[name] = sd_db / sd_of_scale(dof)
        return (np.column_stack([levels[name] for name in self.weights]),
                np.column_stack([scales[name] for name in self.weights]))

    def apply(self, links: Links, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
              shadowing: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and error scale (n,) [dB] of the blend; arguments as in `predictions`.

        The limit of detection is ignored.
        """
        share = far_share(self.away_m(links), self.half_m)
        return blended(*self.predictions(links, mean_db, scale_db, dof, shadowing), share,
                       np.transpose(list(self.weights.values())), self.sd_ratio)

    def weighted(self, weights: dict[str, tuple[float, float]], half_m: float,
                 sd_ratio: tuple[float, float]) -> Blend:
        """Return the blend with other weights and scales; models that get no weight are dropped."""
        return replace(self, weights=weights, half_m=half_m, sd_ratio=sd_ratio,
                       forests={name: forest for name, forest in self.forests.items()
                                if name in weights},
                       laws={name: law for name, law in self.laws.items() if name in weights})

    def _declared(self, links: Links) -> Links:
        """Return the links with the antenna azimuths that were declared when trees were fitted."""
        boresight_deg = np.full(len(links.device_names), np.nan)
        boresight_deg[self.boresights_deg[:, 0].astype(int)] = self.boresights_deg[:, 1]
        return links.with_ends(boresight_deg=boresight_deg)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays by name, and settings that JSON can hold, for `from_state`."""
        arrays = {"measured_m": self.measured_m.astype(np.float32),
                  "measured_other": self.measured_other.astype(np.int32)}
        if len(self.boresights_deg):
            arrays["boresights_deg"] = self.boresights_deg
        settings: dict[str, Any] = {
            "weights": {name: list(pair) for name, pair in self.weights.items()},
            "half_m": self.half_m, "sd_ratio": list(self.sd_ratio),
            "receivers_move": self.receivers_move, "models": {}}
        models: dict[str, Forest | ChannelModel] = {**self.forests, **self.laws}
        for name, model in models.items():
            of_model, settings["models"][name] = model.state()
            arrays |= {f"{name}/{part}": array for part, array in of_model.items()}
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   devices: int) -> Self:
        """Restore a blend from its `state`, after checking it, for a twin with so many devices.

        BadInput if it is too large, ValueError or KeyError if it is damaged.
        """
        require_names("settings", settings, ["weights", "half_m", "sd_ratio", "receivers_move",
                                              "models"])
        forests: dict[str, Forest] = {}
        laws: dict[str, ChannelModel] = {}
        expected = {"measured_m", "measured_other"} | (arrays.keys() & {"boresights_deg"})
        boresights_deg = np.zeros((0, 2))
        if "boresights_deg" in expected:
            boresights_deg = require_array(arrays, "boresights_deg", (None, 2), -MAX_ANGLE_DEG,
                                           max(MAX_ANGLE_DEG, devices - 1))
            if not np.isin(boresights_deg[:, 0], np.arange(devices)).all():
                raise ValueError("an azimuth belongs to no device")
        width = feature_count(devices, len(boresights_deg) > 0)
        for name, given in settings["models"].items():
            parts = {key.removeprefix(f"{name}/"): array for key, array in arrays.items()
                     if key.startswith(f"{name}/")}
            expected |= {f"{name}/{part}" for part in parts}
            if name in FORESTS + LEVEL_FORESTS:
                forests[name] = Forest.from_state(parts, given, width)
            else:
                laws[name] = LAWS[name].from_state(
                    {part: array.copy() for part, array in parts.items()}, given)
        require_names("arrays", arrays, expected)
        weights = {name: (require_number({name: near}, name, 0, 1),
                          require_number({name: far}, name, 0, 1))
                   for name, (near, far) in settings["weights"].items()}
        require_names("weights", set(weights) | {NAMED, SHADOWED},
                      {NAMED, SHADOWED, *forests, *laws})
        if not np.allclose(np.sum(list(weights.values()), axis=0), 1.0, atol=1e-6):
            raise ValueError("weights do not sum to one")
        near, far = settings["sd_ratio"]
        ratios = {"near": near, "far": far}
        points = require_array(arrays, "measured_m", (None, 3), -MAX_POSITION_M, MAX_POSITION_M)
        other = require_array(arrays, "measured_other", (len(points),), 0, 2**31 - 1)
        if not isinstance(settings["receivers_move"], bool):
            raise ValueError("receivers_move is neither true nor false")
        return cls(weights, require_number(settings, "half_m", 1e-3, MAX_POSITION_M),
                   (require_number(ratios, "near", 0.01, MAX_SD_RATIO),
                    require_number(ratios, "far", 0.01, MAX_SD_RATIO)),
                   settings["receivers_move"], points, other, forests, laws, boresights_deg)
