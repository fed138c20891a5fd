"""Roofs of a map that are higher or lower than it says, where links pass their edges.

Many heights are counted from storeys or guessed. A link that passes a roof's edge loses as behind
two knife edges (ITU-R P.526), but no more than what is left on other paths: the law without line of
sight. The height of each roof with such links is estimated beside all others, with a prior around
the map's; a roof whose uncertainty its links do not halve stays where it is.

The height that predicts best is not yet the roof's: where more gets around buildings than over
them, all roofs seem low, and each by another amount. In 14 campaigns that another hand made, with
exact maps, knife edges and ways around corners, roofs came out 1.2 m too low in the mean and
scattered by 1.1 m. So the offset that all have in common counts as the model's, and the scatter of
the others is part of each roof's uncertainty.
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
END_M = 2.0  # a building closer to an end of a link than this belongs to that end
BOTTOMLESS_M = 1e4  # height of the box in which links are looked for above a building
WALL_SD_M = 1.0  # where an edge is not known better, neither is how high above it a link passes
OFFSETS = np.arange(-16, 17) / 6  # that are tried, in standard deviations of the prior
LEAST_SHARE = 0.2  # of a roof's height that is left
TELLING_DB = 1.0  # least change of a link over the offsets, to be evidence
MIN_LINKS = 8  # that are evidence of a roof
MAX_SD_SHARE = 0.5  # of the prior's that may be left of a roof's uncertainty: one bit is learnt
MIN_OFFSET_M = 0.25  # smaller ones are none
SWEEPS = 3  # over all roofs, each beside the others as they are
MAX_LINKS = 6000  # that are looked at
LEAST_CONTRAST_DB = 3.0  # between links with line of sight and without; less: roofs hide nothing
HIDDEN_DB = 200.0  # loss of a way that something other than a roof blocks
# Standard deviations of what laws of edges are off by, in metres of height: of one roof (worth so
# many roofs whose scatter is seen), and of all roofs together.
MODEL_SD_M, MODEL_ROOFS, COMMON_SD_M = 1.5, 8, 1.5


class RoofCrossings(NamedTuple):
    """How links cross roofs; m pairs of a link and a building, sorted by the link.

    Attributes:
        link: (m,) row of the link.
        building: (m,) as `buildings` numbers them.
        enter_over_m, leave_over_m: (m,) height of the roof above the link, where it enters and
            where it leaves; negative where it passes above.
        before_m, between_m, behind_m: (m,) distance along the ground from the first end to where
            the link enters, from there to where it leaves, and on to the second end.
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
        """Return the loss over each roof alone, by two edges (ITU-R P.526) [dB].

        Args:
            raised_m: (r,), or (…, 1), how much higher the roofs are than on the map [m].
            wavelength_m: of the radio [m].
            rows: r pairs.
        """
        return two_edges_db(self.enter_over_m[rows] + raised_m, self.leave_over_m[rows] + raised_m,
                            self.before_m[rows], self.between_m[rows], self.behind_m[rows],
                            wavelength_m)


def roof_crossings(city: CityMap, a_m: np.ndarray, b_m: np.ndarray,
                   which: np.ndarray | None = None) -> RoofCrossings:
    """Return where links cross buildings that neither of their ends stands on.

    Args:
        city: 3D map.
        a_m: (n, 3) first ends [m].
        b_m: (n, 3) second ends [m].
        which: buildings; None: all of the map.
    """
    label, boxes = buildings(city)[0], _boxes(city)
    found = [np.zeros((7, 0))]
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for building in sorted(boxes) if which is None else which.tolist():
        if building not in boxes:
            continue
        way = cross(boxes[building], a_m, b_m)
        near = np.flatnonzero((way.before_m > END_M) & (way.behind_m > END_M))
        if not len(near):
            continue
        track_m = way.before_m[near] + way.between_m[near] + way.behind_m[near]
        along_m = way.before_m[near, None] + share * way.between_m[near, None]
        points_m = a_m[near, None] + (along_m / track_m[:, None])[..., None] * (
            b_m - a_m)[near, None]
        over_m = _roof_over_m(city, points_m.reshape(-1, 3), label == building)
        over_m = over_m.reshape(along_m.shape)
        is_over = np.isfinite(over_m)
        hit = np.flatnonzero(is_over.any(axis=1))
        first, last = is_over[hit].argmax(axis=1), SAMPLES - 1 - is_over[hit, ::-1].argmax(axis=1)
        enter_m, leave_m = along_m[hit, first], along_m[hit, last]
        found.append(np.array([near[hit], np.full(len(hit), building), over_m[hit, first],
                               over_m[hit, last], enter_m, leave_m - enter_m,
                               track_m[hit] - leave_m]))
    pairs = np.concatenate(found, axis=1)
    pairs = pairs[:, np.argsort(pairs[0], kind="stable")]
    return RoofCrossings(pairs[0].astype(int), pairs[1].astype(int), *pairs[2:])


