"""`missing_obstacle`: a building that the map does not show, as a box.

It is located by back-projecting the loss along the links; then a box is fitted. Behind the box
these powers add: over the two edges of its roof and around both sides (knife edges of ITU-R P.526),
and scattered power with a fitted offset: that of the link's other paths or, if that fits better,
the channel's level without line of sight (a small box hides the straight line only, a large one
most paths). Exact levels are the channel's over the map with the box in it.
"""

from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import product
from typing import TypeVar

import numpy as np
from pydantic import Field
from scipy.constants import speed_of_light
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, city_of, ends_above, ends_above_ground, subsample
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.boxes import (
    ESTIMATED_PLACES,
    HEIGHTS_M,
    NEAR_M,
    Box,
    Crossing,
    back_project,
    best_cells,
    cross,
    devices_through,
    grid_around,
    is_seen_from_estimated_places,
    is_seen_from_one_place,
    knife_edge_db,
    links_near,
    near_box,
    obstruction_nats,
    stands_on,
    two_edges_db,
)
from radiotwin.effects.params import (
    QUANTILE_90,
    Decibels,
    EffectParams,
    Estimate,
    Parameter,
    Variation,
)
from radiotwin.effects.patterns import WIDE_M, Pattern, lengths_in_boxes
from radiotwin.effects.places import Correction, Mark
from radiotwin.links import Links
from radiotwin.scene.citymap import CONCRETE, CityMap

MAX_PROPOSALS = 4
SHIFTS_M = (-8.0, 0.0, 8.0)  # trial shifts from a cell's centre, to the east and to the north
SQUARES_M, RECTANGLES_M = (6.0, 12.0, 24.0), ((20.0, 8.0), (36.0, 12.0), (40.0, 24.0))  # trial
SHAPES = (*product(((side_m, side_m) for side_m in SQUARES_M), (0.0, 45.0)),
          *product(RECTANGLES_M, (-45.0, 0.0, 45.0, 90.0)))  # sides [m] and turn [deg]
SCATTERED_DB = (0.0, -10.0)  # trial values of the relative power in the shadow
MAX_BUILT = 0.15  # largest share of its footprint and margin that is built on the map
AROUND_M = 3.0  # that margin: a box along a wall is an error of the wall, as outlines are off
GRID, MIN_BUILT_M = 9, 2.0  # points along each side of the footprint, and least height of a roof
REACH_M, MAX_LINKS = 30.0, 3000  # shapes are tested on links so near to a cell, so many at most
MARGIN_M = 10.0  # paths of links within NEAR_M plus this are followed at once, for several boxes
TURNS_DEG = (-20.0, 20.0)  # further start values: quick levels determine the turn poorly
LOSSES_DB = (8.0, 12.0, 16.0, 20.0, 25.0, 30.0)  # loss of an obstructed link, equally probable
MAX_LOSS_DB = 50.0  # largest loss behind a box
TYPICAL_HEIGHT_M = 15.0  # of a building whose detectable loss is reported
HEIGHT_SCALE_M = 20.0  # of Rayleigh distributed heights: dense urban, ITU-R P.1410-6, Table 1

T = TypeVar("T")


