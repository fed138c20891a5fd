"""Choice of extent, altitudes, devices and UAVs for a city that declares none."""

from dataclasses import dataclass
from itertools import cycle

import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from radiotwin.errors import BadInput
from radiotwin.io.forms import MAX_COORDINATE_M
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import (
    ANTENNA_HEIGHT_M,
    DeviceConfig,
    Extent,
    LatticeConfig,
    UavConfig,
)
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.surfaces import Surfaces

_DEVICE_CLEARANCE_M = 10.0  # free ground around a device [m]
_UAV_CLEARANCE_M = 2.0  # free air beside the start of a UAV [m]
_MAX_CELLS = 2_000_000  # of a `BuiltGrid`: bounds its memory
_MAX_ASPECT = 10_000  # of an extent, length over width


@dataclass(frozen=True, eq=False)
class BuiltGrid:
    """Map of the extent's cells that are under a building.

    Attributes:
        x_m, y_m: (nx,), (ny,) centres of cells [m].
        built: (ny, nx) bool, whether a building covers the centre.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    built: np.ndarray

    @classmethod
    def over(cls, extent: Extent, buildings: CityMap | None) -> "BuiltGrid":
        """Find which cells of an extent are under a building, on a grid of 1 m cells.

        Cells are smaller in an extent below 50 m, and larger where 1 m would need over 2 million.
        `buildings` is a map without ground; None: there are no buildings.

        Raises:
            BadInput: The extent is too narrow for its length.
        """
        x_min, x_max, y_min, y_max = extent.bounds
        width, depth = x_max - x_min, y_max - y_min
        if max(width, depth) > _MAX_ASPECT * min(width, depth):
            raise BadInput(f"an extent of {width:g} x {depth:g} m is but a line; its longer side "
                           f"may be {_MAX_ASPECT:,} times the other: widen it")
        cell_m = max(min(1.0, width / 50, depth / 50), np.sqrt(width * depth / _MAX_CELLS))
        x_m = np.arange(x_min + cell_m / 2, x_max, cell_m)
        y_m = np.arange(y_min + cell_m / 2, y_max, cell_m)
        if buildings is None:
            return cls(x_m, y_m, np.zeros((len(y_m), len(x_m)), dtype=bool))
        x, y = np.meshgrid(x_m, y_m)
        z = buildings.vertices[:, 2]
        above = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z.max() + 1.0)])
        below = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z.min() - 1.0)])
        return cls(x_m, y_m, ~buildings.line_of_sight(above, below).reshape(x.shape))

    @property
    def cell_m(self) -> float:
        """Side of a cell [m]."""
        return float(self.x_m[1] - self.x_m[0])

    @property
    def fraction(self) -> float:
        """Share of the extent's area under buildings."""
        return float(self.built.mean())

    def clearance_m(self) -> np.ndarray:
        """Return the (ny, nx) distance to the nearest building or border of the extent [m]."""
        return distance_transform_edt(np.pad(~self.built, 1))[1:-1, 1:-1] * self.cell_m

    def density(self) -> np.ndarray:
        """Return the (ny, nx) built share of 200 m squares around cells; none beyond the extent."""
        return uniform_filter(self.built.astype(np.float32), size=int(200.0 / self.cell_m),
                              mode="constant")


def building_bounds(surfaces: Surfaces, solid: np.ndarray) -> tuple[float, float, float, float]:
    """Return the horizontal bounding box of the buildings, x_min, x_max, y_min, y_max [m].

    `solid`, (f,) bool, are the faces of buildings. If there are none, or their box is narrower than
    a tenth of its length, the whole city's box is taken. A box that is still narrower than that is
    widened.
    """
    box = np.zeros((2, 2))
    for faces in (solid, np.ones_like(solid)):
        if faces.any():
            corners = surfaces.vertices[surfaces.faces[faces]].reshape(-1, 3)
            box = np.array([corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)])
            if np.ptp(box, axis=0).min() >= 0.1 * np.ptp(box, axis=0).max():
                break
    half = np.maximum(np.ptp(box, axis=0), 0.1 * np.ptp(box, axis=0).max()) / 2
    (x, y), (half_x, half_y) = box.mean(axis=0), half
    return float(x - half_x), float(x + half_x), float(y - half_y), float(y + half_y)


