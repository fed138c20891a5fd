"""Cells of a coverage map: receivers at a height above the ground, row by row."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import COVERAGE_CELLS
from radiotwin.scene.citymap import GROUND_M, CityMap
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.surfaces import Surfaces

BLOCK_CELLS = 100_000  # that are predicted at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class CoverageGrid:
    """Square cells, and the receiver in the middle of each.

    Attributes:
        x_m: (nx,) middles of the cells, ascending [m].
        y_m: (ny,) likewise [m].
        step_m: side of a cell [m].
        height_m: of the receivers above the ground; of a radio map, as its altitudes [m].
        above_ground: whether it is above the ground.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    step_m: float
    height_m: float
    above_ground: bool = True

    @classmethod
    def over(cls, bounds_m: tuple[float, float, float, float], step_m: float,
             height_m: float) -> "CoverageGrid":
        """Return the whole cells that fit into an area, from its south-west corner on.

        Args:
            bounds_m: (x_min, x_max, y_min, y_max) [m].
            step_m: side of a cell [m].
            height_m: of the receivers above the ground [m].

        Raises:
            BadInput: no cell fits, or there are too many.
        """
        x_min, x_max, y_min, y_max = bounds_m
        nx, ny = (np.floor((high - low) / step_m + 1e-9)
                  for low, high in ((x_min, x_max), (y_min, y_max)))
        COVERAGE_CELLS.check(nx * ny, f"cells of {step_m:g} m over {x_max - x_min:g} x "
                                      f"{y_max - y_min:g} m")
        if not (nx and ny):
            raise BadInput(f"no cell of {step_m:g} m fits into an area of {x_max - x_min:g} x "
                           f"{y_max - y_min:g} m; choose a smaller step")
        return cls(x_min + step_m * (np.arange(nx) + 0.5), y_min + step_m * (np.arange(ny) + 0.5),
                   step_m, height_m)

    @classmethod
    def of_map(cls, lattice: Lattice) -> "CoverageGrid":
        """Return the cells around the positions of a radio map.

        Args:
            lattice: equally spaced, with one altitude.

        Raises:
            BadInput: there are too many.
        """
        COVERAGE_CELLS.check(len(lattice.x_m) * len(lattice.y_m), "the radio map's positions")
        return cls(lattice.x_m, lattice.y_m, lattice.step_m, float(lattice.z_m[0]),
                   lattice.ground_m is not None)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along y and x."""
        return len(self.y_m), len(self.x_m)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Outer borders of the cells (x_min, x_max, y_min, y_max) [m]."""
        half_m = self.step_m / 2
        return (float(self.x_m[0] - half_m), float(self.x_m[-1] + half_m),
                float(self.y_m[0] - half_m), float(self.y_m[-1] + half_m))

    def blocks(self) -> Iterator[slice]:
        """Yield slices of rows, of at most `BLOCK_CELLS` cells where a row is shorter."""
        rows = max(1, BLOCK_CELLS // len(self.x_m))
        for start in range(0, len(self.y_m), rows):
            yield slice(start, min(start + rows, len(self.y_m)))

    def receivers_m(self, rows: slice, ground: CityMap | None) -> np.ndarray:
        """Return the positions (n, 3) of the receivers of some rows [m].

        Args:
            rows: of cells.
            ground: 3D map of the ground that they stand on; None: the datum.
        """
        x, y = (each.ravel() for each in np.meshgrid(self.x_m, self.y_m[rows]))
        return self.at_height(x, y, ground)

    def at_height(self, x_m: np.ndarray, y_m: np.ndarray, ground: CityMap | None) -> np.ndarray:
        """Return positions (n, 3) at the receivers' height [m].

        Args:
            x_m: (n,) to the east [m].
            y_m: (n,) to the north [m].
            ground: as of `receivers_m`.
        """
        bottom_m: np.ndarray | float = 0.0
        if ground is not None and self.above_ground:
            on = ground.height_at if ground.terrain is None else ground.ground_height_m
            bottom_m = on(x_m, y_m)
        return np.column_stack([x_m, y_m, np.broadcast_to(bottom_m + self.height_m, x_m.shape)])


def ground_of(city: CityMap) -> CityMap | None:
    """Return the map of the ground alone; None where there is none, or it is flat at the datum."""
    if city.terrain is not None:
        return city.without(~city.terrain)
    ground = Surfaces([(city.vertices, city.faces)]).ground_faces()
    corners_m = city.vertices[city.faces[ground]]
    if not ground.any() or np.abs(corners_m[..., 2]).max() <= GROUND_M:
        return None
    return city.without(~ground)
