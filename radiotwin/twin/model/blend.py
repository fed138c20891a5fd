"""Interpolation and regression beside named effects, with weights that depend on the place.

Near measured places they know most, far from them physics does: each member has a weight near
measurements and one far from them, found on held-out links by
`radiotwin.closeloop.predict.weights`. Folds of a loop predict by the same class as twins.
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

NAMED, REST = "named", "named_and_rest"
FORESTS = ("named_and_trees", "named_and_boosting")  # members, learnt of what named effects leave
LEVEL_FORESTS = ("trees_of_levels", "boosting_of_levels")  # members, learnt of the levels
LAWS = {each.name: each for each in (SegmentedLogDistance, RegressionKriging)}
MAX_SD_RATIO = 100.0


def far_share(away_m: np.ndarray, half_m: float) -> np.ndarray:
    """Return how far places are from all measured ones, in 0..1: d / (d + half).

    Args:
        away_m: (n,) distance d to the nearest measurement [m]; inf = there is none.
        half_m: distance at which near and far count the same [m].
    """
    return 1 - half_m / (away_m + half_m)


def sd_factor(share: np.ndarray, sd_ratio: tuple[float, float]) -> np.ndarray:
    """Return the ratio of standard deviations (n,) at `far_share` (n,), as of `Blend`."""
    near, far = np.square(sd_ratio)
    return np.sqrt((1 - share) * near + share * far)


def blended(members_db: np.ndarray, scales_db: np.ndarray, share: np.ndarray,
            weights: np.ndarray, sd_ratio: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and error scale (n,) of a combination [dB].

    Args:
        members_db: (n, k) levels by members [dB].
        scales_db: (n, k) of their errors [dB].
        share: (n,) of the far weights, see `far_share`.
        weights: (2, k) near and far.
        sd_ratio: as of `Blend`.
    """
    scale_db = np.sqrt(combine(np.square(scales_db), share, weights))
    return combine(members_db, share, weights), scale_db * sd_factor(share, sd_ratio)


@dataclass(frozen=True, eq=False)
class Blend:
    """Members beside named effects, and the weights of all.

    Attributes:
        weights: of each member, near measurements and far from them; both sum to one.
        half_m: as of `far_share` [m].
        sd_ratio: scale of the error over the root mean square of the members' scales, by weight,
            near and far.
        receivers_move: whether devices stand still and receivers move, or the other way round.
        measured_m: (p, 3) positions of the end that moves [m], and
        measured_other: (p,) the end that stands still and was measured with it there.
        forests: by name, of the standardised residual of named effects (`FORESTS`), or of the
            levels (`LEVEL_FORESTS`) [dB].
        laws: fitted to the levels, by name.
        boresights_deg: (j, 2) device, and its declared azimuth [deg]; forests know of these.
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
        """Return how far the moving ends of links are from where they were measured (n,) [m].

        With the same other end; inf where it was not measured at all.
        """
        moving_m, other = moving_ends(links, self.receivers_move)
        away_m = np.full(len(links), np.inf)
        for label in np.unique(other):
            known_m, own = self.measured_m[self.measured_other == label], other == label
            if len(known_m):
                away_m[own] = cKDTree(known_m).query(moving_m[own])[0]
        return away_m

    def members_db(self, links: Links, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                   rest: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return level and error scale (n, k) of each member, in the order of the weights [dB].

        Kriging is surer near measurements than far from them; trees do not tell.

        Args:
            links: n links.
            mean_db: (n,) by named effects [dB].
            scale_db: (n,) of their errors [dB].
            dof: degrees of freedom of the errors.
            rest: (n,) what is interpolated [error scales], 0 without it; and (n,) the share that it
                leaves of the scale.
        """
        members = {NAMED: mean_db, REST: mean_db + rest[0] * scale_db}
        scales = dict.fromkeys(self.weights, scale_db) | {REST: rest[1] * scale_db}
        if self.forests:
            features = link_features(self._declared(links), receivers=False)
            for name, forest in self.forests.items():
                predicted = forest.predict(features)
                members[name] = predicted if name in LEVEL_FORESTS \
                    else mean_db + predicted * scale_db
        for name, law in self.laws.items():
            law_db, sd_db = law.predict(links.geometry)
            members[name] = law_db + law.declared_db(links)
            scales[name] = sd_db / sd_of_scale(dof)
        return (np.column_stack([members[name] for name in self.weights]),
                np.column_stack([scales[name] for name in self.weights]))

    def apply(self, links: Links, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
              rest: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and error scale (n,) of the combination [dB], before any limit of detection.

        Arguments as of `members_db`.
        """
        share = far_share(self.away_m(links), self.half_m)
        return blended(*self.members_db(links, mean_db, scale_db, dof, rest), share,
                       np.transpose(list(self.weights.values())), self.sd_ratio)

    def weighted(self, weights: dict[str, tuple[float, float]], half_m: float,
                 sd_ratio: tuple[float, float]) -> Blend:
        """Return the members that have a weight, with it."""
        return replace(self, weights=weights, half_m=half_m, sd_ratio=sd_ratio,
                       forests={name: each for name, each in self.forests.items()
                                if name in weights},
                       laws={name: each for name, each in self.laws.items() if name in weights})

    def _declared(self, links: Links) -> Links:
        """Return links with the azimuths that were declared where this was fitted, no others."""
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
            "weights": {name: list(each) for name, each in self.weights.items()},
            "half_m": self.half_m, "sd_ratio": list(self.sd_ratio),
            "receivers_move": self.receivers_move, "models": {}}
        models: dict[str, Forest | ChannelModel] = {**self.forests, **self.laws}
        for name, model in models.items():
            own, settings["models"][name] = model.state()
            arrays |= {f"{name}/{each}": array for each, array in own.items()}
        return arrays, settings

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   devices: int) -> Self:
        """Return what `state` described.

        Args:
            arrays: of `state`.
            settings: of `state`.
            devices: of the twin.

        Raises:
            BadInput: too large.
            ValueError: it is damaged.
            KeyError: a part is missing.
        """
        require_names("settings", settings, ["weights", "half_m", "sd_ratio", "receivers_move",
                                              "models"])
        forests: dict[str, Forest] = {}
        laws: dict[str, ChannelModel] = {}
        own = {"measured_m", "measured_other"} | (arrays.keys() & {"boresights_deg"})
        boresights_deg = np.zeros((0, 2))
        if "boresights_deg" in own:
            boresights_deg = require_array(arrays, "boresights_deg", (None, 2), -MAX_ANGLE_DEG,
                                           max(MAX_ANGLE_DEG, devices - 1))
            if not np.isin(boresights_deg[:, 0], np.arange(devices)).all():
                raise ValueError("an azimuth belongs to no device")
        width = feature_count(devices, len(boresights_deg) > 0)
        for name, given in settings["models"].items():
            parts = {each.removeprefix(f"{name}/"): array for each, array in arrays.items()
                     if each.startswith(f"{name}/")}
            own |= {f"{name}/{each}" for each in parts}
            if name in FORESTS + LEVEL_FORESTS:
                forests[name] = Forest.from_state(parts, given, width)
            else:
                laws[name] = LAWS[name].from_state(
                    {each: array.copy() for each, array in parts.items()}, given)
        require_names("arrays", arrays, own)
        weights = {name: (require_number({name: near}, name, 0, 1),
                          require_number({name: far}, name, 0, 1))
                   for name, (near, far) in settings["weights"].items()}
        require_names("weights", set(weights) | {NAMED, REST}, {NAMED, REST, *forests, *laws})
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
