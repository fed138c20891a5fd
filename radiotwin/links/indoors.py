"""How probable it is that a receiver is inside a building, where its position is off by metres.

A position inside a wall may be that of a phone on the pavement, and one on the pavement that of a
phone behind the wall. So where positions come from satellites, a line on the map does not decide.
"""

import numpy as np

from radiotwin.scene.citymap import CityMap

POSITION_SD_M = 4.0
"""Of a phone's position, in x and in y: phones are right within 4.9 m under open sky (van Diggelen
and Enge 2015, 'The world's first GPS MOOC and worldwide laboratory using smartphones', ION GNSS+),
and somewhat less so between buildings."""
RINGS, DIRECTIONS = 4, 8  # of equally probable places around a position
SURE = 0.9  # probability from which on a receiver is taken to be inside


def chance_inside(city: CityMap, position_m: np.ndarray,
                  sd_m: float = POSITION_SD_M) -> np.ndarray:
    """Return the probability that ends of links are inside buildings.

    Args:
        city: 3D map.
        position_m: (n, 3) where they are said to be [m].
        sd_m: standard deviation of that in x and in y, normal and independent [m].

    Returns:
        (n,) share of equally probable places that are inside: rings of a normal distribution.
    """
    places_m, own = np.unique(position_m, axis=0, return_inverse=True)
    share = (np.arange(RINGS) + 0.5) / RINGS
    radius_m = sd_m * np.sqrt(-2 * np.log1p(-share))  # quantiles of the Rayleigh distribution
    low = np.flatnonzero(places_m[:, 2] < city.vertices[:, 2].max(initial=-np.inf))
    chance = np.zeros(len(places_m))
    for ring in range(RINGS):
        for turn in (np.arange(DIRECTIONS) + ring / RINGS) * (2 * np.pi / DIRECTIONS):
            shift_m = radius_m[ring] * np.array([np.cos(turn), np.sin(turn), 0.0])
            chance[low] += city.inside(places_m[low] + shift_m)
    return chance[own.ravel()] / (RINGS * DIRECTIONS)
