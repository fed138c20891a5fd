"""How wrong a 3D map seems to be, from what measured levels leave of the paths over it.

The whole map may be shifted, its surfaces may reflect and diffract otherwise than declared, and
each wall and each roof may be off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.map_shift import NO_SHIFT, Shift, estimate_shift
from radiotwin.channel.map_sizes import Size, estimate_sizes
from radiotwin.channel.path_levels import MAX_OFFSET_DB, Offsets, fit_offsets, moved
from radiotwin.channel.stored import require_names, require_number
from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry

LINKS = 400  # that are looked at
MIN_LINKS = 60  # fewer say nothing of a map
SEEN_WALL_M, SEEN_HEIGHT_M = 0.5, 1.0  # smaller errors change less than the paths' own error
WARN_WALL_M, WARN_HEIGHT_M = 1.0, 2.0  # errors above which the user is told
WARN_OFFSET_DB = 3.0


@dataclass(frozen=True)
class MapError:
    """Errors of a map: standard deviations with 90 % intervals, and what all of it is off by.

    Attributes:
        wall_m: position of a wall, across it: estimate, low and high end [m].
        height_m: height of a building, likewise [m].
        shift_m: how far the map lies too far east and north, and the radius that holds it to
            90 % [m].
        offsets_db: what reflected, and diffracted, paths carry beside those over the map [dB].
    """

    wall_m: Size = (0.0, 0.0, 0.0)
    height_m: Size = (0.0, 0.0, 0.0)
    shift_m: Shift = NO_SHIFT
    offsets_db: Offsets = (0.0, 0.0)

    @property
    def is_seen(self) -> bool:
        """Whether walls or roofs are so wrong that predictions should allow for it."""
        return self.wall_m[0] >= SEEN_WALL_M or self.height_m[0] >= SEEN_HEIGHT_M

    @property
    def is_shifted(self) -> bool:
        """Whether the whole map is shifted."""
        return self.shift_m != NO_SHIFT

    @property
    def warning(self) -> str:
        """Message about a map that is worse than usual; empty where it is not."""
        east_m, north_m, radius_m = self.shift_m
        reflected_db, diffracted_db = self.offsets_db
        parts = [f"it lies {east_m:+.1f} m east and {north_m:+.1f} m north of where it should "
                 f"(90 %: within {radius_m:.1f} m)"] * self.is_shifted
        sizes = ("walls", self.wall_m, WARN_WALL_M), ("heights", self.height_m, WARN_HEIGHT_M)
        parts += [f"{what} are off by {size:.1f} m (90 %: {low:.1f}-{high:.1f})"
                  for what, (size, low, high), limit_m in sizes if size > limit_m]
        parts += [f"{what} are {abs(offset_db):.1f} dB {'stronger' if offset_db > 0 else 'weaker'} "
                  "than its materials make them"
                  for what, offset_db in (("reflections", reflected_db),
                                          ("diffractions", diffracted_db))
                  if abs(offset_db) > WARN_OFFSET_DB]
        return "; ".join(parts)

    def on_map(self, links: LinkGeometry) -> LinkGeometry:
        """Return links where they are on the map, which may be shifted."""
        if not self.is_shifted:
            return links
        return moved(links, self.shift_m[0], self.shift_m[1])

    def state(self) -> dict[str, list[float]]:
        """Return what JSON can hold, for `from_state`."""
        return {name: list(getattr(self, name)) for name in _BOUNDS}

    @classmethod
    def from_state(cls, state: Any) -> Self:
        """Return what `state` described; raises ValueError where it is none."""
        if not isinstance(state, dict):
            raise ValueError("the map's error is none")
        require_names("map error", state, list(_BOUNDS))
        found = {}
        for name, bounds in _BOUNDS.items():
            if not isinstance(state[name], list) or len(state[name]) != len(bounds):
                raise ValueError(f"{name} is not {len(bounds)} numbers")
            named = {f"{name}[{place}]": value for place, value in enumerate(state[name])}
            found[name] = tuple(require_number(named, key, *ends)
                                for key, ends in zip(named, bounds, strict=True))
        return cls(**found)  # type: ignore[arg-type]  # as many numbers as each has


_BOUNDS = {"wall_m": [(0.0, 100.0)] * 3, "height_m": [(0.0, 100.0)] * 3,
           "shift_m": [(-100.0, 100.0)] * 2 + [(0.0, 200.0)],
           "offsets_db": [(-MAX_OFFSET_DB, MAX_OFFSET_DB)] * 2}


Found = tuple[MapError, tuple[float, float]]
"""Errors of a map, and the power beside its paths, see `ImagePaths`."""


def estimate_map_error(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                       seed: int) -> Found:
    """Estimate the errors of the map that links lie over.

    Args:
        links: n links over a map, to devices whose positions are known.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB], one for all or (n,); None: unknown.
        seed: of the choice of links, and of the maps' errors.

    Returns:
        the errors, zeros where there are too few links to tell, and the diffuse power.
    """
    shift_m = estimate_shift(links, level_db, limit_db, seed)
    links = MapError(shift_m=shift_m).on_map(links)
    error, diffuse = estimate_other_errors(links, level_db, limit_db, seed)
    return replace(error, shift_m=shift_m), diffuse


def estimate_other_errors(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                          seed: int) -> Found:
    """Do as `estimate_map_error` for a map that is not shifted."""
    diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
    limits_db = limits_of(limit_db, len(links))
    known = np.flatnonzero(np.isfinite(level_db) | np.isfinite(limits_db))
    if len(known) < MIN_LINKS:
        return MapError(), diffuse
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(known, min(LINKS, len(known)), replace=False))
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    offsets_db = fit_offsets(links, level_db, limits_db, diffuse)
    sizes = estimate_sizes(links, level_db, limits_db, diffuse, offsets_db, seed)
    return MapError(sizes.wall_m, sizes.height_m, offsets_db=offsets_db), diffuse
