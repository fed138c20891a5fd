"""Convert measurements to the frame of a scene, or check that they are in it already."""

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
from radiotwin.links.checks import (
    SURE,
    chance_inside,
    map_corners_m,
    outside_map,
    require_on_map,
)
from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.scene.footing import MAX_SDS, WALL_SD_M

MAX_MISPLACED = 0.05  # largest plausible share of receivers inside buildings, or off the map
SEARCHED_M, COARSE_M, FINE_M = 500.0, 10.0, 2.0  # range and steps of the search, along x and y
MAX_POINTS = 4_000  # receiver positions in the search; bounds the time
MAX_CELLS = 4_000_000  # of the grid of building density; bounds the memory
DENSITY_SD_M = 30.0  # Gaussian smoothing of the building density
TOLERANCE_M = MAX_SDS * WALL_SD_M  # offset that errors of the map and of positions explain
MIN_CONTRAST = 5.0  # standard deviations; a translation with less is not proposed
MIN_CONTRAST_UNMOVED = 2.0  # standard deviations; receivers with more avoid buildings as they are


def in_scene_frame(measurements: Measurements, scene: Scene | Path | str,
                   shift_m: tuple[float, float] | None = None) -> Measurements:
    """Return measurements in the local frame of a scene.

    If both have an origin, positions are converted exactly. If one has none, the frames are assumed
    to be the same, provided that the receivers fit the map: few are inside buildings and few off
    the map, or few surely inside, and no translation of the receivers fits clearly better.

    Args:
        measurements: with or without an origin.
        scene: with or without an origin.
        shift_m: east and north translation [m] that is added after the conversion; (0, 0) states
            that the frames are the same, and skips the check.

    Warns:
        Positions were converted, with how far they moved; or many receivers are inside buildings,
        and no translation fits clearly better than none.

    Raises:
        BadInput: an origin is missing and the receivers do not fit the map (the message proposes
            the best translation); the given translation is impossible; or a height is given twice,
            see `Measurements.on_ground`.
    """
    scene = Scene.of(scene)
    scene_origin = scene.config.origin
    related = shift_m is not None or None not in (measurements.origin, scene_origin)
    measurements = in_known_frame(measurements, scene_origin, "the scene")
    if shift_m is not None:
        if not max(map(abs, shift_m)) <= MAX_POSITION_M:
            raise BadInput(f"a shift by {shift_m[0]:g}, {shift_m[1]:g} m is not possible; allowed "
                           f"are -{MAX_POSITION_M:g} to {MAX_POSITION_M:g} m: give the metres "
                           "from the frame of the measurements to the scene's")
        offset_m = np.array([*shift_m, 0.0])
        measurements = measurements.moved(lambda position_m: position_m + offset_m, scene_origin)
    measurements = _above_datum(measurements, scene)
    if not related:
        _require_fit(measurements, scene)
    elif shift_m is not None and any(shift_m):
        require_on_map(measurements.receiver_m, scene,
                       f"the shift by {shift_m[0]:g}, {shift_m[1]:g} m takes them there; correct "
                       "its size and its signs (metres east, north)")
    return measurements


def as_measurements(given: Measurements | pd.DataFrame | Path | str,
                    scene: Scene | None) -> Measurements:
    """Return measurements in the frame of a scene, from an object, a file or a data frame.

    A file or data frame goes through `in_scene_frame`; a `Measurements` object is moved to the
    scene's origin, but it is not checked whether it fits the map. BadInput if it is none of these.
    """
    if isinstance(given, Measurements):
        given = in_known_frame(given, None if scene is None else scene.config.origin, "the scene")
        return _above_datum(given, scene)
    if isinstance(given, str | os.PathLike):
        given = Measurements.load(Path(given))
    elif isinstance(given, pd.DataFrame):
        given = Measurements(given)
    else:
        raise BadInput(f"measurements are needed, not {type(given).__name__}; pass "
                       "rt.Measurements, a data frame of links, or the path of measurements.csv")
    return _above_datum(given, None) if scene is None else in_scene_frame(given, scene)


def _above_datum(measurements: Measurements, scene: Scene | None) -> Measurements:
    """Convert heights above the ground to heights above the datum; flat ground without terrain."""
    if scene is None or scene.city.terrain is None:
        return measurements.on_ground(None)
    return measurements.on_ground(scene.city.ground_height_m)


