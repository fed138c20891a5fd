"""Published path loss of air-to-ground links: Al-Hourani et al. [1, 2] and 3GPP TR 36.777 [3].

Al-Hourani: free-space loss plus an excess loss by LoS class and elevation. The lower end is the
terminal on the ground, the higher one the platform. The papers' platforms fly above all roofs; if a
map gives their heights, the validity requires it. [1] gives the probability of line of sight
(Eq. 5), [2] the excess losses and their standard deviations, by frequency.

TR 36.777: a receiver above 22.5 m that is the higher end is an aerial terminal (Annex B). The lower
end, a device near the ground, takes the place of the report's base station at 25 m (UMa) or 10 m
(UMi). The path loss does not contain the base station's height; the probability of line of sight
was simulated for it, and is too high for a device in the street. Otherwise the higher end, such as
a mast, is the base station of TR 38.901 [4] and the lower end its terminal, with an environment
height of 1 m.

[1] Al-Hourani, Kandeepan, Lardner, "Optimal LAP altitude for maximum coverage", IEEE Wireless
    Communications Letters 3(6), 2014.
[2] Al-Hourani, Kandeepan, Jamalipour, "Modeling air-to-ground path loss for low altitude platforms
    in urban environments", IEEE GLOBECOM 2014.
[3] 3GPP TR 36.777 V15.0.0.
[4] 3GPP TR 38.901 V16.1.0, Sec. 7.4.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy.constants import speed_of_light
from typing_extensions import override

from radiotwin.inference.gaussian import Limit
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.published import (
    Branch,
    PublishedLaw,
    Validity,
    ends_m,
    free_space_db,
    ground_m,
    heights_m,
    mean_roof_m,
)

FREQUENCIES_HZ = (0.7e9, 2.0e9, 5.8e9)  # of [2]; excess losses are interpolated over log f
AERIAL_M = 22.5  # TR 36.777 holds for receivers above this height
MAX_HEIGHT_M, MAX_NLOS_HEIGHT_M = 300.0, 100.0  # of TR 36.777; the second for UMa-AV without LoS
MAX_AERIAL_M, MAX_DISTANCE_M = 4000.0, 5000.0  # greatest distance of TR 36.777, of TR 38.901
MIN_TERMINAL_M = 1.5  # lowest terminal of TR 38.901
ENVIRONMENT_M = 1.0  # effective environment height of TR 38.901


class Environment(NamedTuple):
    """Parameters of an environment ([1], [2]); pairs are for LoS and NLoS.

    Triples are values at `FREQUENCIES_HZ`.

    Attributes:
        a, b: LoS probability 1 / (1 + a exp(-b (elevation - a))), elevation in degrees.
        excess_db: mean excess loss over free space [dB].
        sd_db, decay: the excess loss has the standard deviation sd_db exp(-decay elevation) [dB].
    """

    a: float
    b: float
    excess_db: tuple[tuple[float, float, float], tuple[float, float, float]]
    sd_db: tuple[tuple[float, float, float], tuple[float, float, float]]
    decay: tuple[tuple[float, float, float], tuple[float, float, float]]


class _AlHourani(PublishedLaw):
    """Air-to-ground loss of Al-Hourani et al.; subclasses set the environment."""

    source = "Al-Hourani et al. 2014"
    frequency_range_hz = (0.7e9, 5.8e9)
    environment: ClassVar[Environment]

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        super().fit(links, level_db, limit_db, seed)
        self.roof_m = mean_roof_m(links.city) if links.city is not None else 0.0
        return self

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        return Validity(self.frequency_range_hz, (1.0, np.inf), (self.roof_m, np.inf))

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return free-space plus mean excess loss, and a spread that falls with elevation [dB]."""
        excess_db, sd_db, decay = (
            np.interp(np.log(self.frequency_hz), np.log(FREQUENCIES_HZ), values[0 if los else 1])
            for values in self.environment[2:])
        loss_db = free_space_db(links.distance_m, self.frequency_hz) + excess_db
        return Branch(loss_db, sd_db * np.exp(-decay * _elevation_deg(links)))

    @override
    def los_probability(self, links: LinkGeometry) -> np.ndarray:
        a, b = self.environment[:2]
        return 1 / (1 + a * np.exp(-b * (_elevation_deg(links) - a)))


def _elevation_deg(links: LinkGeometry) -> np.ndarray:
    """Return the elevation (n,) of the higher end seen from the lower end [deg]."""
    return np.abs(np.degrees(links.elevation_rad))


class AlHouraniSuburban(_AlHourani):
    """Air-to-ground path loss of Al-Hourani et al., suburban."""

    name = "al_hourani_suburban"
    environment = Environment(4.88, 0.43, ((0.0, 0.1, 0.2), (18.0, 21.0, 24.0)),
                              ((11.53, 11.25, 11.04), (26.53, 32.17, 39.56)),
                              ((0.06, 0.06, 0.06), (0.03, 0.03, 0.04)))