class MissingObstacle(GainEffect):
    """A box that obstructs links; each search step finds one."""

    name = "missing_obstacle"
    in_words = "a building that the map lacks"
    acts_on = ("device", "device x receiver", "direction", "place")
    settled_by = "fly low on both sides of the suspected place"
    figure = "links"
    needs_frequency = True
    repeatable = True
    always_exact = True
    confused_with = ("foliage", "antenna_pattern", "device_position_error")

    class Params(EffectParams):
        """A box, and the power in its shadow."""

        box: Box = Field(description="In place of the building.")
        scattered_db: Decibels = Field(
            0.0, description="Power in the shadow, relative to the channel without line of sight.")
        by_class: bool = Field(False, description=(
            "Whether the shadow has the level of the class without line of sight, not what is "
            "left on the other paths."))

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose boxes where links with line of sight lack power, at the best ground cells."""
        links = view.links
        rows = np.flatnonzero(links.los)
        if not len(rows):
            return []
        nats = obstruction_nats(view.residual_db[rows], view.scale_db[rows],
                                LOSSES_DB) / view.design_effect
        cells = best_cells(*back_project(*ends_above_ground(links, rows), nats), MAX_PROPOSALS)
        found = [self._best_shape(view, rows, centre_m, height, by_class)
                 for centre_m, height, cell_nats in cells if cell_nats > MIN_NATS
                 for by_class in _shadow_options(links, (False, True))]
        return [params for params in found if params is not None]

    @override
    def kind(self) -> bool:
        return self.params.by_class

    def _best_shape(self, view: ResidualView, los: np.ndarray, centre_m: np.ndarray,
                    height: int, by_class: bool) -> Params | None:
        """Find the box near a cell's centre that explains links with line of sight (`los`) best.

        Shapes, turns, places and heights are tried in turn: a local search from too large a box
        would get stuck. None if all boxes overlap buildings of the map, or boxes found before.
        """
        links, (x_m, y_m) = view.links, centre_m.tolist()
        found = view.found_params(self.name, "box")
        around = Box(x_m, y_m, 2 * REACH_M, 2 * REACH_M, max(HEIGHTS_M), 0.0)
        near = near_box(around, *ends_above_ground(links, los), 0.0)
        rows = subsample(los[near], MAX_LINKS)
        near_links = links.select(rows)

        gains: dict[tuple[Box, float], float] = {}
        scattered_db = _shadow_options(links, SCATTERED_DB)

        def params(box: Box, scattered_db: float) -> MissingObstacle.Params:
            return self.Params(box=box, scattered_db=scattered_db, by_class=by_class)

        def best(boxes: Iterable[Box]) -> Box:
            for box in boxes:
                changes_db = self._offsets_db(near_links, box, scattered_db, by_class,
                                              view.level_at)
                for power_db, change_db in zip(scattered_db, changes_db, strict=True):
                    gains[box, power_db] = float(view.gain_nats(rows, change_db).sum())
            return max(gains, key=gains.__getitem__)[0]

        tops_m = HEIGHTS_M[max(height - 1, 0):height + 2]
        box = best(Box(x_m, y_m, *sides_m, top_m, turn_deg)
                   for (sides_m, turn_deg), top_m in product(SHAPES, tops_m))
        box = best(box._replace(x_m=x_m + east_m, y_m=y_m + north_m, height_m=top_m)
                   for east_m, north_m, top_m in product(SHIFTS_M, SHIFTS_M, tops_m))
        best(Box(box.x_m, box.y_m, *sides_m, box.height_m, turn_deg)
             for sides_m, turn_deg in SHAPES)
        return next((params(*tried) for tried in sorted(gains, key=gains.__getitem__, reverse=True)
                     if built_share(links, tried[0], found) <= MAX_BUILT), None)

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the change of levels by the box [dB]: by new paths, known paths or knife edges."""
        offset_db = np.zeros(len(links))
        if self.is_exact:
            city = city_of(links, self.name)
            rows = np.flatnonzero(links_near(self.params.box, links))
            near_links = links.select(rows)
            with_box = near_links.with_city(_with_box(city, self.params.box))
            offset_db[rows] = level_at(with_box, True) - level_at(near_links, True)
            return Term.of_offset(offset_db)
        if self.levels == "known_paths":
            return Term.of_offset(self._known_paths_db(links, self.params.box, level_at))
        return Term.of_offset(self._offsets_db(links, self.params.box, (self.params.scattered_db,),
                                               self.params.by_class, level_at)[0])

    def _offsets_db(self, links: Links, box: Box, scattered_db: tuple[float, ...],
                    by_class: bool, level_at: LevelAt) -> np.ndarray:
        """Compute by knife edges the gain (k, n) by a box, for k powers in its shadow [dB]."""
        offset_db, rows = np.zeros((len(scattered_db), len(links))), np.flatnonzero(links.los)
        crossing = cross(box, *ends_above(links, box[:2], rows))
        crosses = np.isfinite(crossing.left_m)
        if crosses.any():
            rows = rows[crosses]
            scattered: np.ndarray | float = 0.0
            if links.city is not None:
                shadow_db = self._shadow_db(links, level_at, by_class)[rows]
                scattered = 10 ** (np.minimum(shadow_db + np.array(scattered_db)[:, None], 0) / 10)
            offset_db[:, rows] = _gain_db(Crossing(*(value[crosses] for value in crossing)),
                                          scattered, speed_of_light / links.frequency_hz)
        return offset_db

    def _known_paths_db(self, links: Links, box: Box, level_at: LevelAt) -> np.ndarray:
        """Compute the gain (n,), at most 0, by a box that blocks paths followed without it [dB]."""
        from radiotwin.propagation.laws.followed_paths import KnownPaths, UprightBox

        city, rows = city_of(links, self.name), np.flatnonzero(links_near(box, links))
        known = self.of_links.get(links, "paths", lambda: KnownPaths(links.geometry, city))
        level_db = self.of_links.get(links, (level_at, "levels"),
                                   lambda: np.full(len(links), np.nan))
        if np.isnan(level_db[rows]).any():
            around = links_near(box, links, NEAR_M + MARGIN_M) & np.isnan(level_db)
            level_db[around] = level_at(links.select(around), True)
            known.follow(np.flatnonzero(around))
        top_m = float(city.ground_height_m(*box[:2])) + box.height_m
        upright = UprightBox(box[:2], (box.length_m / 2, box.width_m / 2),
                             float(np.radians(box.turn_deg)), top_m)
        power = known.powers_with_box(upright, rows)
        before = power.direct + power.others
        # Power that the channel adds to that of the paths, such as diffuse power, passes any box.
        rest = np.maximum(10 ** (level_db[rows] / 10) - before, 0.0)
        crossing = cross(box, *ends_above(links, box[:2], rows))
        crosses = np.isfinite(crossing.left_m)
        direct = power.direct.copy()
        direct[crosses] *= 10 ** (_gain_db(Crossing(*(value[crosses] for value in crossing)), 0.0,
                                           speed_of_light / links.frequency_hz) / 10)
        offset_db = np.zeros(len(links))
        share = (direct + power.others_past + rest) / np.maximum(before + rest, 1e-300)
        offset_db[rows] = 10 * np.log10(np.clip(share, 10 ** (-MAX_LOSS_DB / 10), 1.0))
        return offset_db

    @override
    def reach(self, links: Links) -> np.ndarray | None:
        return None if self.levels == "quick" else links_near(self.params.box, links)

    def _shadow_db(self, links: Links, level_at: LevelAt, by_class: bool) -> np.ndarray:
        """Compute the change of level (n,) from losing the line of sight [dB]; cached.

        `by_class`: by the channel's law without sight, else by what other paths leave.
        """
        def shadow_db() -> np.ndarray:
            hidden = links.with_los(np.zeros(len(links), bool))
            return level_at(hidden, not by_class) - level_at(links, not by_class)
        return self.of_links.get(links, (level_at, by_class), shadow_db)

    @override
    def exactly(self) -> Effect:
        # The search continues from here: the turn must not start at its bounds.
        return self.with_params(self.changed(box=self.params.box.straightened(),
                                             by_class=False).params, "exact")

    @override
    def variation(self) -> Variation:
        """Put the box, and with knife edges also its shadow's power, into a search vector."""
        params = self.params
        x_m, y_m = params.box[:2]
        # Paths followed once are nearly as good as paths followed for each trial value, which takes
        # minutes. They contain the scattered power, so the search leaves that power out.
        along_paths = self.levels != "quick"
        varied = self.with_params(params, "known_paths" if along_paths else "quick")
        count = len(params.box) + (not along_paths)

        def with_numbers(numbers: np.ndarray) -> Effect:
            values = [*numbers.tolist(), params.scattered_db][:len(params.box) + 1]
            return varied.changed(box=Box(*values[:-1]), scattered_db=values[-1])

        values = np.array([*params.box, params.scattered_db])[:count]
        turned = [np.array([*box, params.scattered_db])[:count]
                  for box in (params.box.turned_by(turn_deg) for turn_deg in TURNS_DEG)]
        return Variation(
            values, np.array([6.0, 6.0, 8.0, 8.0, 8.0, 20.0, 4.0])[:count],
            np.array([x_m - 60, y_m - 60, 4.0, 4.0, 3.0, -90.0, -20.0])[:count],
            np.array([x_m + 60, y_m + 60, 120.0, 120.0, 250.0, 90.0, 10.0])[:count], with_numbers,
            is_rough=along_paths, starts=turned if along_paths else ())

    @override
    def neg_log_prior(self) -> float:
        # If all links pass below the roof, they only bound its height from below.
        return 0.5 * (self.params.box.height_m / HEIGHT_SCALE_M) ** 2

    @override
    def contradicted(self, links: Links) -> str | None:
        """Return why a building there is impossible or its distance unknown; else None."""
        through = devices_through(self.params.box, links)
        if is_seen_from_estimated_places(through, links):
            return ESTIMATED_PLACES
        if is_seen_from_one_place(through, links):
            return ("it is seen from one place only: how far away it is, and how large, nothing "
                    "tells")
        share = built_share(links, self.params.box)
        if share <= MAX_BUILT:
            return None
        return (f"{share:.0%} of it and of what is around it would be buildings of the map, or "
                "found before: their walls or roofs are off, then, and no other is missing")

    @override
    def corrected_map(self, city: CityMap) -> CityMap:
        return _with_box(city, self.params.box)

    @override
    def mark(self, links: Links) -> Mark:
        box = self.params.box
        return Mark(f"{self.label}\n{box.height_m:.0f} m high", np.array(box[:2]), box.outline_m)

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        for inside_m in lengths_in_boxes(view.links, TYPICAL_HEIGHT_M):
            yield Pattern("place", "dB", f"of a building {WIDE_M:.0f} m wide and "
                          f"{TYPICAL_HEIGHT_M:.0f} m high, behind it", -1.0 * (inside_m > 0),
                          high=MAX_LOSS_DB)

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(boxes=(self.params.box,))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the box [m, deg] and the power in its shadow [dB], with 90 % intervals."""
        variation = self.variation()
        reach = variation.values + QUANTILE_90 * estimate.sides_sd * np.array([[-1.0], [1.0]])
        units = {"turn_deg": "deg", "scattered_db": "dB"}
        return {name: Parameter(float(value), float(low), float(high), units.get(name, "m"),
                                allowed=Box.allowed(name, float(least), float(most)))
                for name, value, low, high, least, most in zip(
                    (*Box._fields, "scattered_db")[:len(variation.values)], variation.values,
                    *reach, variation.low, variation.high, strict=True)}

    @override
    def like(self, other: "MissingObstacle") -> Effect:
        return self.changed(box=self.params.box.like(other.params.box))


def _shadow_options(links: Links, options: tuple[T, ...]) -> tuple[T, ...]:
    """Return the trial options of a shadow; without a map, which would predict it, the first."""
    return options if links.city is not None else options[:1]


def _gain_db(crossing: Crossing, scattered: np.ndarray | float,
             wavelength_m: float) -> np.ndarray:
    """Compute by knife edges the gain of n links that cross a box, 0 to -`MAX_LOSS_DB` [dB].

    `scattered` is the power in the shadow relative to the link without the box, (n,) or (k, n).
    """
    over_db = two_edges_db(crossing.enter_over_m, crossing.leave_over_m, crossing.before_m,
                           crossing.between_m, crossing.behind_m, wavelength_m)
    first_m = crossing.before_m + crossing.between_m / 2
    second_m = crossing.behind_m + crossing.between_m / 2
    power = scattered
    for side_m in (crossing.left_m, crossing.right_m):
        power = power + 10 ** (-knife_edge_db(side_m, first_m, second_m, wavelength_m) / 10)
    # For a link above the roof, power around the sides and scattered power are not added.
    below_roof = np.maximum(crossing.enter_over_m, crossing.leave_over_m) > 0
    power = np.where(below_roof, power, 0.0) + 10 ** (-over_db / 10)
    return np.maximum(10 * np.log10(np.minimum(power, 1.0)), -MAX_LOSS_DB)


def built_share(links: Links, box: Box, found: Iterable[Box] = ()) -> float:
    """Compute the share of a box's footprint and margin covered by buildings or boxes `found`."""
    x_m, y_m = grid_around(box, AROUND_M, GRID)
    built = np.zeros(x_m.shape, dtype=bool)
    if links.city is not None:
        built = links.city.height_at(x_m, y_m) - links.city.ground_height_m(x_m, y_m) > MIN_BUILT_M
    for other in found:
        built |= stands_on(other, x_m, y_m)
    return float(built.mean())