def in_known_frame(measurements: Measurements, origin: Origin | None, owner: str) -> Measurements:
    """Convert measurements to the frame about an origin, if both origins are known and differ.

    A warning says how far they moved (median), and that the frame belongs to `owner`.
    """
    old = measurements.origin
    if old is None or origin is None or is_same_frame(old, origin):
        return measurements
    converted = measurements.in_frame(origin)
    moved_m = np.nanmedian(converted.receiver_m - measurements.receiver_m, axis=0)
    warnings.warn(f"the measurements count x and y from {origin_text(old)}, {owner} from "
                  f"{origin_text(origin)}: positions are converted (moved by {moved_m[0]:+.1f} m "
                  f"east, {moved_m[1]:+.1f} m north)", stacklevel=3)
    return converted


def _require_fit(measurements: Measurements, scene: Scene) -> None:
    """Check that most receivers are outside the buildings and on the map of a scene.

    At most a share `MAX_MISPLACED` may be inside (or below ground), or off the map. More are warned
    of if few are surely inside (positions off by metres) and no translation fits clearly better;
    else BadInput, with the best translation.
    """
    receiver_m = measurements.receiver_m
    receiver_m = receiver_m[np.isfinite(receiver_m).all(axis=1)]
    if not len(receiver_m):
        return
    if len(receiver_m) > MAX_POINTS:
        receiver_m = receiver_m[np.linspace(0, len(receiver_m) - 1, MAX_POINTS).astype(int)]
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
class ShiftSearch:
    """Result of a search over translations of the receivers.

    The contrast of a translation is the number of receivers inside buildings or off the map minus
    the number inside by the local building density, in standard deviations: negative in streets.

    Attributes:
        best_m: east and north translation with the lowest contrast [m].
        best_contrast: of that translation.
        unmoved_contrast: lowest contrast of translations up to `TOLERANCE_M`.
        tried: number of translations in the coarse grid.
    """

    best_m: tuple[float, float]
    best_contrast: float
    unmoved_contrast: float
    tried: int

    @property
    def proposed(self) -> tuple[float, float] | None:
        """The best translation [m]; None if its contrast may be chance."""
        return self.best_m if self.best_contrast <= -MIN_CONTRAST else None

    @property
    def agrees(self) -> bool:
        """Whether receivers avoid buildings as they are, and the best translation is no better."""
        gain_nats = (self.best_contrast**2 - self.unmoved_contrast**2) / 2
        return self.unmoved_contrast <= -MIN_CONTRAST_UNMOVED and gain_nats < np.log(self.tried)


def search_shift(scene: Scene, receiver_m: np.ndarray) -> ShiftSearch | None:
    """Search the translation that moves receivers (n, 3) [m] out of buildings and onto the map.

    The lowest contrast wins, see `ShiftSearch`, on a grid of translations at the receivers' median
    height above the ground; None if none moves them onto the map. 28,682 readings of a real drive
    test, moved by 94 to 316 m, were moved back within 2 m.
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
    expected = gaussian_filter(built.astype(float), DENSITY_SD_M / cell_m)

    def contrast(east_m: float, north_m: float) -> float:
        """Return the contrast of a translation, see `ShiftSearch`."""
        column = np.rint((receiver_m[:, 0] + east_m - x_m[0]) / cell_m).astype(int)
        row = np.rint((receiver_m[:, 1] + north_m - y_m[0]) / cell_m).astype(int)
        on_map = (column >= 0) & (column < len(x_m)) & (row >= 0) & (row < len(y_m))
        cells = column[on_map], row[on_map]
        density = expected[cells]
        excess = built[cells].sum() - density.sum() + (~on_map).sum()
        return float(excess / np.sqrt((density * (1 - density)).sum() + 1.0))

    def lowest(centre_m: tuple[float, float], reach_m: float, step_m: float
               ) -> tuple[float, tuple[float, float]]:
        """Return the lowest contrast on a grid of translations, and its translation [m]."""
        steps_m = np.arange(-reach_m, reach_m + step_m, step_m).tolist()
        shifts = [(centre_m[0] + east_m, centre_m[1] + north_m)
                  for east_m in steps_m for north_m in steps_m]
        return min((contrast(*shift_m), shift_m) for shift_m in shifts)

    unmoved, _ = lowest((0.0, 0.0), TOLERANCE_M, FINE_M)
    _, coarse_m = lowest((0.0, 0.0), SEARCHED_M, COARSE_M)
    best, best_m = lowest(coarse_m, 2 * COARSE_M, FINE_M)
    return ShiftSearch(best_m, best, unmoved, int(2 * SEARCHED_M / COARSE_M + 1) ** 2)
