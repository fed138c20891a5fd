"""Air-to-ground law of Al-Hourani et al.: free space, plus an excess loss by class and elevation.

[1] Al-Hourani, Kandeepan, Lardner, 'Optimal LAP altitude for maximum coverage', IEEE Wireless
Communications Letters 3(6), 2014: the probability of line of sight (Eq. 5).
[2] Al-Hourani, Kandeepan, Jamalipour, 'Modeling air-to-ground path loss for low altitude platforms
in urban environments', IEEE GLOBECOM 2014: excess losses, and their standard deviations, by
frequency.

The lower end is the terminal on the ground, the higher one the platform, as in the papers, whose
platforms fly above all roofs; where a map says how high those are, that is asked for.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Self

import numpy as np
from typing_extensions import override

from radiotwin.channel.published import (
    Branch,
    PublishedLaw,
    Validity,
    free_space_db,
    mean_roof_m,
)
from radiotwin.inference.gaussian import Limit
from radiotwin.links import LinkGeometry

FREQUENCIES_HZ = (0.7e9, 2.0e9, 5.8e9)  # between which excess losses are interpolated over log f


class Environment(NamedTuple):
    """Parameters of an environment; three values are those at `FREQUENCIES_HZ`.

    Attributes:
        a, b: of the probability of line of sight 1 / (1 + a exp(-b (elevation - a))), in degrees.
        excess_db: mean excess loss with line of sight and without [dB].
        sd_db, decay: its standard deviation is sd_db exp(-decay elevation), of both classes.
    """

    a: float
    b: float
    excess_db: tuple[tuple[float, float, float], tuple[float, float, float]]
    sd_db: tuple[tuple[float, float, float], tuple[float, float, float]]
    decay: tuple[tuple[float, float, float], tuple[float, float, float]]


class _AlHourani(PublishedLaw):
    """The law; subclasses have the environment."""

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
        each = 0 if los else 1
        excess_db, sd_db, decay = (
            np.interp(np.log(self.frequency_hz), np.log(FREQUENCIES_HZ), values[each])
            for values in self.environment[2:])
        loss_db = free_space_db(links.distance_m, self.frequency_hz) + excess_db
        return Branch(loss_db, sd_db * np.exp(-decay * _elevation_deg(links)))

    @override
    def los_probability(self, links: LinkGeometry) -> np.ndarray:
        a, b = self.environment[:2]
        return 1 / (1 + a * np.exp(-b * (_elevation_deg(links) - a)))


def _elevation_deg(links: LinkGeometry) -> np.ndarray:
    """Return the angle (n,) at the lower end up to the higher one [deg]."""
    return np.abs(np.degrees(links.elevation_rad))


class AlHouraniSuburban(_AlHourani):
    """Suburban."""

    name = "al_hourani_suburban"
    environment = Environment(4.88, 0.43, ((0.0, 0.1, 0.2), (18.0, 21.0, 24.0)),
                              ((11.53, 11.25, 11.04), (26.53, 32.17, 39.56)),
                              ((0.06, 0.06, 0.06), (0.03, 0.03, 0.04)))


class AlHouraniUrban(_AlHourani):
    """Urban."""

    name = "al_hourani_urban"
    environment = Environment(9.61, 0.16, ((0.6, 1.0, 1.2), (17.0, 20.0, 23.0)),
                              ((10.98, 10.39, 10.67), (23.31, 29.6, 35.85)),
                              ((0.05, 0.05, 0.05), (0.03, 0.03, 0.04)))


class AlHouraniDenseUrban(_AlHourani):
    """Dense urban."""

    name = "al_hourani_dense_urban"
    environment = Environment(12.08, 0.11, ((1.0, 1.6, 1.8), (20.0, 23.0, 26.0)),
                              ((9.64, 8.96, 9.21), (30.83, 35.97, 40.86)),
                              ((0.04, 0.04, 0.04), (0.04, 0.04, 0.04)))


class AlHouraniHighRise(_AlHourani):
    """High-rise urban."""

    name = "al_hourani_high_rise"
    environment = Environment(27.23, 0.08, ((1.5, 2.3, 2.5), (29.0, 34.0, 41.0)),
                              ((9.16, 7.37, 7.15), (32.13, 37.08, 40.96)),
                              ((0.03, 0.03, 0.03), (0.03, 0.03, 0.03)))