@lru_cache(maxsize=32)
def _with_box(city: CityMap, box: Box) -> CityMap:
    """Add a concrete box to a map; its height counts from the ground below its centre."""
    import trimesh  # slow to load, and needed for exact levels only

    pose = trimesh.transformations.rotation_matrix(np.radians(box.turn_deg), (0, 0, 1))
    base_m = float(city.ground_height_m(box.x_m, box.y_m))
    depth_m = 0.0 if city.terrain is None else max(box.length_m, box.width_m)  # into a slope
    pose[:3, 3] = box.x_m, box.y_m, base_m + 0.5 * (box.height_m - depth_m)
    mesh = trimesh.creation.box((box.length_m, box.width_m, box.height_m + depth_m), pose)
    count = len(mesh.faces)
    material = np.concatenate([city.material, np.full(count, len(city.materials))])
    terrain, height_sd_m = (
        None if of_faces is None else np.concatenate([of_faces, np.full(count, new)])
        for of_faces, new in ((city.terrain, False), (city.height_sd_m, np.nan)))
    return CityMap(np.vstack([city.vertices, mesh.vertices]),
                   np.vstack([city.faces, mesh.faces + len(city.vertices)]),
                   (*city.materials, CONCRETE), material, city.vegetation, terrain, height_sd_m)
