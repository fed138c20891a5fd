"""Walfisch-Ikegami model of COST 231: along a street, and over rows of roofs.

COST Action 231, 'Digital mobile radio towards future generation systems', final report, EUR 18957,
1999, Sec. 4.4.1. The higher end is the base station, the lower one the mobile in the street. Roofs
are as high as those of the map on average; street width and distance of buildings are the report's
defaults. The distance is that through the air: in the report's range the one along the ground makes
little difference, and above a device it makes no sense.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from radiotwin.channel.published import Branch, PublishedLaw, Validity, ends_m, free_space_db
from radiotwin.links import LinkGeometry

BUILDING_M = 35.0  # between buildings: the middle of the report's 20 to 50 m
STREET_M = BUILDING_M / 2
STREET_ANGLE_DEG = 90.0  # between street and path
MIN_BELOW_ROOF_M = 1.0  # that the mobile is below the roofs, whatever their height
LOS_M = 20.0  # from which on the law along a street holds; it is free space there
# The report has a standard deviation of 4 to 8 dB: its ends are taken for the two classes.
LOS_SD_DB, NLOS_SD_DB = 4.0, 8.0
BASE_M, MOBILE_M = (4.0, 50.0), (1.0, 3.0)  # heights that the report is for


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
