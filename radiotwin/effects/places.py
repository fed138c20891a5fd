"""Where an effect is: what it corrects in the declared scene, and how maps mark it.

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
    """A roof of the map, and how much higher it is than the map says.

    Attributes:
        building: index, as `radiotwin.effects.boxes.buildings` numbers them.
        x_m, y_m, height_m: centre and height on the map [m].
        offset_m: how much higher the one is that predicts links best [m].
        offset_sd_m: standard deviation of `true_offset_m` [m].
        common_m: what the other roofs have in common of it, which is the model's [m].
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
    """An antenna that a device turned out to have.

    Attributes:
        kind: as "sector antenna".
        azimuth_deg: direction of its boresight, clockwise from north.
        beamwidth_deg: horizontal width between the points 3 dB below the maximum.
        gain_db: azimuth from the boresight and elevation (n,) [deg] -> gain (n,), up to a constant
            [dB].
    """

    kind: str
    azimuth_deg: float
    beamwidth_deg: float
    gain_db: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Correction:
    """What one effect says of the declared scene.

    Attributes:
        boxes: buildings that the map lacks.
        gone: buildings of the map that are not there, as `buildings` numbers them.
        roofs: that are off.
        moves_m: index of a device -> its true minus its declared position, east and north [m].
        antennas: index of a device -> what it has.
    """

    boxes: tuple[Box, ...] = ()
    gone: tuple[int, ...] = ()
    roofs: tuple[Roof, ...] = ()
    moves_m: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    antennas: Mapping[int, FoundAntenna] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Mark:
    """How a map marks where an effect is: by an outline, an area, an arrow, or else a cross.

    Attributes:
        text: beside it.
        at_m: (2,) its place, x and y; an arrow ends there [m].
        outline_m: (k, 2) corners of an outline, the last one like the first [m].
        faces_m: (f, 3, 2) triangles of an area [m].
        from_m: (2,) where an arrow begins [m].
    """

    text: str
    at_m: np.ndarray
    outline_m: np.ndarray | None = None
    faces_m: np.ndarray | None = None
    from_m: np.ndarray | None = None