class AlHouraniUrban(_AlHourani):
    """Air-to-ground path loss of Al-Hourani et al., urban."""

    name = "al_hourani_urban"
    environment = Environment(9.61, 0.16, ((0.6, 1.0, 1.2), (17.0, 20.0, 23.0)),
                              ((10.98, 10.39, 10.67), (23.31, 29.6, 35.85)),
                              ((0.05, 0.05, 0.05), (0.03, 0.03, 0.04)))


class AlHouraniDenseUrban(_AlHourani):
    """Air-to-ground path loss of Al-Hourani et al., dense urban."""

    name = "al_hourani_dense_urban"
    environment = Environment(12.08, 0.11, ((1.0, 1.6, 1.8), (20.0, 23.0, 26.0)),
                              ((9.64, 8.96, 9.21), (30.83, 35.97, 40.86)),
                              ((0.04, 0.04, 0.04), (0.04, 0.04, 0.04)))


class AlHouraniHighRise(_AlHourani):
    """Air-to-ground path loss of Al-Hourani et al., high-rise urban."""

    name = "al_hourani_high_rise"
    environment = Environment(27.23, 0.08, ((1.5, 2.3, 2.5), (29.0, 34.0, 41.0)),
                              ((9.16, 7.37, 7.15), (32.13, 37.08, 40.96)),
                              ((0.03, 0.03, 0.03), (0.03, 0.03, 0.03)))