def _roof_over_m(city: CityMap, points_m: np.ndarray, is_mine: np.ndarray) -> np.ndarray:
    """Return how far some faces (f,) lie above points (n, 3), seen from above; NaN beside them."""
    top_m = float(city.vertices[:, 2].max()) + 1.0
    above_m = np.column_stack([points_m[:, :2], np.full(len(points_m), top_m)])
    distance_m, face, _ = city.first_hits_towards(above_m, DOWN)
    return np.where((face >= 0) & is_mine[face], top_m - distance_m - points_m[:, 2], np.nan)


@lru_cache(maxsize=4)
def _boxes(city: CityMap) -> dict[int, Box]:
    """Return a bottomless box around each building; the ground is none."""
    label = buildings(city)[0]
    low_m, high_m = building_extents_m(city, label)
    middle_m, size_m = 0.5 * (low_m + high_m), high_m - low_m
    found = {}
    for building in np.unique(label[~city.on_ground]).tolist():
        (x_m, y_m, _), (length_m, width_m, _) = (each[building].tolist()
                                                 for each in (middle_m, size_m))
        found[building] = Box(x_m, y_m, length_m, width_m, BOTTOMLESS_M, 0.0)
    return found


class RoofHeights(GainEffect):
    """Roofs that are higher or lower than the map says."""

    name = "roof_heights"
    variant = "roofs that are off by metres"
    figure = "histogram"
    is_declared = True
    needs_map = True
    is_cause = False

    class Params(EffectParams):
        """Roofs whose heights links decide."""

        roofs: tuple[Roof, ...] = Field(description="Roofs, and how much higher they are.")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        if missing := super().unavailable(links):
            return missing
        return None if np.isfinite(links.frequency_hz) else "the frequency is not known"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        rows = subsample(np.arange(len(view.links)), MAX_LINKS)
        contrast_db = _contrast_db(view.links.select(rows), view.level_at)
        if np.median(contrast_db) < LEAST_CONTRAST_DB:
            return []
        roofs = _Search(view, rows, contrast_db).roofs()
        return [self.Params(roofs=roofs)] if roofs else []

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
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
        ways = roof_crossings(city, *ends_m, which)
        rows, link = np.unique(ways.link, return_inverse=True)
        if not len(rows):
            return Term.of_offset(offset_db)
        others = _without(city, tuple(which.tolist()))
        hidden = ~others.line_of_sight(ends_m[0][rows], ends_m[1][rows])
        wavelength_m = speed_of_light / links.frequency_hz
        before_db, after_db = (np.where(hidden, HIDDEN_DB, 0.0) for _ in range(2))
        np.maximum.at(before_db, link, ways.loss_db(0.0, wavelength_m))
        np.maximum.at(after_db, link, ways.loss_db(raised_m[ways.building], wavelength_m))
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
    """Return the roofs whose 90 % interval leaves out the map's height, the most wrong first."""
    return sorted((roof for roof in roofs
                   if abs(roof.true_offset_m) > QUANTILE_90 * roof.offset_sd_m),
                  key=lambda roof: -abs(roof.true_offset_m))


def beside_the_others(roofs: Sequence[Roof]) -> tuple[Roof, ...]:
    """Return roofs with the offset of the others taken for the model's, and their scatter added.

    Args:
        roofs: n roofs; the standard deviation of each is of what its own links leave open.
    """
    off_m, own_sd_m = (np.array([getattr(roof, name) for roof in roofs])
                       for name in ("offset_m", "offset_sd_m"))
    found = []
    for number, roof in enumerate(roofs):
        others_m, sd_m = (np.delete(values, number) for values in (off_m, own_sd_m))
        seen = max(len(others_m) - 1, 0)
        scatter = ((others_m - others_m.mean()) ** 2).sum() if seen else 0.0
        variance = (MODEL_ROOFS * MODEL_SD_M**2 + scatter) / (MODEL_ROOFS + seen)
        weight = 1 / (sd_m**2 + variance)
        common_variance = 1 / (weight.sum() + 1 / COMMON_SD_M**2)
        found.append(roof._replace(
            common_m=float(common_variance * (weight @ others_m)),
            offset_sd_m=float(np.sqrt(roof.offset_sd_m**2 + variance + common_variance))))
    return tuple(found)


