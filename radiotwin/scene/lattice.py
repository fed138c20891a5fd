"""The lattice: regular positions that UAVs fly on and radio maps are computed at."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import POSITIONS


def check_lattice(x_min_m: float, x_max_m: float, y_min_m: float, y_max_m: float, step_m: float,
                  altitudes_m: Sequence[float]) -> None:
    """Raise BadInput if a lattice would have too many positions; arguments as `Lattice.over`."""
    width_m, depth_m = x_max_m - x_min_m, y_max_m - y_min_m
    count = (width_m / step_m + 1) * (depth_m / step_m + 1) * len(altitudes_m)
    if not count <= POSITIONS.limit:
        POSITIONS.refuse(
            f"lattice.step_m = {step_m:g} over an extent of {width_m:g} x {depth_m:g} m and "
            f"{len(altitudes_m)} altitudes", f"{count:.3g} positions")


def positions(low_m: float, high_m: float, step_m: float) -> int:
    """Return the number of lattice positions along one axis, from `low_m` on [m]."""
    return int(np.floor((high_m - low_m) / step_m + 1e-9)) + 1


@dataclass(frozen=True, eq=False)
class Lattice:
    """Positions at regular x, y and altitudes in the scene's frame.

    Attributes:
        x_m: (nx,) east coordinates, ascending [m].
        y_m: (ny,) north coordinates, ascending [m].
        z_m: (nz,) altitudes, ascending [m]: above the datum, or above the ground if `ground_m` is
            given.
        ground_m: (ny, nx) height of the ground above the datum [m]; None: altitudes are above the
            datum.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    z_m: np.ndarray
    ground_m: np.ndarray | None = None

    @classmethod
    def over(cls, x_min_m: float, x_max_m: float, y_min_m: float, y_max_m: float, step_m: float,
             altitudes_m: Sequence[float]) -> "Lattice":
        """Make the lattice of an extent, from its south-west corner.

        Args:
            x_min_m: West border [m].
            x_max_m: East border, included where the step fits [m].
            y_min_m: South border [m].
            y_max_m: North border, included where the step fits [m].
            step_m: Horizontal distance of neighbours [m].
            altitudes_m: Altitudes in any order [m].

        Raises:
            BadInput: Too many positions.
        """
        check_lattice(x_min_m, x_max_m, y_min_m, y_max_m, step_m, altitudes_m)
        nx, ny = positions(x_min_m, x_max_m, step_m), positions(y_min_m, y_max_m, step_m)
        return cls(x_min_m + step_m * np.arange(nx), y_min_m + step_m * np.arange(ny),
                   np.array(sorted(altitudes_m), dtype=float))

    def part(self, z: slice, y: slice, x: slice) -> "Lattice":
        """Return the lattice of a range of altitudes, rows and columns."""
        ground_m = None if self.ground_m is None else self.ground_m[y, x]
        return Lattice(self.x_m[x], self.y_m[y], self.z_m[z], ground_m)

    def equals(self, other: "Lattice") -> bool:
        """Return whether another lattice has the same positions, but for rounding."""
        axes = ((self.x_m, other.x_m), (self.y_m, other.y_m), (self.z_m, other.z_m))
        if any(a_m.shape != b_m.shape or not np.allclose(a_m, b_m) for a_m, b_m in axes):
            return False
        ground_m, other_ground_m = (0.0 if lattice.ground_m is None else lattice.ground_m
                                    for lattice in (self, other))
        return bool(np.allclose(ground_m, other_ground_m))

    @property
    def above(self) -> str:
        """Reference of the altitudes: `ground` or `datum`."""
        return "datum" if self.ground_m is None else "ground"

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of positions along z, y and x."""
        return len(self.z_m), len(self.y_m), len(self.x_m)

    @property
    def step_m(self) -> float:
        """Distance of neighbours [m]; 0 for a single position."""
        axis = self.x_m if len(self.x_m) > 1 else self.y_m
        return float(axis[1] - axis[0]) if len(axis) > 1 else 0.0

    @cached_property
    def positions_m(self) -> np.ndarray:
        """(nz * ny * nx, 3) positions, in the order of a (z, y, x) array [m]."""
        z, y, x = np.meshgrid(self.z_m, self.y_m, self.x_m, indexing="ij")
        if self.ground_m is not None:
            z = z + self.ground_m
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)

    def index_of(self, positions_m: np.ndarray) -> np.ndarray:
        """Return the flat (z, y, x) index (n,) of positions (n, 3) [m] that lie on the lattice.

        Raises:
            BadInput: A position is more than 1 cm off the lattice.
        """
        index: list[np.ndarray] = []
        for axis, values in zip((0, 1, 2), (self.x_m, self.y_m, self.z_m)):
            given = positions_m[:, axis]
            if axis == 2 and self.ground_m is not None:
                given = given - self.ground_m[index[1], index[0]]
            after = np.searchsorted(values, given).clip(1, max(len(values) - 1, 1))
            before = after - 1
            after = np.minimum(after, len(values) - 1)
            nearest = np.where(np.abs(given - values[before]) <= np.abs(values[after] - given),
                               before, after)
            off = ~(np.abs(values[nearest] - given) <= 0.01)
            if off.any():
                position = positions_m[np.flatnonzero(off)[0]]
                raise BadInput(
                    f"position {tuple(position)} m is not on the lattice (axis {'xyz'[axis]}: "
                    f"{values[0]:g} to {values[-1]:g} m, {len(values)} values)")
            index.append(nearest)
        return np.ravel_multi_index(tuple(index[::-1]), self.shape)