class _Urban3gpp(PublishedLaw):
    """TR 36.777 for aerial receivers, TR 38.901 for others; subclasses set UMa or UMi."""

    frequency_range_hz = (0.5e9, 100e9)
    station_m: ClassVar[float]  # height of the reports' base station [m]
    max_nlos_m: ClassVar[float]  # greatest height of an aerial terminal in NLoS [m]
    intercept_db: ClassVar[float]  # of TR 38.901 LoS, before the breakpoint
    exponent: ClassVar[float]  # path-loss exponent of TR 38.901 LoS, before the breakpoint
    beyond_db: ClassVar[float]  # factor of the breakpoint term of TR 38.901 LoS [dB]

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        """Return the ranges of TR 36.777 for aerial receivers, of TR 38.901 for other links."""
        aerial = self._is_aerial(links)
        aerial_nlos = aerial & ~links.los if self.with_map else np.zeros(len(links), dtype=bool)
        return Validity(
            self.frequency_range_hz, (10.0, np.where(aerial, MAX_AERIAL_M, MAX_DISTANCE_M)),
            (MIN_TERMINAL_M, np.where(aerial_nlos, self.max_nlos_m, MAX_HEIGHT_M)),
            (MIN_TERMINAL_M, np.where(aerial, max(self.station_m, AERIAL_M), AERIAL_M)))

    def terrestrial_los_db(self, links: LinkGeometry) -> np.ndarray:
        """Return the LoS path loss (n,) [dB] of TR 38.901, Table 7.4.1-1."""
        high_m, low_m = self._ends_m(links)
        frequency_db = 20 * self._log_ghz()
        breakpoint_m = (4 * (high_m - ENVIRONMENT_M) * (low_m - ENVIRONMENT_M)
                        * self.frequency_hz / speed_of_light)
        near_db = self.intercept_db + 10 * self.exponent * links.log_distance + frequency_db
        far_db = (self.intercept_db + 40 * links.log_distance + frequency_db
                  - self.beyond_db * np.log10(breakpoint_m**2 + (high_m - low_m) ** 2))
        return np.where(ground_m(links) < breakpoint_m, near_db, far_db)

    def _ends_m(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (n,) of the higher and lower end, clipped to the reports' range [m]."""
        high_m, low_m = ends_m(links)
        return (np.clip(high_m, MIN_TERMINAL_M, MAX_HEIGHT_M),
                np.clip(low_m, MIN_TERMINAL_M, AERIAL_M))

    def _is_aerial(self, links: LinkGeometry) -> np.ndarray:
        """Return (n,) bool: the receiver is the higher end and above AERIAL_M."""
        device_m, receiver_m = heights_m(links)
        return (receiver_m > AERIAL_M) & (receiver_m >= device_m)

    def _log_ghz(self) -> float:
        """Return log10 of the frequency in GHz."""
        return float(np.log10(self.frequency_hz / 1e9))


class UrbanMacro(_Urban3gpp):
    """UMa-AV of TR 36.777; UMa of TR 38.901 for receivers up to 22.5 m."""

    name = "tr36777_uma"
    source = "3GPP TR 36.777 Annex B UMa-AV, TR 38.901 UMa"
    station_m, max_nlos_m = 25.0, MAX_NLOS_HEIGHT_M
    intercept_db, exponent, beyond_db = 28.0, 2.2, 9.0

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return the UMa path loss and shadowing sd [dB] of aerial receivers, or of terminals."""
        high_m, low_m = self._ends_m(links)
        aerial, log_d = self._is_aerial(links), links.log_distance
        los_db = np.where(aerial, 28.0 + 22 * log_d + 20 * self._log_ghz(),  # Table B-2
                          self.terrestrial_los_db(links))
        if los:
            return Branch(los_db, np.where(aerial, 4.64 * np.exp(-0.0066 * high_m), 4.0))
        height_m = np.minimum(high_m, MAX_NLOS_HEIGHT_M)
        aerial_db = (-17.5 + (46 - 7 * np.log10(height_m)) * log_d
                     + 20 * np.log10(40 * np.pi * self.frequency_hz / 3e9))
        terrestrial_db = 13.54 + 39.08 * log_d + 20 * self._log_ghz() - 0.6 * (low_m - 1.5)
        return Branch(np.where(aerial, aerial_db, np.maximum(los_db, terrestrial_db)), 6.0)

    @override
    def los_probability(self, links: LinkGeometry) -> np.ndarray:
        """Return the UMa LoS probability (n,): TR 36.777 if aerial, else TR 38.901."""
        high_m, low_m = self._ends_m(links)
        horizontal_m = ground_m(links)
        log_height = np.log10(np.maximum(high_m, AERIAL_M))
        reach_m = np.where(high_m > 100.0, np.inf, np.maximum(460 * log_height - 700, 18.0))
        aerial = _los_probability(horizontal_m, reach_m, 4300 * log_height - 3800)
        # TR 38.901, Table 7.4.2-1: a terminal above 13 m sees farther.
        above_13_m = np.maximum((low_m - 13) / 10, 0.0) ** 1.5
        farther = 1 + above_13_m * 1.25 * (horizontal_m / 100) ** 3 * np.exp(-horizontal_m / 150)
        terrestrial = np.minimum(_los_probability(horizontal_m, 18.0, 63.0) * farther, 1.0)
        return np.where(self._is_aerial(links), aerial, terrestrial)


class UrbanMicro(_Urban3gpp):
    """UMi-AV of TR 36.777; UMi street canyon of TR 38.901 for receivers up to 22.5 m."""

    name = "tr36777_umi"
    source = "3GPP TR 36.777 Annex B UMi-AV, TR 38.901 UMi"
    station_m, max_nlos_m = 10.0, MAX_HEIGHT_M
    intercept_db, exponent, beyond_db = 32.4, 2.1, 9.5

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return the UMi path loss and shadowing sd [dB] of aerial receivers, or of terminals."""
        high_m, low_m = self._ends_m(links)
        aerial, log_d = self._is_aerial(links), links.log_distance
        log_height = np.log10(high_m)
        aerial_db = np.maximum(free_space_db(links.distance_m, self.frequency_hz),
                               30.9 + (22.25 - 0.5 * log_height) * log_d + 20 * self._log_ghz())
        los_db = np.where(aerial, aerial_db, self.terrestrial_los_db(links))
        if los:
            return Branch(los_db, np.where(aerial, np.maximum(5 * np.exp(-0.01 * high_m), 2.0),
                                           4.0))
        aerial_db = 32.4 + (43.2 - 7.6 * log_height) * log_d + 20 * self._log_ghz()
        terrestrial_db = 22.4 + 35.3 * log_d + 21.3 * self._log_ghz() - 0.3 * (low_m - 1.5)
        return Branch(np.maximum(los_db, np.where(aerial, aerial_db, terrestrial_db)),
                      np.where(aerial, 8.0, 7.82))

    @override
    def los_probability(self, links: LinkGeometry) -> np.ndarray:
        """Return the UMi LoS probability (n,): TR 36.777 if aerial, else TR 38.901."""
        high_m, horizontal_m = self._ends_m(links)[0], ground_m(links)
        log_height = np.log10(np.maximum(high_m, AERIAL_M))
        aerial = _los_probability(horizontal_m, np.maximum(294.05 * log_height - 432.94, 18.0),
                                  233.98 * log_height - 0.95)
        return np.where(self._is_aerial(links), aerial, _los_probability(horizontal_m, 18.0, 36.0))


def _los_probability(horizontal_m: np.ndarray, sure_m: np.ndarray | float,
                     length_m: np.ndarray | float) -> np.ndarray:
    """Return the LoS probability (n,), 1 up to `sure_m`, then falling (TR 38.901, 7.4.2)."""
    sure_share = np.minimum(np.divide(sure_m, np.maximum(horizontal_m, 1e-9)), 1.0)
    return sure_share + np.exp(-horizontal_m / length_m) * (1 - sure_share)