def building_tops(surfaces: Surfaces, solid: np.ndarray, ground: CityMap | None
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return the height (shapes,) of each building's top above the datum, and above the ground [m].

    The ground is taken below the centroid of the shape, from a map without buildings (None: at 0).
    A shape of which no face is True in `solid`, (f,) bool, is no building, and has 0.
    """
    _, high = surfaces.face_bounds()
    tops_m = np.zeros(surfaces.shapes)
    np.maximum.at(tops_m, surfaces.shape[solid], high[solid, 2])
    weight = surfaces.areas * solid
    area = np.maximum(np.bincount(surfaces.shape, weight, surfaces.shapes), 1e-12)
    x_m, y_m = (np.bincount(surfaces.shape, weight * surfaces.centres[:, axis], surfaces.shapes)
                / area for axis in (0, 1))
    ground_m = np.zeros(surfaces.shapes) if ground is None else _height_m(ground, x_m, y_m)
    return tops_m, np.where(tops_m > 0, np.maximum(tops_m - ground_m, 0.0), 0.0)


def _height_m(ground: CityMap, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the heights (n,) of a terrain, or of a city model's ground, at x and y (n,) [m]."""
    height_m = ground.height_at if ground.terrain is None else ground.ground_height_m
    return height_m(x_m, y_m)


def choose_extent(bounds: tuple[float, float, float, float]) -> Extent:
    """Round bounds (x_min, x_max, y_min, y_max) [m] outwards to whole steps of the lattice."""
    step_m = choose_step(bounds)
    x_min, x_max, y_min, y_max = bounds
    return make_extent((np.floor(x_min / step_m) * step_m, np.ceil(x_max / step_m) * step_m,
                        np.floor(y_min / step_m) * step_m, np.ceil(y_max / step_m) * step_m))


def make_extent(bounds: tuple[float, float, float, float]) -> Extent:
    """Return the extent x_min, x_max, y_min, y_max [m]; BadInput if too far from the origin."""
    x_min, x_max, y_min, y_max = bounds
    if not max(map(abs, bounds)) <= MAX_COORDINATE_M:
        raise BadInput(f"an extent of x {x_min:g} to {x_max:g} m, y {y_min:g} to {y_max:g} m is "
                       f"not possible; at most {MAX_COORDINATE_M:g} m from the origin are allowed: "
                       "choose a part with --bbox, or correct --scale")
    return Extent(x_min_m=x_min, x_max_m=x_max, y_min_m=y_min, y_max_m=y_max)


def choose_step(bounds: tuple[float, float, float, float]) -> float:
    """Return the largest step of 20, 10, 5, 2, 1, … m that fits five times into each side."""
    x_min, x_max, y_min, y_max = bounds
    for exponent in range(1, -6, -1):
        for digit in (2, 1, 0.5):
            if min(x_max - x_min, y_max - y_min) >= 5 * digit * 10.0**exponent:
                return float(f"{digit * 10.0**exponent:g}")
    return 1e-6


def choose_altitudes(heights_m: np.ndarray) -> list[float]:
    """Return three altitudes, 5 m apart, from 10 m above 95 % of the roofs (n,), at least 30 [m].

    So low, streets beside tall buildings have no line of sight, and few lattice positions lie
    inside a building.
    """
    top_m = float(np.percentile(heights_m, 95)) if len(heights_m) else 0.0
    lowest_m = max(30.0, 5.0 * np.ceil((top_m + 10.0) / 5.0))
    return [lowest_m, lowest_m + 5.0, lowest_m + 10.0]


def place_devices(count: int, grid: BuiltGrid, ground: CityMap | None, rng: np.random.Generator
                  ) -> list[DeviceConfig]:
    """Place devices on free ground, 10 m clear of buildings; three, or 30 %, are anchors.

    Anchors (devices of known position) are chosen far apart. Positions are drawn at random, more
    often where more around them is built, and accepted if they are far enough from those before;
    that distance shrinks until all have room. `ground` is a map without buildings; None: flat.

    Raises:
        BadInput: There is not enough free ground.
    """
    if count == 0:
        return []
    rows, columns = np.nonzero(grid.clearance_m() >= _DEVICE_CLEARANCE_M)
    if len(rows) < count:
        raise BadInput(f"{count} devices were asked for, but there is not enough ground "
                       f"{_DEVICE_CLEARANCE_M:g} m clear of buildings; ask for fewer, or declare "
                       "them in scene.toml")
    free = np.column_stack([grid.x_m[columns], grid.y_m[rows]])
    weight = grid.density()[rows, columns] + 0.01
    apart_m = 0.7 * np.sqrt(grid.built.size / count) * grid.cell_m
    chosen, placed = np.empty((count, 2)), 0
    while placed < count:
        drawn = rng.choice(len(free), min(len(free), 1000), replace=False, p=weight / weight.sum())
        for point in free[drawn]:
            if (np.hypot(*(point - chosen[:placed]).T) >= apart_m).all():
                chosen[placed] = point
                placed += 1
                if placed == count:
                    break
        apart_m *= 0.8
    positions = np.round(chosen, 1)
    ground_m = np.zeros(count) if ground is None else _height_m(ground, *positions.T)
    anchors = _spread_out(positions, min(count, max(3, round(0.3 * count))))
    return [DeviceConfig(device=f"device{number + 1:02d}", x_m=float(x), y_m=float(y),
                         z_m=round(float(base_m) + ANTENNA_HEIGHT_M, 2),
                         role="anchor" if number in anchors else "unknown")
            for number, ((x, y), base_m) in enumerate(zip(positions, ground_m))]


def _spread_out(positions: np.ndarray, count: int) -> set[int]:
    """Return the indices of `count` positions (n, 2) that lie far apart.

    The first is the nearest to the middle; each further one is the farthest from all chosen so far.
    """
    chosen = [int(np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmin())]
    gaps = np.linalg.norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(gaps.argmax()))
        np.minimum(gaps, np.linalg.norm(positions - positions[chosen[-1]], axis=1), out=gaps)
    return set(chosen)


