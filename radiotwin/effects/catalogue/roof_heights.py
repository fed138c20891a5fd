"""`roof_heights`: roofs higher or lower than mapped, estimated from links that pass their edges.

Many mapped heights are counted from storeys or guessed. A link over a roof has the diffraction loss
of two knife edges (ITU-R P.526), bounded by the power of other paths: the channel law without line
of sight. The height of each roof with such links is estimated, the others fixed, with a prior about
the mapped height; a roof whose uncertainty its links do not halve keeps its height.

The height that predicts best is biased: if more power gets around buildings than over them, all
roofs seem low, each by another amount. In 14 campaigns by another generator, with exact maps, knife
edges and paths around corners, roofs came out 1.2 m too low on average, with a scatter of 1.1 m. So
the offset common to all roofs counts as an error of the model, and the scatter of the others is
part of each roof's uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy.constants import speed_of_light
from typing_extensions import override

from radiotwin.effects.arrays import city_of, subsample
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.boxes import (
    Box,
    building_extents_m,
    building_height_sds_m,
    buildings,
    cross,
    two_edges_db,
)
from radiotwin.effects.params import QUANTILE_90, EffectParams, Estimate, Parameter
from radiotwin.effects.places import Correction, Roof
from radiotwin.errors import BadInput
from radiotwin.links import Links
from radiotwin.scene.citymap import DOWN, CityMap

SAMPLES = 24  # points of a link over the box around a building
END_M = 2.0  # a building closer to an end of a link belongs to that end
BOTTOMLESS_M = 1e4  # height of the box in which links over a building are searched
WALL_SD_M = 1.0  # position error of an edge; times the slope of the link an error of its height
OFFSETS = np.arange(-16, 17) / 6  # trial offsets [standard deviations of the prior]
LEAST_SHARE = 0.2  # least height of a roof over the mapped height
INFORMATIVE_DB = 1.0  # least change of a link over the trial offsets
MIN_LINKS = 8  # informative links of a roof
MAX_SD_SHARE = 0.5  # largest posterior over prior sd of an estimated roof: one bit
MIN_OFFSET_M = 0.25  # smaller offsets are dropped
SWEEPS = 3  # passes over all roofs
MAX_LINKS = 6000  # drawn at random for the estimate
LEAST_CONTRAST_DB = 3.0  # median of level with minus without sight, below which nothing is hidden
HIDDEN_DB = 200.0  # loss of the straight line if terrain or another obstacle blocks it
# Prior sd of the model error in metres of height: of one roof (counting as `MODEL_ROOFS` observed
# roofs), and of the offset common to all roofs.
MODEL_SD_M, MODEL_ROOFS, COMMON_SD_M = 1.5, 8, 1.5


class RoofCrossings(NamedTuple):
    """Geometry of m crossings of a link over a building, sorted by link; (m,) each.

    Attributes:
        link: row of the link.
        building: index from `buildings`.
        enter_over_m, leave_over_m: height of the roof above the link at entry and at exit;
            negative if the link passes above.
        before_m, between_m, behind_m: ground distances from the first end to the entry, from entry
            to exit, and from the exit to the second end.
    """

    link: np.ndarray
    building: np.ndarray
    enter_over_m: np.ndarray
    leave_over_m: np.ndarray
    before_m: np.ndarray
    between_m: np.ndarray
    behind_m: np.ndarray

    def loss_db(self, raised_m: np.ndarray | float, wavelength_m: float,
                rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Compute the loss over each roof by two knife edges (ITU-R P.526) [dB].

        Args:
            raised_m: (r,), or (…, 1), true minus mapped height of the roofs [m].
            wavelength_m: wavelength [m].
            rows: r crossings.
        """
        return two_edges_db(self.enter_over_m[rows] + raised_m, self.leave_over_m[rows] + raised_m,
                            self.before_m[rows], self.between_m[rows], self.behind_m[rows],
                            wavelength_m)