class _Search:
    """The likeliest height of each roof, all others as they are.

    Args:
        view: residuals of n links.
        rows: (r,) of which these are looked at.
        contrast_db: (r,) what each would lose without any line of sight [dB].
    """

    def __init__(self, view: ResidualView, rows: np.ndarray, contrast_db: np.ndarray) -> None:
        links = view.links.select(rows)
        assert links.city is not None
        self._view, self._rows, self._contrast_db = view, rows, contrast_db
        self._city, self._wavelength_m = links.city, speed_of_light / links.frequency_hz
        self._ways = roof_crossings(links.city, links.device_m[links.device], links.receiver_m)
        self._loss_db = self._ways.loss_db(0.0, self._wavelength_m)  # (m,) of each roof as it is
        by_roofs = np.zeros(len(rows), dtype=bool)
        over_m = np.maximum(self._ways.enter_over_m, self._ways.leave_over_m)
        by_roofs[self._ways.link[over_m > 0]] = True
        self._hidden_db = np.where(~links.los & ~by_roofs, HIDDEN_DB, 0.0)
        self._before_db = _level_db(self._most_db(self._loss_db), contrast_db)
        step_m = links.receiver_m - links.device_m[links.device]
        self._slope = np.abs(step_m[:, 2]) / np.maximum(np.hypot(*step_m[:, :2].T), 1.0)

    def _most_db(self, loss_db: np.ndarray) -> np.ndarray:
        """Return the greatest of the losses (m,) over roofs of each link (r,) [dB]."""
        most_db = self._hidden_db.copy()
        if len(loss_db):
            link = self._ways.link
            first = np.flatnonzero(np.r_[True, np.diff(link) > 0])
            most_db[link[first]] = np.maximum(most_db[link[first]],
                                              np.maximum.reduceat(loss_db, first))
        return most_db

    def roofs(self) -> tuple[Roof, ...]:
        label, centres_m = buildings(self._city)
        priors_m = building_height_sds_m(self._city)
        tall_m = centres_m[:, 2] - building_extents_m(self._city, label)[0][:, 2]
        pairs = {int(building): np.flatnonzero(self._ways.building == building)
                 for building in np.unique(self._ways.building)}
        found: dict[int, Roof] = {}
        for _ in range(SWEEPS):
            for building, mine in pairs.items():
                offset_m, sd_m = self._estimate(mine, float(tall_m[building]),
                                                float(priors_m[building]))
                self._loss_db[mine] = self._ways.loss_db(offset_m, self._wavelength_m, mine)
                x_m, y_m, height_m = centres_m[building].tolist()
                found[building] = Roof(building, x_m, y_m, height_m, offset_m, sd_m)
        told = [roof for roof in found.values() if roof.offset_m]
        return tuple(roof for roof in beside_the_others(told)
                     if abs(roof.offset_m) >= MIN_OFFSET_M)

    def _estimate(self, mine: np.ndarray, tall_m: float, prior_m: float) -> tuple[float, float]:
        """Return mean and sd of a roof's offset from its pairs (q,) [m]; 0 if undetermined."""
        offsets_m = prior_m * OFFSETS
        offsets_m = offsets_m[offsets_m > (LEAST_SHARE - 1) * tall_m]
        link = self._ways.link[mine]
        without_db = self._loss_db.copy()
        without_db[mine] = 0.0
        others_db = self._most_db(without_db)[link]
        loss_db = self._ways.loss_db(offsets_m[:, None], self._wavelength_m, mine)
        after_db = _level_db(np.maximum(others_db, loss_db), self._contrast_db[link])
        telling = np.ptp(after_db, axis=0) > TELLING_DB
        if telling.sum() < MIN_LINKS:
            return 0.0, prior_m
        change_db = (after_db - self._before_db[link])[:, telling]
        rows = self._rows[link[telling]]
        log = np.array([self._view.gain_nats(rows, each_db).sum() for each_db in change_db])
        log -= 0.5 * (offsets_m / prior_m) ** 2
        if log.argmax() == 0:  # it may not be there at all, which is not for this to say
            return 0.0, prior_m
        share = np.exp(log - log.max())
        share /= share.sum()
        mean_m = float(share @ offsets_m)
        spread_m = np.sqrt(share @ (offsets_m - mean_m) ** 2 + np.diff(offsets_m)[0] ** 2 / 12)
        if spread_m > MAX_SD_SHARE * prior_m:
            return 0.0, prior_m
        slope = float(np.median(self._slope[link[telling]]))
        if log.argmax() == len(log) - 1:  # higher than any that was tried
            spread_m = prior_m
        return mean_m, float(np.hypot(spread_m, WALL_SD_M * slope))


@lru_cache(maxsize=8)
def _without(city: CityMap, which: tuple[int, ...]) -> CityMap:
    """Return the map without some buildings; a map is predicted in many batches over the same."""
    return city.without(np.isin(buildings(city)[0], which))


def _contrast_db(links: Links, level_at: LevelAt) -> np.ndarray:
    """Return what each link (n,) has more with line of sight than without, by the law [dB]."""
    with_it, without = (level_at(links.with_los(np.full(len(links), each)))
                        for each in (True, False))
    return np.maximum(with_it - without, 0.0)


def _level_db(loss_db: np.ndarray, contrast_db: np.ndarray) -> np.ndarray:
    """Return the level (n,) of a way over roofs beside the less that is on others [dB]."""
    return 10 * np.log10(10 ** (-loss_db / 10) + 10 ** (-contrast_db / 10))
