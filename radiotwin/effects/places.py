"""Corrections of the declared scene by effects, and marks of effects on maps.

`radiotwin.closeloop.output.corrected_scene` writes the scene with the corrections, and
`radiotwin.report.map_figures` draws the marks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from radiotwin.effects.boxes import Box
from radiotwin.effects.params import Length, Metres


class Roof(NamedTuple):
    """A roof whose height differs from the map.

    Attributes:
        building: index from `radiotwin.effects.boxes.buildings`.
        x_m, y_m, height_m: centre and height on the map [m].
        offset_m: height that predicts the links best minus mapped height [m].
        offset_sd_m: standard deviation of `true_offset_m` [m].
        common_m: part of `offset_m` common to all other roofs, an error of the model [m].
    """

    building: int
    x_m: Metres
    y_m: Metres
    height_m: Metres
    offset_m: Metres
    offset_sd_m: Length
    common_m: Metres = 0.0

    @property
    def true_offset_m(self) -> float:
        """Estimate of true minus mapped height [m]."""
        return self.offset_m - self.common_m


class FoundAntenna(NamedTuple):
    """A directive antenna found for a device.

    Attributes:
        kind: printed kind, e.g. "sector antenna".
        azimuth_deg: direction of the boresight, clockwise from north [deg].
        beamwidth_deg: horizontal 3 dB beamwidth [deg].
        gain_db: azimuth from the boresight and elevation (n,) [deg] -> relative gain (n,) [dB].
    """

    kind: str
    azimuth_deg: float
    beamwidth_deg: float
    gain_db: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Correction:
    """Corrections of the declared scene by one effect.

    Attributes:
        boxes: buildings missing on the map.
        gone: indices of mapped buildings that do not exist, from `buildings`.
        roofs: roofs of another height.
        moves_m: device index -> true minus declared position, east and north [m].
        antennas: device index -> antenna.
    """

    boxes: tuple[Box, ...] = ()
    gone: tuple[int, ...] = ()
    roofs: tuple[Roof, ...] = ()
    moves_m: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    antennas: Mapping[int, FoundAntenna] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Mark:
    """Mark of an effect on a map: an outline, an area, an arrow, or by default a cross.

    Attributes:
        text: label.
        at_m: (2,) x and y of the place, or of the tip of an arrow [m].
        outline_m: (k, 2) corners of an outline, the last one equal to the first [m].
        faces_m: (f, 3, 2) triangles of an area [m].
        from_m: (2,) start of an arrow [m].
    """

    text: str
    at_m: np.ndarray
    outline_m: np.ndarray | None = None
    faces_m: np.ndarray | None = None
    from_m: np.ndarray | None = None
