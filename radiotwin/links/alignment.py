"""Measurements in the frame of a scene: converted where both are known, checked where not."""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter

from radiotwin.errors import BadInput
from radiotwin.geo import is_same_frame, origin_text
from radiotwin.io.forms import MAX_POSITION_M, Origin
from radiotwin.links.checks import SURE, chance_inside, map_corners_m, outside_map
from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.scene.footing import MAX_SDS, WALL_SD_M

MAX_MISPLACED = 0.05  # share of the links inside buildings, or outside the map, that may be right
SEARCHED_M, COARSE_M, FINE_M = 500.0, 10.0, 2.0  # translations that are tried, along each axis
MAX_POINTS = 4_000  # receiver positions that are tried
MAX_CELLS = 4_000_000  # of the grid of what is built; bounds the memory
AROUND_M = 30.0  # standard deviation of the surroundings that a position is compared with
AGREE_M = MAX_SDS * WALL_SD_M  # a translation that errors of a map and of positions explain
MAX_OUTSIDE = 0.5  # share of the receivers off the map, after a translation that the user gives
MIN_CONTRAST = 5.0  # standard deviations, from which a translation is proposed
CLEAR = 2.0  # from which receivers keep clear of buildings


def in_scene_frame(measurements: Measurements, scene: Scene | Path | str,
                   shift_m: tuple[float, float] | None = None) -> Measurements:
    """Return measurements in the frame of a scene.

    Where both say where on the earth they lie, what differs is converted exactly. Where one does
    not, the frames are taken for the same if the receivers fit: few inside buildings, few outside
    the map, or no translation fits better than one within the errors of a map and of positions.

    Args:
        measurements: with or without an origin.
        scene: with or without an origin.
        shift_m: to add to x and y after that [m]; (0, 0) says that the frames are the same.

    Warns:
        Positions were converted, with how far they moved; or many receivers are inside buildings,
        and no translation fits clearly better than none.

    Raises:
        BadInput: the frames cannot be related and the receivers do not fit; with the translation
            that makes them fit best. Or the given translation is impossible, or heights are given
            twice, see `Measurements.on_ground`.
    """
    scene = Scene.of(scene)
    there = scene.config.origin
    related = shift_m is not None or (measurements.origin is not None and there is not None)
    measurements = in_known_frame(measurements, there, "the scene")
    if shift_m is not None:
        if not max(map(abs, shift_m)) <= MAX_POSITION_M:
            raise BadInput(f"a shift by {shift_m[0]:g}, {shift_m[1]:g} m is not possible; allowed "
                           f"are -{MAX_POSITION_M:g} to {MAX_POSITION_M:g} m: give the metres "
                           "from the frame of the measurements to the scene's")
        offset_m = np.array([*shift_m, 0.0])
        measurements = measurements.moved(lambda position_m: position_m + offset_m, there)
    measurements = measurements.on_ground(
        scene.city.ground_height_m if scene.city.terrain is not None else None)
    if not related:
        _require_fit(measurements, scene)
    elif shift_m is not None and any(shift_m):
        _refuse_off_map(measurements, scene, shift_m)
    return measurements


def as_measurements(given: Measurements | pd.DataFrame | Path | str,
                    scene: Scene | None) -> Measurements:
    """Return measurements, also of a file or a data frame, in the frame of a scene.

    Those of a file or a data frame are checked against it, as commands do. `Measurements` are
    converted where both say where on the earth they lie.

    Raises:
        BadInput: they are none of these, as of their reader, or as of `in_scene_frame`.
    """
    if isinstance(given, Measurements):
        return in_known_frame(given, None if scene is None else scene.config.origin, "the scene")
    if isinstance(given, str | os.PathLike):
        given = Measurements.load(Path(given))
    elif isinstance(given, pd.DataFrame):
        given = Measurements(given)
    else:
        raise BadInput(f"measurements are needed, not {type(given).__name__}; pass "
                       "rt.Measurements, a data frame of links, or the path of measurements.csv")
    return given.on_ground(None) if scene is None else in_scene_frame(given, scene)


