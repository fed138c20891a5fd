"""Levels of paths over a map whose frame, materials or shapes may be other than declared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from radiotwin.channel.class_fit import LinkFit, links_as_one
from radiotwin.channel.followed_paths import interaction_gains
from radiotwin.channel.image_paths import with_diffuse_db
from radiotwin.inference.gaussian import Limit
from radiotwin.links import LinkGeometry

OFFSET_SD_DB = 6.0  # prior of what reflections and diffractions lie above those of the map
MAX_OFFSET_DB = 20.0

Offsets = tuple[float, float]
"""Levels of reflected and of diffracted paths above those of the map [dB]."""


def paths_db(links: LinkGeometry, diffuse: tuple[float, float], offsets_db: Offsets = (0.0, 0.0)
             ) -> np.ndarray:
    """Return the level (n,) [dB] of followed paths and diffuse power.

    Args:
        links: n links over a map.
        diffuse: power beside the paths, see `ImagePaths`.
        offsets_db: see `Offsets`.
    """
    return _level_db(interaction_gains(links), links.distance_m, diffuse, offsets_db)


def moved(links: LinkGeometry, east_m: float, north_m: float) -> LinkGeometry:
    """Return links with both ends moved over their map; their line of sight is its."""
    step_m = np.array([east_m, north_m, 0.0])
    device_m, receiver_m = links.device_m + step_m, links.receiver_m + step_m
    los = links.los if links.city is None else links.city.line_of_sight(device_m, receiver_m)
    return replace(links, device_m=device_m, receiver_m=receiver_m, los=los)


def fit_offsets(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                diffuse: tuple[float, float]) -> Offsets:
    """Return what reflections and diffractions carry beside those over the map [dB].

    The most likely ones under a normal prior of `OFFSET_SD_DB`, which keeps them at 0 where levels
    do not tell the two apart: each class of line of sight has a level of its own.

    Args:
        links: n links over a map.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB], one for all or (n,); None: unknown.
        diffuse: power beside the paths, see `ImagePaths`.
    """
    fit, gains = LinkFit(level_db, limit_db), interaction_gains(links)
    distance_m = links.distance_m
    undisturbed_db = _level_db(gains, distance_m, diffuse, np.zeros(2))
    as_one = links_as_one(links, fit.fit(links.los, undisturbed_db)[1])

    def loss(offsets_db: np.ndarray) -> float:
        inside = np.clip(offsets_db, -MAX_OFFSET_DB, MAX_OFFSET_DB)
        prior = 0.5 * (offsets_db**2).sum() / OFFSET_SD_DB**2
        level_db = _level_db(gains, distance_m, diffuse, inside)
        return fit.fit(links.los, level_db)[0].sum() / as_one + float(prior)

    simplex = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])
    found = minimize(loss, np.zeros(2), method="Nelder-Mead",
                     options={"xatol": 0.1, "fatol": 0.02, "initial_simplex": simplex})
    reflected_db, diffracted_db = np.clip(found.x, -MAX_OFFSET_DB, MAX_OFFSET_DB).tolist()
    return reflected_db, diffracted_db


def _level_db(gains: np.ndarray, distance_m: np.ndarray, diffuse: tuple[float, float],
              offsets_db: Offsets | np.ndarray) -> np.ndarray:
    """Return the level (n,) [dB] of `interaction_gains` (n, 3) and diffuse power."""
    factor = 10 ** (np.array([0.0, *offsets_db]) / 10)
    return with_diffuse_db(gains @ factor, distance_m, *diffuse)