def roof_crossings(city: CityMap, a_m: np.ndarray, b_m: np.ndarray,
                   which: np.ndarray | None = None) -> RoofCrossings:
    """Find where links cross buildings, except a building at one of the link's ends.

    Args:
        city: 3D map.
        a_m: (n, 3) first ends [m].
        b_m: (n, 3) second ends [m].
        which: indices of buildings; None: all.
    """
    label, boxes = buildings(city)[0], _boxes(city)
    found = [np.zeros((7, 0))]
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for building in sorted(boxes) if which is None else which.tolist():
        if building not in boxes:
            continue
        crossing = cross(boxes[building], a_m, b_m)
        rows = np.flatnonzero((crossing.before_m > END_M) & (crossing.behind_m > END_M))
        if not len(rows):
            continue
        before_m, between_m = crossing.before_m[rows], crossing.between_m[rows]
        track_m = before_m + between_m + crossing.behind_m[rows]
        along_m = before_m[:, None] + share * between_m[:, None]
        points_m = a_m[rows, None] + (along_m / track_m[:, None])[..., None] * (
            b_m - a_m)[rows, None]
        over_m = _roof_over_m(city, points_m.reshape(-1, 3), label == building)
        over_m = over_m.reshape(along_m.shape)
        is_over = np.isfinite(over_m)
        hit = np.flatnonzero(is_over.any(axis=1))
        first, last = is_over[hit].argmax(axis=1), SAMPLES - 1 - is_over[hit, ::-1].argmax(axis=1)
        enter_m, leave_m = along_m[hit, first], along_m[hit, last]
        found.append(np.array([rows[hit], np.full(len(hit), building), over_m[hit, first],
                               over_m[hit, last], enter_m, leave_m - enter_m,
                               track_m[hit] - leave_m]))
    pairs = np.concatenate(found, axis=1)
    pairs = pairs[:, np.argsort(pairs[0], kind="stable")]
    return RoofCrossings(pairs[0].astype(int), pairs[1].astype(int), *pairs[2:])


def _roof_over_m(city: CityMap, points_m: np.ndarray, of_building: np.ndarray) -> np.ndarray:
    """Compute how far (n,) a building's roof is above points [m]; NaN where there is no roof."""
    top_m = float(city.vertices[:, 2].max()) + 1.0
    above_m = np.column_stack([points_m[:, :2], np.full(len(points_m), top_m)])
    distance_m, face, _ = city.first_hits_towards(above_m, DOWN)
    return np.where((face >= 0) & of_building[face], top_m - distance_m - points_m[:, 2], np.nan)


@lru_cache(maxsize=4)
def _boxes(city: CityMap) -> dict[int, Box]:
    """Return building -> box around it, so high that links above it cross it; not the ground."""
    label = buildings(city)[0]
    low_m, high_m = building_extents_m(city, label)
    middle_m, size_m = 0.5 * (low_m + high_m), high_m - low_m
    found = {}
    for building in np.unique(label[~city.on_ground]).tolist():
        (x_m, y_m, _), (length_m, width_m, _) = (values_m[building].tolist()
                                                 for values_m in (middle_m, size_m))
        found[building] = Box(x_m, y_m, length_m, width_m, BOTTOMLESS_M, 0.0)
    return found


class RoofHeights(GainEffect):
    """Height offsets of mapped roofs."""

    name = "roof_heights"
    variant = "roofs that are off by metres"
    figure = "histogram"
    is_declared = True
    needs_map = True
    needs_frequency = True
    is_cause = False

    class Params(EffectParams):
        """Roofs whose heights links decide."""

        roofs: tuple[Roof, ...] = Field(description="Roofs, and how much higher they are.")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose true minus mapped heights of the roofs that links determine."""
        rows = subsample(np.arange(len(view.links)), MAX_LINKS)
        contrast_db = _contrast_db(view.links.select(rows), view.level_at)
        if np.median(contrast_db) < LEAST_CONTRAST_DB:
            return []
        roofs = _Search(view, rows, contrast_db).roofs()
        return [self.Params(roofs=roofs)] if roofs else []

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the change of levels [dB] if roofs have their estimated heights."""
        city, offset_db = city_of(links, self.name), np.zeros(len(links))
        count = len(buildings(city)[1])
        raised_m = np.zeros(count)
        for roof in self.params.roofs:
            if not 0 <= roof.building < count:
                raise BadInput(f"the effect {self.name} has a roof of building {roof.building}, "
                               f"but the map has {count}; give the scene that the twin was made "
                               "with")
            raised_m[roof.building] = roof.offset_m
        which = np.flatnonzero(raised_m)
        ends_m = links.device_m[links.device], links.receiver_m
        crossings = roof_crossings(city, *ends_m, which)
        rows, link = np.unique(crossings.link, return_inverse=True)
        if not len(rows):
            return Term.of_offset(offset_db)
        rest_of_city = _without(city, tuple(which.tolist()))
        hidden = ~rest_of_city.line_of_sight(ends_m[0][rows], ends_m[1][rows])
        wavelength_m = speed_of_light / links.frequency_hz
        before_db, after_db = (np.where(hidden, HIDDEN_DB, 0.0) for _ in range(2))
        np.maximum.at(before_db, link, crossings.loss_db(0.0, wavelength_m))
        np.maximum.at(after_db, link, crossings.loss_db(raised_m[crossings.building],
                                                        wavelength_m))
        contrast_db = _contrast_db(links.select(rows), level_at)
        offset_db[rows] = _level_db(after_db, contrast_db) - _level_db(before_db, contrast_db)
        return Term.of_offset(offset_db)

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(roofs=tuple(surely_off(self.params.roofs)))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return {f"true_minus_mapped_height_m[{roof.x_m:.0f}, {roof.y_m:.0f}]":
                Parameter.normal(roof.true_offset_m, roof.offset_sd_m, "m")
                for roof in surely_off(self.params.roofs)}