def in_known_frame(measurements: Measurements, there: Origin | None, what: str) -> Measurements:
    """Return measurements in the frame about an origin; as they are where either is unknown.

    `what` they are used with is for the message.

    Warns:
        Positions were converted, with how far they moved.
    """
    here = measurements.origin
    if here is None or there is None or is_same_frame(here, there):
        return measurements
    converted = measurements.in_frame(there)
    moved_m = np.nanmedian(converted.receiver_m - measurements.receiver_m, axis=0)
    warnings.warn(f"the measurements are in the frame about {origin_text(here)}, {what} in that "
                  f"about {origin_text(there)}: positions are converted (moved by "
                  f"{moved_m[0]:+.1f} m east, "
                  f"{moved_m[1]:+.1f} m north)", stacklevel=3)
    return converted


def _refuse_off_map(measurements: Measurements, scene: Scene,
                    shift_m: tuple[float, float]) -> None:
    """Raise BadInput where a translation takes most receivers off the map."""
    low_m, high_m = map_corners_m(scene)
    outside = outside_map(measurements.receiver_m, scene)
    if len(outside) and outside.mean() > MAX_OUTSIDE:
        raise BadInput(f"the shift by {shift_m[0]:g}, {shift_m[1]:g} m takes {outside.mean():.1%} "
                       f"of the links' receivers off the 3D map, which goes from ({low_m[0]:.0f}, "
                       f"{low_m[1]:.0f}) to ({high_m[0]:.0f}, {high_m[1]:.0f}) m; correct its size "
                       "and its signs (metres east, north)")


def _require_fit(measurements: Measurements, scene: Scene) -> None:
    """Warn where receivers fit badly; raise BadInput where a translation would make them fit."""
    receiver_m = measurements.receiver_m
    receiver_m = receiver_m[np.isfinite(receiver_m).all(axis=1)]
    if not len(receiver_m):
        return
    if len(receiver_m) > MAX_POINTS:
        every = np.linspace(0, len(receiver_m) - 1, MAX_POINTS).astype(int)
        receiver_m = receiver_m[every]
    inside = scene.city.inside(receiver_m).mean()
    outside = outside_map(receiver_m, scene).mean()
    if inside <= MAX_MISPLACED and outside <= MAX_MISPLACED:
        return
    ground = "" if scene.city.terrain is None else " or below the ground"
    odd = (f"{inside:.1%} of the receivers are inside buildings{ground} and {outside:.1%} outside "
           "the 3D map")
    search = search_shift(scene, receiver_m)
    surely = (chance_inside(scene.city, receiver_m) >= SURE).mean()
    if surely <= MAX_MISPLACED and search is not None and search.agrees:
        warnings.warn(f"{odd}. Measurements and scene are taken to be in one frame: {surely:.1%} "
                      "are inside even if positions are off by metres, and no translation fits "
                      "clearly better than none", stacklevel=3)
        return
    proposed = None if search is None else search.proposed
    unknown = [what for what, origin in (("the measurements", measurements.origin),
                                         ("the scene", scene.config.origin)) if origin is None]
    remedy = f"no translation within {SEARCHED_M:g} m makes them fit (feet and degrees are not " \
             "converted)" \
        if proposed is None else \
        f"--shift={proposed[0]:g},{proposed[1]:g} would make them fit best"
    raise BadInput(
        f"measurements and scene are not in one frame: {odd}, and where on the earth x = y = 0 "
        f"lies is not known of {' and of '.join(unknown)}. {remedy}. Better: import with --origin, "
        "and build the scene from a map or with --origin; then positions are converted. If the "
        "frames are the same and receivers are indoors: --shift=0,0")


