"""Published laws of cities: COST 231 Walfisch-Ikegami and ITU-R P.1411-12.

Walfisch-Ikegami model of COST 231: along a street, and over rows of roofs.

COST Action 231, 'Digital mobile radio towards future generation systems', final report, EUR 18957,
1999, Sec. 4.4.1. The higher end is the base station, the lower one the mobile in the street. Roofs
are as high as those of the map on average; street width and distance of buildings are the report's
defaults. The distance is that through the air: in the report's range the one along the ground makes
little difference, and above a device it makes no sense.

Site-general laws of ITU-R P.1411-12 for short outdoor paths in cities.

Where both ends are below the mean roof: Sec. 4.1.1, Table 4 (within street canyons). Where the
higher end is above it: Sec. 4.2.1, Table 8 (over rooftops), published for 2.2 to 73 GHz. Both are
L = 10 alpha log10 d + beta + 10 gamma log10 f, with d in metres and f in GHz (Eqs. 1 and 20). Links
without line of sight are those of urban high-rise, the only ones published below 10 GHz; as the
recommendation has it, their loss is not below that of free space.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.published import (
    Branch,
    PublishedLaw,
    Validity,
    ends_m,
    free_space_db,
)

BUILDING_M = 35.0  # between buildings: the middle of the report's 20 to 50 m
STREET_M = BUILDING_M / 2
STREET_ANGLE_DEG = 90.0  # between street and path
MIN_BELOW_ROOF_M = 1.0  # that the mobile is below the roofs, whatever their height
LOS_M = 20.0  # from which on the law along a street holds; it is free space there
# The report has a standard deviation of 4 to 8 dB: its ends are taken for the two classes.
LOS_SD_DB, NLOS_SD_DB = 4.0, 8.0
BASE_M, MOBILE_M = (4.0, 50.0), (1.0, 3.0)  # heights that the report is for
# alpha, beta [dB], gamma, sd [dB]: without line of sight, with it
BELOW_ROOFS = (4.00, 10.2, 2.36, 7.60), (2.12, 29.2, 2.11, 5.06)  # Table 4
OVER_ROOFS = (4.39, -6.27, 2.30, 6.89), (2.29, 28.6, 1.96, 3.48)  # Table 8
# Distances of the same rows [m].
BELOW_ROOFS_M, OVER_ROOFS_M = ((30.0, 715.0), (5.0, 660.0)), ((260.0, 1200.0), (55.0, 1200.0))


class WalfischIkegami(PublishedLaw):
    """COST 231 Walfisch-Ikegami, medium-sized city."""

    name = "cost231_wi"
    source = "COST 231 final report, Walfisch-Ikegami"
    frequency_range_hz = (0.8e9, 2.0e9)
    needs_map = True
    city_factor: ClassVar[float] = 0.7  # of k_f

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        return Validity(self.frequency_range_hz, (20.0, 5000.0), BASE_M, MOBILE_M)

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        free_db = free_space_db(links.distance_m, self.frequency_hz)
        if los:
            street_db = (42.6 + 26 * np.log10(links.distance_m / 1e3)
                         + 20 * np.log10(self.frequency_hz / 1e6))
            return Branch(np.where(links.distance_m < LOS_M, free_db, street_db), LOS_SD_DB)
        excess_db = self._roof_to_street_db(links) + self._many_screens_db(links)
        return Branch(free_db + np.maximum(excess_db, 0.0), NLOS_SD_DB)

    def _roof_to_street_db(self, links: LinkGeometry) -> np.ndarray:
        """Return L_rts (n,) [dB]: from the last roof down to the mobile, Ikegami's part."""
        mobile_m = np.clip(ends_m(links)[1], *MOBILE_M)
        below_m = np.maximum(self.roof_m - mobile_m, MIN_BELOW_ROOF_M)
        orientation_db = 4.0 - 0.114 * (STREET_ANGLE_DEG - 55)
        return (-16.9 - 10 * np.log10(STREET_M) + 10 * np.log10(self.frequency_hz / 1e6)
                + 20 * np.log10(below_m) + orientation_db)

    def _many_screens_db(self, links: LinkGeometry) -> np.ndarray:
        """Return L_msd (n,) [dB]: over the rows of roofs, Walfisch and Bertoni's part."""
        base_m = np.clip(ends_m(links)[0], *BASE_M)
        over_m, kilometres = base_m - self.roof_m, links.distance_m / 1e3
        above = over_m > 0
        shadow_db = np.where(above, -18 * np.log10(1 + np.maximum(over_m, 0.0)), 0.0)
        near = np.minimum(kilometres / 0.5, 1.0)
        k_a = np.where(above, 54.0, 54.0 - 0.8 * over_m * near)
        k_d = np.where(above, 18.0, 18.0 - 15.0 * over_m / self.roof_m)
        k_f = -4 + self.city_factor * (self.frequency_hz / 925e6 - 1)
        return (shadow_db + k_a + k_d * np.log10(kilometres)
                + k_f * np.log10(self.frequency_hz / 1e6) - 9 * np.log10(BUILDING_M))


class WalfischIkegamiMetropolitan(WalfischIkegami):
    """COST 231 Walfisch-Ikegami, metropolitan centre."""

    name = "cost231_wi_metropolitan"
    city_factor = 1.5


class P1411(PublishedLaw):
    """ITU-R P.1411-12, site-general, in street canyons and over rooftops."""

    name = "p1411"
    source = "ITU-R P.1411-12 Sec. 4.1.1 and 4.2.1"
    frequency_range_hz = (0.8e9, 82e9)
    needs_map = True

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        over, los = self._is_over(links), links.los.astype(int)
        least_m, most_m = np.where(over[:, None], np.array(OVER_ROOFS_M)[los],
                                   np.array(BELOW_ROOFS_M)[los]).T
        low_hz, high_hz = self.frequency_range_hz
        return Validity((np.where(over, 2.2e9, low_hz), np.where(over, 73e9, high_hz)),
                        (least_m, most_m))

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        over = self._is_over(links)
        alpha, beta_db, gamma, sd_db = np.where(over[:, None], OVER_ROOFS[los], BELOW_ROOFS[los]).T
        loss_db = (10 * alpha * links.log_distance + beta_db
                   + 10 * gamma * np.log10(self.frequency_hz / 1e9))
        if not los:
            loss_db = np.maximum(loss_db, free_space_db(links.distance_m, self.frequency_hz))
        return Branch(loss_db, sd_db)

    def _is_over(self, links: LinkGeometry) -> np.ndarray:
        return ends_m(links)[0] > self.roof_m
