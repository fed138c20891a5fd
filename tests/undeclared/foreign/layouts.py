"""Sixteen cities of eight layouts, as plans of prisms; half of them calibrate, half judge.

No layout is drawn as the cities in `scenes/` or those of `tests.undeclared.cities`. A city's plan
holds every building that ever stood there; what stands and what a map shows is a world's business.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from tests.undeclared.shapes import Building, corners_of, fits, turned

LAYOUTS = ("perimeter", "campus", "highrise", "suburb", "industrial", "village", "slabs", "centre")
SPLITS = ("calibrate", "judge")
ROOM_M = 7.5  # between two buildings: walls that a survey misplaced never touch
GROUND = "asphalt_concrete"


@dataclass(frozen=True, eq=False)
class City:
    """The plan of a city.

    Attributes:
        number: 0 to 15; layouts repeat after eight.
        side_m: of the square that it fills, from the origin [m].
        buildings: all that ever stood there.
    """

    number: int
    side_m: float
    buildings: tuple[Building, ...]

    @property
    def split(self) -> str:
        """`calibrate` or `judge`: each layout has a city in either."""
        return SPLITS[(self.number + self.number // len(LAYOUTS)) % 2]


CITIES = 2 * len(LAYOUTS)


@cache
def city(number: int) -> City:
    """Draw a city; the same for the same number."""
    layout = LAYOUTS[number % len(LAYOUTS)]
    rng = np.random.default_rng([number, 2024])
    side_m = float(rng.uniform(*{"suburb": (250, 300), "village": (260, 320)}.get(layout, (300, 400))))
    most = int(rng.integers(30, 71))
    footprints: list[np.ndarray] = []
    buildings: list[Building] = []
    for corners, height_m, material in globals()[f"_{layout}"](side_m, rng):
        inside = corners.min() > 4 and corners.max() < side_m - 4
        if len(buildings) < most and inside and fits(corners, footprints, ROOM_M):
            footprints.append(corners)
            buildings.append(Building(corners.round(2), round(float(height_m), 1), str(material)))
    return City(number, round(side_m, 1), tuple(buildings))


Drawn = Iterator[tuple[np.ndarray, float, str]]


def _box(length_m: float, width_m: float, at: tuple | np.ndarray, turn_rad: float = 0.0) -> np.ndarray:
    half = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length_m / 2, width_m / 2)
    return turned(half, turn_rad) + at


def _perimeter(side_m: float, rng: np.random.Generator) -> Drawn:
    """Courtyards closed by four wings each, of about one height, with broken corners."""
    turn, block_m, street_m = rng.uniform(0, 0.5), rng.uniform(72, 90), rng.uniform(16, 24)
    deep_m = rng.uniform(11, 14)
    for i in np.arange(-4, 5):
        for j in np.arange(-4, 5):
            middle = turned(np.array([(i, j)]) * (block_m + street_m), turn)[0] + side_m / 2
            eaves_m = rng.uniform(15, 24)
            if rng.random() < 0.1:  # a square
                continue
            for wing in range(4):
                long_m = block_m - (0 if wing % 2 else 2 * (deep_m + ROOM_M + 0.2))
                out = turned(np.array([(0, block_m / 2 - deep_m / 2)]), wing * np.pi / 2 + turn)[0]
                yield (_box(long_m, deep_m, middle + out, wing * np.pi / 2 + turn),
                       eaves_m + rng.normal(0, 1.5), rng.choice(["brick", "concrete", "marble"], p=[.5, .4, .1]))


def _campus(side_m: float, rng: np.random.Generator) -> Drawn:
    """Lecture halls, slabs and Ls on lawns, in three directions."""
    directions = rng.uniform(0, np.pi, 3)
    for _ in range(400):
        kind = rng.choice(["box", "ell", "pentagon"], p=[0.45, 0.4, 0.15])
        corners = corners_of(kind, rng.uniform(25, 70), rng.uniform(14, 40), rng)
        yield (turned(corners, rng.choice(directions)) + rng.uniform(0, side_m, 2), rng.uniform(7, 26),
               rng.choice(["concrete", "glass", "brick"]))


def _highrise(side_m: float, rng: np.random.Generator) -> Drawn:
    """Towers on a loose grid, each with low neighbours."""
    step_m = rng.uniform(48, 60)
    for x in np.arange(24, side_m, step_m):
        for y in np.arange(24, side_m, step_m):
            at = np.array([x, y]) + rng.uniform(-6, 6, 2)
            length_m, width_m = rng.uniform(18, 30, 2)
            yield (_box(length_m, width_m, at, rng.normal(0, 0.15)),
                   rng.choice([rng.uniform(45, 120), rng.uniform(12, 35)], p=[0.55, 0.45]),
                   rng.choice(["glass", "concrete"], p=[0.6, 0.4]))


def _suburb(side_m: float, rng: np.random.Generator) -> Drawn:
    """Small detached houses along bent roads."""
    for row, y in enumerate(np.arange(16, side_m, 33.0)):
        x = rng.uniform(8, 20)
        while x < side_m - 10:
            bend_m = 9 * np.sin(2 * np.pi * x / 210 + row)
            yield (_box(rng.uniform(9, 16), rng.uniform(8, 12), (x, y + bend_m + rng.uniform(-2, 2)),
                        rng.normal(0, 0.25)), rng.uniform(5, 10), rng.choice(["brick", "wood", "plasterboard"]))
            x += rng.uniform(19, 30)


def _industrial(side_m: float, rng: np.random.Generator) -> Drawn:
    """Large sheds of metal, a few offices, silos."""
    for _ in range(700):
        large = rng.random() < 0.5
        length_m, width_m = rng.uniform(30, 85, 2) if large else rng.uniform(9, 20, 2)
        yield (_box(length_m, width_m, rng.uniform(0, side_m, 2), rng.choice([0.1, 0.1 + np.pi / 2])),
               rng.uniform(8, 14) if large else rng.uniform(5, 32),
               rng.choice(["metal", "concrete"], p=[0.6, 0.4]) if large else "concrete")


def _village(side_m: float, rng: np.random.Generator) -> Drawn:
    """Farmsteads and houses around a bent main street and a church."""
    yield _box(34, 15, (side_m / 2 + 24, side_m / 2), 0.4), 17.0, "brick"
    yield _box(8, 8, (side_m / 2 - 6, side_m / 2 - 13), 0.4), 41.0, "brick"
    for _ in range(700):
        along = rng.uniform(0, side_m)
        aside = rng.normal(0, 55)
        at = (along, side_m / 2 + 45 * np.sin(along / 70) + aside + 14 * np.sign(aside))
        corners = corners_of(rng.choice(["box", "ell"]), rng.uniform(12, 30), rng.uniform(9, 16), rng)
        yield turned(corners, rng.uniform(0, np.pi)) + at, rng.uniform(5, 13), rng.choice(["brick", "wood"], p=[.7, .3])


def _slabs(side_m: float, rng: np.random.Generator) -> Drawn:
    """Parallel slabs of a housing estate, some turned across, of few heights."""
    turn = rng.uniform(0.1, 0.9)
    for row in np.arange(-9, 10):
        at = rng.uniform(-40, 0) - side_m
        while at < side_m:
            long_m = rng.choice([36.0, 54.0, 72.0])
            middle = turned(np.array([(at + long_m / 2, row * 36.0)]), turn)[0] + side_m / 2
            across = rng.random() < 0.15
            length_m, width_m = (12.0, 30.0) if across else (long_m, 12.5)
            yield (_box(length_m, width_m, middle, turn),
                   rng.choice([12.0, 15.0, 30.0], p=[0.4, 0.4, 0.2]) + rng.normal(0, 0.3), "concrete")
            at += long_m + rng.uniform(14, 34)


def _centre(side_m: float, rng: np.random.Generator) -> Drawn:
    """A tight downtown: lots of all sizes on streets that fan out, heights from a wide law."""
    for radius_m in np.arange(34, side_m, 40.0):
        number = max(3, int(2 * np.pi * radius_m / rng.uniform(40, 58)))
        for k in range(number):
            angle = 2 * np.pi * (k + rng.uniform(-0.1, 0.1)) / number
            at = np.array([np.cos(angle), np.sin(angle)]) * radius_m + side_m / 2
            yield (_box(rng.uniform(17, 27), rng.uniform(20, 34), at, angle),
                   np.clip(rng.lognormal(np.log(19), 0.5), 7, 75), rng.choice(["concrete", "glass", "brick"]))