def place_uavs(count: int, extent: Extent, lattice: LatticeConfig, buildings: CityMap | None,
               ground: CityMap | None = None) -> list[UavConfig]:
    """Place UAVs at the free lattice positions nearest to the middle, an altitude for each in turn.

    They end where they start. The battery allows as many moves as 80 % of the lattice steps along
    two sides of the extent, at least 20.

    Args:
        count: Number of UAVs.
        extent: Extent of the lattice.
        lattice: Step and altitudes.
        buildings: Map without ground; None: there are no buildings.
        ground: Map without buildings that altitudes count from; None: they count from the datum.

    Raises:
        BadInput: None of the 10,000 nearest lattice positions is free at an altitude.
    """
    x_min, x_max, y_min, y_max = extent.bounds
    positions = Lattice.over(*extent.bounds, lattice.step_m, lattice.altitudes_m)
    x, y = np.meshgrid(positions.x_m, positions.y_m)
    distance_m = np.hypot(x - (x_min + x_max) / 2, y - (y_min + y_max) / 2)
    nearest = np.argsort(distance_m.ravel(), kind="stable")[:10_000]
    battery = max(20.0, float(round(0.8 * sum(x.shape))))
    offsets_m = _UAV_CLEARANCE_M * np.array(
        [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    places: dict[float, tuple[float, float]] = {}
    for altitude_m in lattice.altitudes_m[:count]:
        points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, altitude_m)])[nearest]
        if ground is not None:
            points[:, 2] += ground.ground_height_m(*points[:, :2].T)
        free = np.ones(len(points), dtype=bool)
        if buildings is not None:
            for offset_m in offsets_m:
                free &= ~buildings.inside(points + offset_m)
        if not free.any():
            raise BadInput(f"at {altitude_m:g} m every lattice position is inside a building; "
                           "choose higher altitudes")
        x_m, y_m, _ = (float(value) for value in points[free.argmax()])
        places[altitude_m] = x_m, y_m
    uavs = []
    for number, altitude_m in zip(range(count), cycle(lattice.altitudes_m)):
        x_m, y_m = places[altitude_m]
        uavs.append(UavConfig(uav=f"uav{number + 1}", altitude_m=altitude_m, start_x_m=x_m,
                              start_y_m=y_m, terminal_x_m=x_m, terminal_y_m=y_m, battery=battery))
    return uavs