@dataclass(frozen=True)
class Search:
    """Translations of receivers over a map, by how they keep clear of the buildings.

    A contrast is the number of receivers in buildings less what the density of buildings around
    each of them lets expect, in standard deviations.

    Attributes:
        best_m: x and y of the translation with the least contrast [m].
        best: its contrast.
        near: the least contrast within `AGREE_M` of no translation.
        tried: number of translations.
    """

    best_m: tuple[float, float]
    best: float
    near: float
    tried: int

    @property
    def proposed(self) -> tuple[float, float] | None:
        """The best translation; None where it does not stand out."""
        return self.best_m if self.best <= -MIN_CONTRAST else None

    @property
    def agrees(self) -> bool:
        """Whether receivers keep clear as they are, and the best of many tried does by chance."""
        return self.near <= -CLEAR and (self.best**2 - self.near**2) / 2 < np.log(self.tried)


def search_shift(scene: Scene, receiver_m: np.ndarray) -> Search | None:
    """Search the translation that takes receivers out of buildings and onto the map.

    Receivers follow streets, so at the right place far fewer of them are in buildings than the
    density of buildings around each of them lets expect; over open ground few are anywhere. Of all
    translations on a grid, at the receivers' median height above the ground, that with the largest
    such contrast is taken (28,682 readings of a real drive test, moved by 94 to 316 m: found again
    within 2 m).

    Args:
        scene: the 3D map.
        receiver_m: (n, 3) [m].

    Returns:
        the best translation [m] and its contrast; None where none takes receivers onto the map.
    """
    (low_m, high_m), reach_m = map_corners_m(scene), SEARCHED_M + 2 * COARSE_M
    low_m = np.maximum(low_m, receiver_m[:, :2].min(axis=0) - reach_m)
    high_m = np.minimum(high_m, receiver_m[:, :2].max(axis=0) + reach_m)
    if (low_m >= high_m).any():
        return None
    cell_m = max(FINE_M, float(np.sqrt(np.prod(high_m - low_m) / MAX_CELLS)))
    x_m, y_m = (np.arange(low, high + cell_m, cell_m) for low, high in zip(low_m, high_m))
    grid_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
    above_m = np.median(receiver_m[:, 2] - scene.city.ground_height_m(*receiver_m[:, :2].T))
    height_m = scene.city.ground_height_m(*grid_m.T) + above_m
    built = scene.city.inside(np.column_stack([grid_m, height_m])).reshape(len(x_m), len(y_m))
    expected = gaussian_filter(built.astype(float), AROUND_M / cell_m)

    def contrast(east_m: float, north_m: float) -> float:
        column = np.rint((receiver_m[:, 0] + east_m - x_m[0]) / cell_m).astype(int)
        row = np.rint((receiver_m[:, 1] + north_m - y_m[0]) / cell_m).astype(int)
        on_map = (column >= 0) & (column < len(x_m)) & (row >= 0) & (row < len(y_m))
        cells = column[on_map], row[on_map]
        density = expected[cells]
        excess = built[cells].sum() - density.sum() + (~on_map).sum()
        return float(excess / np.sqrt((density * (1 - density)).sum() + 1.0))

    def least(centre_m: tuple[float, float], around_m: float, step_m: float
              ) -> tuple[float, tuple[float, float]]:
        steps_m = np.arange(-around_m, around_m + step_m, step_m).tolist()
        shifts = [(centre_m[0] + east_m, centre_m[1] + north_m)
                  for east_m in steps_m for north_m in steps_m]
        return min((contrast(*shift_m), shift_m) for shift_m in shifts)

    near, _ = least((0.0, 0.0), AGREE_M, FINE_M)
    _, coarse_m = least((0.0, 0.0), SEARCHED_M, COARSE_M)
    best, best_m = least(coarse_m, 2 * COARSE_M, FINE_M)
    return Search(best_m, best, near, int(2 * SEARCHED_M / COARSE_M + 1) ** 2)
