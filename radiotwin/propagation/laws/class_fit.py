"""Level and error scale of links with, and without, line of sight, where a map may be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from radiotwin.inference import student
from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry, design_effect

DOF = 4.0  # of the errors
BLOCK_M = 100.0  # side of the ground within which the links of a device err alike


@dataclass(frozen=True, eq=False)
class ClassFit:
    """Level and error scale of links of one class.

    Attributes:
        numbers: level [dB], and logarithm of the scale where the map's errors do nothing.
    """

    numbers: np.ndarray

    @property
    def level_db(self) -> float:
        """Offset of measured levels from those of the paths [dB]."""
        return float(self.numbers[0])

    def scale_db(self, square_db: np.ndarray) -> np.ndarray:
        """Return the scale (n,) [dB] of links that errors of the map change so much (n,) [dB²]."""
        return scale_db(float(np.exp(self.numbers[1])), square_db)


def scale_db(own_db: float | np.ndarray, square_db: np.ndarray) -> np.ndarray:
    """Return the Student-t scale (n,) [dB] of a class's own scale and the map's errors (n,)."""
    return np.sqrt(own_db**2 + square_db * (DOF - 2) / DOF)


def fit_class(level_db: np.ndarray, limits_db: np.ndarray, paths: np.ndarray,
              square_db: np.ndarray, start: np.ndarray | None = None) -> ClassFit:
    """Fit level and scale to links of one class.

    Args:
        level_db: (n,) [dB]; NaN: not detected.
        limits_db: (n,) below which levels are not detected [dB].
        paths: (n,) levels of the followed paths [dB].
        square_db: (n,) mean square of what the map's errors do [dB²].
        start: of an earlier fit.
    """
    if start is None:
        seen = np.isfinite(level_db)
        start = np.array([np.median((level_db - paths)[seen]), 0.5])

    def nll(numbers: np.ndarray) -> float:
        own_db = float(np.exp(np.clip(numbers[1], -3, 4)))
        return float(student.censored_nll(level_db, limits_db, paths + numbers[0],
                                          scale_db(own_db, square_db), DOF).sum())

    found = minimize(nll, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
    return ClassFit(np.array([found.x[0], np.clip(found.x[1], -3, 4)]))


class LinkFit:
    """Both classes of some links, fitted again and again, each time from where the last one ended.

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
            mine = los == state
            if not np.isfinite(self.level_db[mine]).any():
                continue
            fit = fit_class(self.level_db[mine], self.limits_db[mine], paths_db[mine],
                            square_db[mine], self._start.get(state))
            self._start[state] = fit.numbers
            mean_db, sd_db = paths_db[mine] + fit.level_db, fit.scale_db(square_db[mine])
            nll[mine] = student.censored_nll(self.level_db[mine], self.limits_db[mine], mean_db,
                                             sd_db, DOF)
            z[mine] = np.nan_to_num((self.level_db[mine] - mean_db) / sd_db)
        return nll, z


def links_as_one(links: LinkGeometry, z: np.ndarray) -> float:
    """Return how many links count as one.

    Args:
        links: n links.
        z: (n,) residuals over their scale.
    """
    block = np.column_stack([links.device, np.floor(links.receiver_m[:, :2] / BLOCK_M)])
    label = np.unique(block, axis=0, return_inverse=True)[1].reshape(-1)
    return design_effect(label, z)
