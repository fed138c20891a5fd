"""The interface that every channel model keeps, and the checks that all of them share."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

import numpy as np

from radiotwin.links import LinkGeometry
from radiotwin.errors import BadInput

MIN_DETECTED = 20  # links that a channel can be learnt from
LEVEL_SD_DB, SLOPE_SD_DB = 20.0, 10.0  # priors of a refitted level, and of its slope per decade
ANY_LEVEL_SD_DB = 300.0  # prior of a level that is free


class ChannelModel(ABC):
    """Gain of a link [dB] as a Gaussian: mean and standard deviation from the geometry of its two ends."""

    name: ClassVar[str]
    uses_map: ClassVar[bool]
    """True where predictions depend on line of sight, which only a 3D map can tell."""

    @abstractmethod
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: float | None, seed: int) -> Self:
        """Fits to n links and returns itself.

        level_db: (n,) gain [dB] or received power [dBm], NaN = not detected. limit_db: the level below which the
        receiver does not detect; links that were not detected then count as "below it" (left-censored). None:
        they tell nothing that can be used and are left out, with a warning.
        Raises BadInput where nothing, or too little, was detected.
        """

    @abstractmethod
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean [dB] and standard deviation [dB] of n links, (n,) each, before any limit of detection."""

    @property
    def trend(self) -> ChannelModel:
        """The part that holds for any device, measured before or not: the model itself, unless it keeps something
        per device."""
        return self

    follows_paths: ClassVar[bool] = False
    """Whether predictions follow paths over the map, so that `quick` is much quicker."""

    @property
    def quick(self) -> ChannelModel:
        """A quicker model of what small changes do: moved ends, other lines of sight."""
        return self

    def level_columns(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return what of the channel is fitted again together with effects.

        By default, a level and a slope for each class of line of sight, or one of both for all links
        where there is no map or the model does not use it.

        Args:
            links: n links.

        Returns:
            (n, p) design, and (p,) prior standard deviations [dB].
        """
        slope = np.log10(links.distance_m / 100.0)
        classes = [links.los, ~links.los] if self._by_class(links) else [np.ones(len(links), bool)]
        columns = [column for each in classes for column in (each, each * slope)]
        prior_sd_db = np.tile([LEVEL_SD_DB, SLOPE_SD_DB], len(classes))
        return np.column_stack(columns).astype(float), prior_sd_db

    def error_group(self, links: LinkGeometry) -> np.ndarray:
        """Return the index (n,) of the error scale: with line of sight 1, without 0, or 0 for all."""
        return links.los.astype(int) if self._by_class(links) else np.zeros(len(links), dtype=int)

    def _by_class(self, links: LinkGeometry) -> bool:
        return links.city is not None and self.uses_map

    @abstractmethod
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays, and settings that JSON can hold, from which `from_state` makes an equal model."""

    @classmethod
    @abstractmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """The model that `state` described."""


def check_fit_data(links: LinkGeometry, level_db: np.ndarray, *, needs_los: bool) -> None:
    """Raises BadInput where no channel can be learned from the links.

    Every model needs MIN_DETECTED detected links. With `needs_los` (a model with `uses_map`, and a map given) at
    least one of them must have line of sight: none at all nearly always means that map and positions disagree.
    """
    detected = np.isfinite(level_db)
    n = int(detected.sum())
    if n == 0:
        raise BadInput(
            f"nothing detected: all {len(links)} links are blank. At least {MIN_DETECTED} links to devices with "
            "known positions need a level; check the gain column, the sensitivity, and that anchors were in range"
        )
    if n < MIN_DETECTED:
        raise BadInput(
            f"only {n} of {len(links)} links were detected, a channel needs at least {MIN_DETECTED}: "
            "fly more or closer to the anchors"
        )
    if needs_los and not links.los[detected].any():
        raise BadInput(
            f"all links NLoS: not one of the {n} detected links has line of sight in the 3D map. Check that "
            "positions and map share one frame and unit (x and y exchanged, feet for metres, z above sea level), "
            "or fit log_distance, which needs no map"
        )


def drop_uninformative(
    links: LinkGeometry, level_db: np.ndarray, limit_db: float | None
) -> tuple[LinkGeometry, np.ndarray]:
    """The links that a fit can use, and their levels (n,) [dB]: all of them, or, without a limit of detection, the
    detected ones. Raises BadInput where too few are detected or a level is infinite."""
    level_db = np.asarray(level_db, float)
    if np.isinf(level_db).any():
        row = int(np.flatnonzero(np.isinf(level_db))[0])
        raise BadInput(f"the level of link {row} is {level_db[row]} dB: allowed are finite numbers, or blank")
    check_fit_data(links, level_db, needs_los=False)
    missing = np.isnan(level_db)
    if limit_db is not None or not missing.any():
        return links, level_db
    warnings.warn(
        f"{missing.sum()} of {len(links)} links were not detected and are left out, because the limit of "
        "detection is not known: the channel will look better than it is. Give the receiver's sensitivity.",
        stacklevel=3,
    )
    return links.select(~missing), level_db[~missing]