def surely_off(roofs: Sequence[Roof]) -> list[Roof]:
    """List the roofs whose 90 % interval excludes the mapped height, largest offset first."""
    return sorted((roof for roof in roofs
                   if abs(roof.true_offset_m) > QUANTILE_90 * roof.offset_sd_m),
                  key=lambda roof: -abs(roof.true_offset_m))


def with_model_error(roofs: Sequence[Roof]) -> tuple[Roof, ...]:
    """Add the error of the model to each roof's uncertainty, estimated from all other roofs.

    Sets `common_m` to the common offset of the others, and adds their scatter and the uncertainty
    of that offset to `offset_sd_m`, in copies.

    Args:
        roofs: n roofs with the standard deviations from their own links.
    """
    offset_m, link_sd_m = (np.array([getattr(roof, name) for roof in roofs])
                           for name in ("offset_m", "offset_sd_m"))
    found = []
    for number, roof in enumerate(roofs):
        others_m, sd_m = (np.delete(values, number) for values in (offset_m, link_sd_m))
        freedom = max(len(others_m) - 1, 0)
        scatter = ((others_m - others_m.mean()) ** 2).sum() if freedom else 0.0
        variance = (MODEL_ROOFS * MODEL_SD_M**2 + scatter) / (MODEL_ROOFS + freedom)
        weight = 1 / (sd_m**2 + variance)
        common_variance = 1 / (weight.sum() + 1 / COMMON_SD_M**2)
        found.append(roof._replace(
            common_m=float(common_variance * (weight @ others_m)),
            offset_sd_m=float(np.sqrt(roof.offset_sd_m**2 + variance + common_variance))))
    return tuple(found)


