"""Gain of an antenna by direction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

EVEN_SHARE = 0.01  # of their mean, by which the steps of even azimuths may differ: files round them


@dataclass(frozen=True, eq=False)
class Pattern:
    """Gain on a grid of directions in the antenna's own frame.

    Attributes:
        azimuth_deg: (n,) ascending, 0 to less than 360, clockwise from the boresight seen from
            above.
        elevation_deg: (m,) ascending, -90 (below) to 90 (above).
        gain_dbi: (m, n) gain over an isotropic antenna [dBi].
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    gain_dbi: np.ndarray

    @property
    def peak_dbi(self) -> float:
        """Maximum gain of the grid [dBi]."""
        return float(self.gain_dbi.max())

    def at(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> np.ndarray:
        """Interpolate the gain, bilinear in dB and periodic in azimuth.

        Args:
            azimuth_deg: any shape, clockwise from the boresight.
            elevation_deg: any shape that broadcasts with it, above zero upwards.

        Returns:
            Gain of the common shape [dBi].
        """
        # The first column is repeated at the end: 359.5 degrees lies between the last and the first
        azimuths = np.append(self.azimuth_deg, self.azimuth_deg[0] + 360)
        gains = np.column_stack([self.gain_dbi, self.gain_dbi[:, :1]])
        wrapped = (np.asarray(azimuth_deg) - azimuths[0]) % 360 + azimuths[0]
        column, right = _bracket(azimuths, wrapped)
        row, above = _bracket(self.elevation_deg, np.clip(elevation_deg, -90, 90))
        low = (1 - right) * gains[row, column] + right * gains[row, column + 1]
        high = (1 - right) * gains[row + 1, column] + right * gains[row + 1, column + 1]
        return (1 - above) * low + above * high

    def heading_mean(self) -> "Pattern":
        """Average the power over all azimuths, for an antenna on a carrier that turns.

        Evenly spaced azimuths count alike. Others stand for unequal shares of a turn: then the mean
        is that of the interpolated pattern.
        """
        gaps_deg = np.diff(self.azimuth_deg, append=self.azimuth_deg[0] + 360)
        power = 10 ** (self.gain_dbi / 10)
        if np.ptp(gaps_deg) > EVEN_SHARE * gaps_deg.mean():
            # Between two azimuths a line in dB, whose power has the logarithmic mean of its ends
            rise = np.diff(self.gain_dbi, append=self.gain_dbi[:, :1]) * np.log(10) / 10
            level = np.abs(rise) < 1e-9
            power = power * np.where(level, 1.0, np.expm1(rise) / np.where(level, 1.0, rise))
        mean_dbi = 10 * np.log10(power @ gaps_deg / 360)
        return Pattern(np.array([0.0]), self.elevation_deg, mean_dbi[:, None])


def _bracket(grid: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the grid value below each value, and the fraction of the step above.

    Beyond the ends of the grid the fraction is that of the end.
    """
    index = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    held = np.clip(values, grid[0], grid[-1])
    return index, (held - grid[index]) / (grid[index + 1] - grid[index])


@dataclass(frozen=True, eq=False)
class Antenna:
    """A pattern and its orientation.

    Attributes:
        pattern: gain in the antenna's own frame.
        azimuth_deg: direction of the boresight, clockwise from north.
        tilt_deg: elevation of the boresight, above zero upwards.
    """

    pattern: Pattern
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0

    def gain_dbi(self, rays: np.ndarray) -> np.ndarray:
        """Return the gain along rays.

        Args:
            rays: (..., 3) directions east, north, up, of any length above zero.

        Returns:
            (...,) gain [dBi].
        """
        azimuth, tilt = np.radians([self.azimuth_deg, self.tilt_deg])
        ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        ahead, up = (np.cos(tilt) * ahead + np.sin(tilt) * up,
                     np.cos(tilt) * up - np.sin(tilt) * ahead)
        unit = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-30)
        return self.pattern.at(np.degrees(np.arctan2(unit @ right, unit @ ahead)),
                               np.degrees(np.arcsin(np.clip(unit @ up, -1, 1))))
