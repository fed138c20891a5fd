"""The interface of every channel model, and checks of what one is fitted to and stored as.

The bounds of stored numbers are far beyond what is measured; within them, predictions are
finite.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry, Links

MIN_DETECTED = 20  # detected links that a line and its standard deviation are learnt from
LEVEL_SD_DB = 20.0  # prior standard deviation of a refitted level: weak
SLOPE_SD_DB = 10.0  # and of its slope [dB per decade]: one unit of the path-loss exponent
ANY_LEVEL_SD_DB = 300.0  # of a level that is free: wider than the range of measured levels
MAX_DB = 1e4  # of a level, a residual or an intercept
MAX_SD_DB = 1e3
MAX_POSITION_M = 1e8  # ten times what a measurement may have


class ChannelModel(ABC):
    """Level of a link as a Gaussian whose mean and standard deviation follow from its geometry.

    `docs/add-a-channel-model.md` is a guide to writing one.
    """

    name: ClassVar[str]
    """As it is chosen and stored, such as `log_distance`."""

    uses_map: ClassVar[bool]
    """Whether predictions depend on line of sight, which only a 3D map shows."""

    follows_paths: ClassVar[bool] = False
    """Whether predictions follow paths over the map, so that `quick` is much quicker."""

    @abstractmethod
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int) -> Self:
        """Fit to measured links.

        Args:
            links: n links.
            level_db: (n,) gain [dB] or received power [dBm]; NaN: not detected.
            limit_db: level below which the receiver does not detect [dB], one for all or (n,):
                links that were not detected count as below it (left-censored). None or -inf:
                unknown, such links are left out with a warning.
            seed: of whatever is random; equal data and seed give equal bits.

        Returns:
            the model itself

        Raises:
            BadInput: nothing, or too little, was detected.
        """

    @abstractmethod
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation [dB] of n links, before any limit of detection.

        Args:
            links: n links.

        Returns:
            (n,) mean level [dB], and (n,) standard deviation [dB].
        """

    @property
    def trend(self) -> ChannelModel:
        """The part that holds for any device, measured or not; by default the model itself."""
        return self

    @property
    def quick(self) -> ChannelModel:
        """A quicker model of small changes, such as moved ends; by default the model itself."""
        return self

    def level_at(self, links: Links, exact: bool = False) -> np.ndarray:
        """Return the mean level (n,) [dB] of measured links, of `quick` unless it must be exact."""
        channel = self if exact else self.quick
        return channel.predict(links.geometry)[0] + channel.declared_db(links)

    def declared_db(self, links: Links) -> np.ndarray | float:
        """Return what is declared of the devices, in the levels of links (n,) [dB].

        Antennas act along the straight line, unless a model knows better.
        """
        return links.declared_db

    def level_columns(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return what of the channel is fitted again together with effects.

        By default, a level and a slope for each class of line of sight, or one of both for all
        links where there is no map or the model does not use it.

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
        """Return the index (n,) of the error scale: LoS 1, NLoS 0; 0 for all without classes."""
        return links.los.astype(int) if self._by_class(links) else np.zeros(len(links), dtype=int)

    def error_groups(self, links: LinkGeometry) -> int:
        """Return how many error scales there are, also where no link is of one of the classes."""
        return 2 if self._by_class(links) else 1

    def _by_class(self, links: LinkGeometry) -> bool:
        return links.city is not None and self.uses_map

    @abstractmethod
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return finite arrays, and settings that JSON can hold, for `from_state`."""

    @classmethod
    @abstractmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Return a model whose predictions equal those of the one that `state` described."""


def check_fit_data(links: LinkGeometry, level_db: np.ndarray, *, needs_los: bool) -> None:
    """Refuse links that no channel can be learnt from; levels (n,) [dB] are NaN if not detected.

    A model with `uses_map` and a map needs a detected link with line of sight: if there is none,
    map and positions nearly always disagree.

    Raises:
        BadInput: fewer than MIN_DETECTED detected links, or none with the line of sight needed.
    """
    detected = np.isfinite(level_db)
    n = int(detected.sum())
    if n == 0:
        raise BadInput(
            f"nothing detected: all {len(links)} links are blank. At least {MIN_DETECTED} links to "
            "devices with known positions need a level; check the gain column, the sensitivity, "
            "and that anchors were in range")
    if n < MIN_DETECTED:
        raise BadInput(
            f"only {n} of {len(links)} links were detected, a channel needs at least "
            f"{MIN_DETECTED}: fly more or closer to the anchors")
    if needs_los and not links.los[detected].any():
        raise BadInput(
            f"all links NLoS: not one of the {n} detected links has line of sight in the 3D map. "
            "Check that positions and map share one frame and unit (x and y exchanged, feet for "
            "metres, z above sea level), or fit log_distance, which needs no map")


def drop_uninformative(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                       ) -> tuple[LinkGeometry, np.ndarray, np.ndarray]:
    """Return the links that a fit can use: those that were detected, or have a limit.

    Warns where links are left out.

    Args:
        links: n links.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: limit of detection [dB], one for all or (n,); None or -inf: unknown.

    Returns:
        m links, their levels (m,), and their limits (m,) [dB].

    Raises:
        BadInput: too few links are detected, or a level is infinite.
    """
    level_db = np.asarray(level_db, float)
    if np.isinf(level_db).any():
        row = int(np.flatnonzero(np.isinf(level_db))[0])
        raise BadInput(f"the level of link {row} is {level_db[row]} dB: allowed are finite "
                       "numbers, or blank")
    check_fit_data(links, level_db, needs_los=False)
    limits_db = limits_of(limit_db, len(level_db))
    missing = np.isnan(level_db) & np.isneginf(limits_db)
    if not missing.any():
        return links, level_db, limits_db
    warnings.warn(
        f"{missing.sum()} of {len(links)} links were not detected and are left out, because the "
        "limit of detection is not known: the channel will look better than it is. Give the "
        "receiver's sensitivity.", stacklevel=3)
    return links.select(~missing), level_db[~missing], limits_db[~missing]


def require_names(what: str, given: Collection[str], expected: Collection[str]) -> None:
    """Raise ValueError where names that are given differ from those that are expected."""
    wrong = sorted(set(given) ^ set(expected))
    if wrong:
        state = "missing" if wrong[0] in expected else "unknown"
        raise ValueError(f"{what}: {wrong[0][:60]!r} is {state}")


def require_array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...],
                  low: float, high: float) -> np.ndarray:
    """Return the array of a name after a check of its shape (None: any length) and its bounds.

    Raises:
        KeyError: there is none of that name.
        ValueError: it has another shape, is empty, or has a number outside the bounds.
    """
    array = arrays[name]
    if array.ndim != len(shape) or 0 in array.shape or any(
            side not in (None, given) for side, given in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has the shape {array.shape}")
    if array.dtype.kind not in "fiu" or not ((array >= low) & (array <= high)).all():
        raise ValueError(f"{name} holds something else than numbers from {low:g} to {high:g}")
    return array


def require_number(settings: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return a number of some settings after a check.

    Raises:
        KeyError: there is none of that name.
        ValueError: it is no number, or outside the bounds.
    """
    value = settings[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {str(value)[:60]}; allowed are numbers from {low:g} to "
                         f"{high:g}")
    return float(value)