class _Search:
    """Coordinate-wise estimate of the roof offsets, from rows (r,) of the links."""

    def __init__(self, view: ResidualView, rows: np.ndarray, contrast_db: np.ndarray) -> None:
        links = view.links.select(rows)
        assert links.city is not None
        self._view, self._rows, self._contrast_db = view, rows, contrast_db
        self._city, self._wavelength_m = links.city, speed_of_light / links.frequency_hz
        self._crossings = roof_crossings(links.city, links.device_m[links.device],
                                         links.receiver_m)
        self._loss_db = self._crossings.loss_db(0.0, self._wavelength_m)  # (m,), updated by sweeps
        by_roofs = np.zeros(len(rows), dtype=bool)
        over_m = np.maximum(self._crossings.enter_over_m, self._crossings.leave_over_m)
        by_roofs[self._crossings.link[over_m > 0]] = True
        self._hidden_db = np.where(~links.los & ~by_roofs, HIDDEN_DB, 0.0)
        self._before_db = _level_db(self._most_db(self._loss_db), contrast_db)
        step_m = links.receiver_m - links.device_m[links.device]
        self._slope = np.abs(step_m[:, 2]) / np.maximum(np.hypot(*step_m[:, :2].T), 1.0)

    def _most_db(self, loss_db: np.ndarray) -> np.ndarray:
        """Compute the greatest loss (r,) on each link, from the losses of its roofs (m,) [dB]."""
        most_db = self._hidden_db.copy()
        if len(loss_db):
            link = self._crossings.link
            first = np.flatnonzero(np.r_[True, np.diff(link) > 0])
            most_db[link[first]] = np.maximum(most_db[link[first]],
                                              np.maximum.reduceat(loss_db, first))
        return most_db

    def roofs(self) -> tuple[Roof, ...]:
        """Estimate roofs' height errors, each with the others fixed; without small, unsure ones."""
        label, centres_m = buildings(self._city)
        priors_m = building_height_sds_m(self._city)
        heights_m = centres_m[:, 2] - building_extents_m(self._city, label)[0][:, 2]
        crossings_of = {int(building): np.flatnonzero(self._crossings.building == building)
                        for building in np.unique(self._crossings.building)}
        found: dict[int, Roof] = {}
        for _ in range(SWEEPS):
            for building, crossings in crossings_of.items():
                offset_m, sd_m = self._estimate(crossings, float(heights_m[building]),
                                                float(priors_m[building]))
                self._loss_db[crossings] = self._crossings.loss_db(offset_m, self._wavelength_m,
                                                                   crossings)
                x_m, y_m, height_m = centres_m[building].tolist()
                found[building] = Roof(building, x_m, y_m, height_m, offset_m, sd_m)
        determined = [roof for roof in found.values() if roof.offset_m]
        return tuple(roof for roof in with_model_error(determined)
                     if abs(roof.offset_m) >= MIN_OFFSET_M)

    def _estimate(self, crossings: np.ndarray, height_m: float,
                  prior_sd_m: float) -> tuple[float, float]:
        """Estimate a roof's true minus mapped height and its sd [m]; 0 if its links cannot tell."""
        offsets_m = prior_sd_m * OFFSETS
        offsets_m = offsets_m[offsets_m > (LEAST_SHARE - 1) * height_m]
        link = self._crossings.link[crossings]
        without_db = self._loss_db.copy()
        without_db[crossings] = 0.0
        others_db = self._most_db(without_db)[link]
        loss_db = self._crossings.loss_db(offsets_m[:, None], self._wavelength_m, crossings)
        after_db = _level_db(np.maximum(others_db, loss_db), self._contrast_db[link])
        informative = np.ptp(after_db, axis=0) > INFORMATIVE_DB
        if informative.sum() < MIN_LINKS:
            return 0.0, prior_sd_m
        changes_db = (after_db - self._before_db[link])[:, informative]
        rows = self._rows[link[informative]]
        log = np.array([self._view.gain_nats(rows, change_db).sum() for change_db in changes_db])
        log -= 0.5 * (offsets_m / prior_sd_m) ** 2
        if log.argmax() == 0:  # lowest trial: gone? `removed_obstacle` decides
            return 0.0, prior_sd_m
        share = np.exp(log - log.max())
        share /= share.sum()
        mean_m = float(share @ offsets_m)
        spread_m = np.sqrt(share @ (offsets_m - mean_m) ** 2 + np.diff(offsets_m)[0] ** 2 / 12)
        if spread_m > MAX_SD_SHARE * prior_sd_m:
            return 0.0, prior_sd_m
        slope = float(np.median(self._slope[link[informative]]))
        if log.argmax() == len(log) - 1:  # highest trial offset: the true one may be higher
            spread_m = prior_sd_m
        return mean_m, float(np.hypot(spread_m, WALL_SD_M * slope))


@lru_cache(maxsize=8)
def _without(city: CityMap, which: tuple[int, ...]) -> CityMap:
    """Remove buildings from a map; cached, as a map is predicted in many batches."""
    return city.without(np.isin(buildings(city)[0], which))


def _contrast_db(links: Links, level_at: LevelAt) -> np.ndarray:
    """Compute the level (n,) with minus without line of sight by the law, at least 0 [dB]."""
    with_los, without = (level_at(links.with_los(np.full(len(links), is_los)))
                         for is_los in (True, False))
    return np.maximum(with_los - without, 0.0)


def _level_db(loss_db: np.ndarray, contrast_db: np.ndarray) -> np.ndarray:
    """Add the powers over roofs and on other paths, given as losses from line of sight [dB]."""
    return 10 * np.log10(10 ** (-loss_db / 10) + 10 ** (-contrast_db / 10))
