"""ChannelModel, the interface of every channel model; checks of training links and of files.

The bounds of stored numbers are far wider than any measurement; within them, predictions are
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

BLOCK_M = 100.0  # side of a square of ground in which errors of a device's links are correlated
MIN_DETECTED = 20  # detected links needed to learn a line and its standard deviation
LEVEL_SD_DB = 20.0  # prior standard deviation of a refitted level: weak
SLOPE_SD_DB = 10.0  # and of its slope [dB per decade]: one unit of the path-loss exponent
ANY_LEVEL_SD_DB = 300.0  # prior of an unconstrained level: wider than the range of measured levels
MAX_DB = 1e4  # largest stored level, residual or intercept
MAX_SD_DB = 1e3  # largest stored standard deviation
MAX_POSITION_M = 1e8  # largest stored coordinate: ten times the largest allowed in measurements


class ChannelModel(ABC):
    """Predict the level of a link as a Gaussian: mean and standard deviation from its geometry.

    `docs/add-a-channel-model.md` is a guide to writing one.
    """

    name: ClassVar[str]
    """Name in options and files, such as `log_distance`."""

    uses_map: ClassVar[bool]
    """True if predictions depend on line of sight, which only a 3D map shows."""

    follows_paths: ClassVar[bool] = False
    """True if predictions trace reflected and diffracted paths, so that `quick` is much faster."""

    @abstractmethod
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int) -> Self:
        """Fit the model to measured links, and return the model itself.

        Args:
            links: n links.
            level_db: (n,) gain [dB] or received power [dBm]; NaN: not detected.
            limit_db: limit of detection of the receiver [dB], one for all or (n,). A link that was
                not detected is left-censored at it. None or -inf: unknown; undetected links are
                left out with a warning.
            seed: random seed; equal data and seed give equal bits.

        Raises:
            BadInput: too few links were detected, or none.
        """

    @abstractmethod
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Predict mean and standard deviation of levels (n,) [dB], as without a detection limit."""

    @property
    def trend(self) -> ChannelModel:
        """Return the model without interpolated residuals of single devices; by default itself.

        It predicts devices that were never measured as well as those that were.
        """
        return self

    @property
    def quick(self) -> ChannelModel:
        """Return a faster model for small changes, such as moved ends; by default itself."""
        return self

    def level_at(self, links: Links, exact: bool = False) -> np.ndarray:
        """Return the mean level (n,) [dB] of links, including declared antennas and powers.

        `exact`: by this model; False: by its faster approximation `quick`.
        """
        channel = self if exact else self.quick
        return channel.predict(links.geometry)[0] + channel.declared_db(links)

    def declared_db(self, links: Links) -> np.ndarray | float:
        """Return what declared powers, cables and antennas add to levels, (n,) [dB]; 0: nothing.

        Antenna gains are those along the straight line; models that follow paths override this.
        """
        return links.declared_db

    def level_columns(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return the regression columns that refit the channel's levels together with effects.

        By default, a level and a slope over log-distance: one pair each for LoS and NLoS, or one
        pair for all links if there is no map or the model does not use it. Returns the design
        matrix (n, p), and prior standard deviations (p,) [dB].
        """
        slope = np.log10(links.distance_m / 100.0)
        classes = [links.los, ~links.los] if self._by_class(links) else [np.ones(len(links), bool)]
        columns = [column for of_class in classes for column in (of_class, of_class * slope)]
        prior_sd_db = np.tile([LEVEL_SD_DB, SLOPE_SD_DB], len(classes))
        return np.column_stack(columns).astype(float), prior_sd_db

    def error_group(self, links: LinkGeometry) -> np.ndarray:
        """Return the index (n,) of each link's error scale: LoS 1, NLoS 0; 0 without classes."""
        return links.los.astype(int) if self._by_class(links) else np.zeros(len(links), dtype=int)

    def error_groups(self, links: LinkGeometry) -> int:
        """Return the number of error scales: 2 with LoS and NLoS, even if one has no link; or 1."""
        return 2 if self._by_class(links) else 1

    def _by_class(self, links: LinkGeometry) -> bool:
        """Return True if LoS and NLoS links have levels and error scales of their own."""
        return links.city is not None and self.uses_map

    @abstractmethod
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return finite arrays, and settings that JSON can hold, for `from_state`."""

    @classmethod
    @abstractmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore a model from its `state`; its predictions are equal to the bit."""


def check_fit_data(links: LinkGeometry, level_db: np.ndarray, *, needs_los: bool) -> None:
    """Raise BadInput unless MIN_DETECTED of the levels (n,) [dB] are detected (not NaN).

    `needs_los`: require one with line of sight, as models that use a map do: if there is none, map
    and positions nearly always disagree.
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
    """Drop links that were not detected and have no limit of detection; warn if there are any.

    Returns m links, their levels (m,), NaN: not detected, and their limits (m,) [dB]. BadInput if
    too few links are detected, or a level is infinite.
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


def ground_blocks(links: LinkGeometry) -> np.ndarray:
    """Return the index (n,) of each link's device and square of ground (`BLOCK_M`).

    Links of one block share obstacles, so their errors are correlated.
    """
    square = np.floor(links.receiver_m[:, :2] / BLOCK_M).astype(np.int64)
    block = np.column_stack([links.device, square])
    return np.unique(block, axis=0, return_inverse=True)[1].ravel()


def require_names(what: str, given: Collection[str], expected: Collection[str]) -> None:
    """Raise ValueError, with `what` in front, unless the names are exactly the expected ones."""
    wrong = sorted(set(given) ^ set(expected))
    if wrong:
        state = "missing" if wrong[0] in expected else "unknown"
        raise ValueError(f"{what}: {wrong[0][:60]!r} is {state}")


def require_array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...],
                  low: float, high: float) -> np.ndarray:
    """Return `arrays[name]` after checking its shape (None: any length) and range of values.

    Raises:
        KeyError: the array is missing.
        ValueError: it is empty, or its shape or a value is wrong.
    """
    array = arrays[name]
    if array.ndim != len(shape) or 0 in array.shape or any(
            side not in (None, given) for side, given in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has the shape {array.shape}")
    if array.dtype.kind not in "fiu" or not ((array >= low) & (array <= high)).all():
        raise ValueError(f"{name} holds something else than numbers from {low:g} to {high:g}")
    return array


def require_number(settings: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return `settings[name]` as a float after checking that it is a number from low to high.

    Raises:
        KeyError: the setting is missing.
        ValueError: it is no number, or out of range.
    """
    value = settings[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {str(value)[:60]}; allowed are numbers from {low:g} to "
                         f"{high:g}")
    return float(value)
