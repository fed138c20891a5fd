"""Site-general laws of ITU-R P.1411-12 for short outdoor paths in cities.

Where both ends are below the mean roof: Sec. 4.1.1, Table 4 (within street canyons). Where the
higher end is above it: Sec. 4.2.1, Table 8 (over rooftops), published for 2.2 to 73 GHz. Both are
L = 10 alpha log10 d + beta + 10 gamma log10 f, with d in metres and f in GHz (Eqs. 1 and 20). Links
without line of sight are those of urban high-rise, the only ones published below 10 GHz; as the
recommendation has it, their loss is not below that of free space.
"""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from radiotwin.channel.published import Branch, PublishedLaw, Validity, ends_m, free_space_db
from radiotwin.links import LinkGeometry

# alpha, beta [dB], gamma, sd [dB]: without line of sight, with it
BELOW_ROOFS = (4.00, 10.2, 2.36, 7.60), (2.12, 29.2, 2.11, 5.06)  # Table 4
OVER_ROOFS = (4.39, -6.27, 2.30, 6.89), (2.29, 28.6, 1.96, 3.48)  # Table 8
# Distances of the same rows [m].
BELOW_ROOFS_M, OVER_ROOFS_M = ((30.0, 715.0), (5.0, 660.0)), ((260.0, 1200.0), (55.0, 1200.0))


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
