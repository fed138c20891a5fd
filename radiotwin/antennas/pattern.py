"""The gain of an antenna by direction."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Pattern:
    """Gain over a regular grid of directions, as the antenna itself sees them.

    Attributes:
        azimuth_deg: (n,) ascending, from 0 to less than 360, clockwise from the boresight as seen from above.
        elevation_deg: (m,) ascending, from -90 (below) to 90 (above).
        gain_dbi: (m, n) over an isotropic antenna [dB].
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    gain_dbi: np.ndarray

    @property
    def peak_dbi(self) -> float:
        return float(self.gain_dbi.max())

    def at(self, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
        """Gain [dBi] in directions (any shape), linear in dB between those of the grid; the azimuth goes round."""
        # The first column once more at the end, so that 359.5 degrees lies between the last and the first
        azimuths = np.append(self.azimuth_deg, self.azimuth_deg[0] + 360)
        gains = np.column_stack([self.gain_dbi, self.gain_dbi[:, :1]])
        turned = (np.asarray(azimuth_deg) - azimuths[0]) % 360 + azimuths[0]
        column, right = _between(azimuths, turned)
        row, above = _between(self.elevation_deg, np.clip(elevation_deg, -90, 90))
        low = (1 - right) * gains[row, column] + right * gains[row, column + 1]
        high = (1 - right) * gains[row + 1, column] + right * gains[row + 1, column + 1]
        return (1 - above) * low + above * high

    def around(self) -> "Pattern":
        """The mean power over all headings at each elevation: of an antenna on something that turns as it goes."""
        mean_dbi = 10 * np.log10(np.mean(10 ** (self.gain_dbi / 10), axis=1))
        return Pattern(np.array([0.0]), self.elevation_deg, mean_dbi[:, None])


def _between(grid: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the grid's value below each, and the share of the way to the next."""
    index = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    return index, (values - grid[index]) / (grid[index + 1] - grid[index])


@dataclass(frozen=True, eq=False)
class Antenna:
    """A pattern that looks somewhere.

    Attributes:
        pattern: see there.
        azimuth_deg: of the boresight, clockwise from north.
        tilt_deg: of the boresight, above zero upwards.
    """

    pattern: Pattern
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0

    def gain_dbi(self, rays: np.ndarray) -> np.ndarray:
        """(...,) gain [dBi] along rays (..., 3) east, north, up of any length above zero."""
        azimuth, tilt = np.radians([self.azimuth_deg, self.tilt_deg])
        ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        ahead, up = np.cos(tilt) * ahead + np.sin(tilt) * up, np.cos(tilt) * up - np.sin(tilt) * ahead
        unit = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-30)
        return self.pattern.at(np.degrees(np.arctan2(unit @ right, unit @ ahead)),
                               np.degrees(np.arcsin(np.clip(unit @ up, -1, 1))))
