"""PathKriging: mean of path tracing over an inexact map and of kriging, by held-out weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from typing_extensions import override

from radiotwin.inference.gaussian import Limit, standardised
from radiotwin.inference.student import DOF
from radiotwin.links import LinkGeometry, Links
from radiotwin.propagation.laws.base import (
    MAX_DB,
    MAX_SD_DB,
    ChannelModel,
    drop_uninformative,
    require_array,
    require_names,
    require_number,
)
from radiotwin.propagation.laws.followed_paths import declared_antenna_db
from radiotwin.propagation.laws.image_paths import (
    DIFFUSE_DEFAULT,
    fit_class,
    paths_db,
    scale_db,
    stored_diffuse,
)
from radiotwin.propagation.laws.kriging import RegressionKriging, ResidualField
from radiotwin.propagation.laws.map_error import Found, MapError, estimate_map_error
from radiotwin.scene.citymap import perturbed_map

MEMBERS = 6  # maps with random errors, beside the given one
FOLDS = 4  # folds from which the weights are found
BLOCK_M = 60.0  # side of the squares of ground that are held out together
SPREAD_FACTOR = np.sqrt(DOF / (DOF - 2))  # standard deviation over scale of Student-t errors


class PathKriging(ChannelModel):
    """Weighted mean of two predictions: traced paths plus kriging, and kriging without paths.

    The first traces paths over the map (`ImagePaths`) and over random maps with errors of the
    estimated size (`MapError`). Its mean is theirs, its variance includes their spread, and each
    device's residuals are interpolated. The second is `RegressionKriging`, which uses the map for
    line of sight only. Errors on held-out links decide the weights.

    A device is its index in `LinkGeometry.device`: use the same indices to fit and to predict.

    Attributes:
        diffuse: diffuse power, see `ImagePaths`.
        map_error: estimated errors of the map.
        lost: devices whose positions are too uncertain to trace paths; only kriging predicts them.
        classes: (2, 2) level offset and error scale over an exact map [dB]; rows NLoS, LoS.
        field: interpolated residuals of traced paths.
        kriging: the prediction without paths.
        weight: (2,) weight of traced paths in NLoS, in LoS.
        seed: of the random map errors.
    """

    name = "path_kriging"
    uses_map = True
    follows_paths = True

    def __init__(self, found: Found | None = None, lost: tuple[int, ...] = ()) -> None:
        """Make a model; `found` is the result of `estimate_map_error`, None: `fit` estimates it."""
        self._found, self.lost = found, np.array(lost, dtype=np.int64)
        self.map_error, self.diffuse = found or (MapError(), DIFFUSE_DEFAULT)
        self.classes = np.array([[0.0, 5.0], [0.0, 5.0]])
        self.field = ResidualField()
        self.kriging = RegressionKriging()
        self.weight = np.ones(2)
        self.seed = 0

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        """Fit traced paths and kriging (map errors, too, unless given), and the weights of both."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.seed = seed
        traced = ~np.isin(links.device, self.lost)
        self.map_error, self.diffuse = self._found or estimate_map_error(
            links.select(traced), level_db[traced], limit_db[traced], seed)
        links = self.map_error.on_map(links)
        self.kriging.fit(links, level_db, limit_db, seed)
        links, level_db, limit_db = links.select(traced), level_db[traced], limit_db[traced]
        paths = self._over_maps(links)
        self._fit_classes(links, level_db, limit_db, *paths)
        residual = standardised(level_db, *self._calibrated(links, *paths), limit_db)
        self.field.fit(links.device, links.receiver_m, residual, seed)
        self.weight = self._held_out_weight(links, level_db, limit_db, *paths)
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Predict by the mixture of traced paths and kriging; `lost` devices by kriging alone."""
        links = self.map_error.on_map(links)
        mean_db, sd_db = self.kriging.predict(links)
        rows = np.flatnonzero(~np.isin(links.device, self.lost))
        traced_links = links.select(rows)
        path_db, path_sd_db = self._calibrated(traced_links, *self._over_maps(traced_links))
        residual, residual_sd = self.field.predict(traced_links.device, traced_links.receiver_m)
        by_paths = path_db + path_sd_db * residual, path_sd_db * residual_sd
        weight = self.weight[traced_links.los.astype(int)]
        mean_db[rows], sd_db[rows] = _mixture(weight, by_paths, (mean_db[rows], sd_db[rows]))
        return mean_db, sd_db

    @override
    def declared_db(self, links: Links) -> np.ndarray | float:
        """Return declared power, cable and antenna gain along each path, (n,) [dB]; 0: none."""
        if not links.declared.has_antennas:
            return links.declared_db
        return links.declared.fed_db[links.device] + declared_antenna_db(links)

    @property
    @override
    def quick(self) -> ChannelModel:
        return self.kriging.law

    @property
    @override
    def trend(self) -> ChannelModel:
        return self.kriging.law

    def _over_maps(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (n,) [dB] and variance (n,) [dB²] of path levels over the possible maps.

        The given map and, if it has errors, copies with random errors of the estimated sizes.
        """
        power = self.diffuse, self.map_error.offsets_db
        levels_db = [paths_db(links, *power)]
        if self.map_error.is_seen and links.city is not None:
            for member in range(MEMBERS):
                wrong = perturbed_map(links.city, self.map_error.wall_m[0],
                                      self.map_error.height_m[0], self.seed + member)
                # Line of sight stays that of the given map, which decides a link's class.
                levels_db.append(paths_db(replace(links, city=wrong), *power))
        unbiased = len(levels_db) / max(len(levels_db) - 1, 1)
        return np.mean(levels_db, axis=0), unbiased * np.var(levels_db, axis=0)

    def _fit_classes(self, links: LinkGeometry, level_db: np.ndarray, limit_db: np.ndarray,
                     mean_db: np.ndarray, variance_db2: np.ndarray) -> None:
        """Fit the level offset and error scale of LoS and of NLoS links, `classes`.

        Levels (n,) [dB], NaN: not detected; mean and variance (n,) as from `_over_maps`. A class
        without a detected link gets the parameters of the other class.
        """
        detected = [bool(np.isfinite(level_db[links.los == los]).any()) for los in (False, True)]
        for los in (0, 1):
            if detected[los]:
                of_class = links.los == los
                offset_db, log_scale = fit_class(level_db[of_class], limit_db[of_class],
                                                 mean_db[of_class], variance_db2[of_class])
                self.classes[los] = offset_db, np.exp(log_scale)
        if detected[0] != detected[1]:
            self.classes[:] = self.classes[detected.index(True)]

    def _calibrated(self, links: LinkGeometry, mean_db: np.ndarray, variance_db2: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and sd (n,) [dB] of levels from `_over_maps` after the fit of `classes`."""
        offset_db, class_scale_db = self.classes[links.los.astype(int)].T
        return mean_db + offset_db, SPREAD_FACTOR * scale_db(class_scale_db, variance_db2)

    def _held_out_weight(self, links: LinkGeometry, level_db: np.ndarray, limit_db: np.ndarray,
                         mean_db: np.ndarray, variance_db2: np.ndarray) -> np.ndarray:
        """Return the weights (2,) of traced paths against kriging, in NLoS and LoS, in 0..1.

        They minimise the squared error on detected links in held-out squares of ground; 1 for a
        class without such links.
        """
        square = np.floor(links.receiver_m[:, :2] / BLOCK_M)
        label = np.unique(square, axis=0, return_inverse=True)[1].reshape(-1)
        rng = np.random.default_rng(self.seed)
        fold = rng.permutation(np.arange(label.max() + 1) % FOLDS)[label]
        errors_db = np.full((2, len(links)), np.nan)
        by_paths = *self._calibrated(links, mean_db, variance_db2), self.field
        by_law = *self.kriging.law.predict(links), self.kriging.field
        for row, (trend_db, sd_db, field) in enumerate((by_paths, by_law)):
            residual = standardised(level_db, trend_db, sd_db, limit_db)
            for number in range(FOLDS):
                train, held = fold != number, fold == number
                if not held.any() or not train.any():
                    continue
                refitted = field.with_points(links.device[train], links.receiver_m[train],
                                             residual[train])
                mean = refitted.mean(links.device[held], links.receiver_m[held])
                errors_db[row, held] = level_db[held] - trend_db[held] - sd_db[held] * mean
        weight = np.ones(2)
        for los in (0, 1):
            of_class = (links.los == los) & np.isfinite(errors_db).all(axis=0)
            paths_error_db, law_error_db = errors_db[:, of_class]
            gap_db = law_error_db - paths_error_db
            if (gap_db**2).sum() > 0:
                weight[los] = np.clip((law_error_db * gap_db).sum() / (gap_db**2).sum(), 0.0, 1.0)
        return weight

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays and settings of all parts, for `from_state`."""
        paths, paths_settings = self.field.state()
        law, law_settings = self.kriging.state()
        arrays = {f"paths/{name}": value for name, value in paths.items()} \
            | {f"law/{name}": value for name, value in law.items()}
        return arrays | {"classes": self.classes, "weight": self.weight}, {
            "lost": self.lost.tolist(),
            "diffuse": list(self.diffuse), "map_error": self.map_error.state(),
            "paths": paths_settings, "law": law_settings, "seed": self.seed}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore the model from its `state`, after checking it."""
        require_names("settings", settings, ["diffuse", "map_error", "lost", "paths", "law",
                                              "seed"])
        strange = [name for name in arrays if name not in ("classes", "weight")
                   and not name.startswith(("paths/", "law/"))]
        if strange:
            raise ValueError(f"array {strange[0][:60]!r} is unknown")
        if not isinstance(settings["lost"], list):
            raise ValueError("lost is no list of devices")
        lost = {str(place): value for place, value in enumerate(settings["lost"])}
        model = cls((MapError.from_state(settings["map_error"]),
                     stored_diffuse(settings["diffuse"])),
                    tuple(int(require_number(lost, place, 0, 2**31)) for place in lost))
        model.seed = int(require_number(settings, "seed", 0, 2**63))
        model.classes = require_array(arrays, "classes", (2, 2), -MAX_DB, MAX_DB)
        if not ((model.classes[:, 1] > 0) & (model.classes[:, 1] <= MAX_SD_DB)).all():
            raise ValueError("an error scale is impossible")
        model.weight = require_array(arrays, "weight", (2,), 0.0, 1.0)
        paths, law = ({name.removeprefix(f"{part}/"): value for name, value in arrays.items()
                       if name.startswith(f"{part}/")} for part in ("paths", "law"))
        model.field = ResidualField.from_state(paths, settings["paths"])
        model.kriging = RegressionKriging.from_state(law, settings["law"])
        return model


def _mixture(weight: np.ndarray, first: tuple[np.ndarray, np.ndarray],
             second: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sd (n,) [dB] of a mixture of normals (mean, sd); `weight` is of `first`."""
    mean_db = weight * first[0] + (1 - weight) * second[0]
    variance_db2 = weight * (first[1]**2 + (first[0] - mean_db)**2) \
        + (1 - weight) * (second[1]**2 + (second[0] - mean_db)**2)
    return mean_db, np.sqrt(variance_db2)
