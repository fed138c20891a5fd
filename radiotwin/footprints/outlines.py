"""Budgets of outlines, checked before geometry is computed from them.

To take apart an outline that crosses itself costs time and memory by the number of crossings,
which can be the square of the number of corners.
"""

from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.budgets import CROSSINGS, OUTLINE_CORNERS, VERTICES

_CHUNK = 256  # segments: bounds the pairs that are found at once


class OutlineBudget:
    """Corners and crossings of the outlines of one map so far.

    Args:
        source: of the outlines; messages begin with it.
    """

    def __init__(self, source: object) -> None:
        self.source = source
        self.corners = self.crossings = 0

    def check(self, name: str, area: BaseGeometry) -> None:
        """Check one building, and all so far.

        Args:
            name: of the building.
            area: polygons, valid or not.

        Raises:
            BadInput: it has too many corners, or all have, or their outlines cross themselves too
                often.
        """
        subject = f"{self.source}: {name}"
        corners = int(shapely.get_num_coordinates(area))
        OUTLINE_CORNERS.check(corners, subject)
        self.corners += corners
        VERTICES.check(self.corners, self.source)
        if not area.is_valid:
            self.crossings += self._count_crossings(subject, area)

    def _count_crossings(self, subject: str, area: BaseGeometry) -> int:
        rings = shapely.get_rings(shapely.get_parts(shapely.get_parts(area)))
        points = [shapely.get_coordinates(ring) for ring in rings]
        ends = [np.stack([ring[:-1], ring[1:]], axis=1) for ring in points]
        segments: Any = shapely.linestrings(np.concatenate([np.zeros((0, 2, 2)), *ends]))
        tree, found = shapely.STRtree(segments), 0
        for start in range(0, len(segments), _CHUNK):
            part = segments[start:start + _CHUNK]
            # Each meets itself and the two beside it; both of a pair find it
            found += max(tree.query(part, predicate="intersects").shape[1] - 3 * len(part), 0)
            CROSSINGS.check(self.crossings + found // 2, subject)
        return found // 2
