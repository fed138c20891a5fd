"""`removed_obstacle`: a building of the map that no longer exists.

Links near it have the channel's level over the map without it. Candidates are the buildings behind
which links are stronger than predicted. As mapped roofs are often too high, which also makes links
just below the edge stronger, removal must explain them much better than a lower building.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import city_of, frequent_labels
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.boxes import (
    Box,
    building_height_sds_m,
    buildings,
    links_near,
    obstruction_nats,
)
from radiotwin.effects.params import EffectParams, Estimate, Metres, Parameter
from radiotwin.effects.patterns import MIN_LINKS as MIN_HIDDEN
from radiotwin.effects.patterns import Pattern
from radiotwin.effects.places import Correction, Mark
from radiotwin.errors import BadInput
from radiotwin.links import Links
from radiotwin.scene.citymap import CityMap

MAX_PROPOSALS = 4  # buildings whose removal is computed exactly
MIN_LINKS = 8  # links that a building must hide
RISES_DB = (-4.0, -8.0, -12.0, -16.0, -20.0)  # losses that disappear with the building, negative
LOWER = (5 / 6, 5 / 3)  # trial reductions of its height [standard deviations of mapped heights]
FLAT_M = 0.5  # least height of a lowered building
# Very strong evidence (Kass and Raftery 1995, 'Bayes factors', J. Am. Stat. Assoc. 90, Sec. 3.2).
MIN_LEAD_NATS = 5.0
SAME_M = 1.0  # largest distance between centres of the same building


class RemovedObstacle(GainEffect):
    """One building removed from the map; each search step finds one."""

    name = "removed_obstacle"
    in_words = "a building that is gone"
    acts_on = ("device", "device x receiver", "direction", "place")
    settled_by = "fly low on both sides of the suspected building"
    figure = "links"
    nlos_only = True
    repeatable = True
    needs_map = True
    levels = "exact"
    always_exact = True
    confused_with = ("device_position_error",)

    class Params(EffectParams):
        """A building of the map."""

        building: int = Field(ge=0, description="Index, as `buildings` numbers them.")
        centre_m: tuple[Metres, Metres, Metres] = Field(description="Centre x, y, and height [m].")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the building whose removal explains its links far better than a lower roof."""
        links = view.links
        assert links.city is not None
        rows = np.flatnonzero(~links.los)
        a_m, b_m = links.device_m[links.device[rows]], links.receiver_m[rows]
        nats = obstruction_nats(view.residual_db[rows], view.scale_db[rows], RISES_DB)
        label, centres_m = buildings(links.city)
        total_nats = np.full(len(centres_m), -np.inf)
        for building in np.unique(label[~links.city.on_ground]).tolist():
            behind = ~links.city.without(label != building).line_of_sight(a_m, b_m)
            if behind.sum() >= MIN_LINKS:
                total_nats[building] = nats[behind].sum()
        likely = [int(building) for building in np.argsort(-total_nats)[:MAX_PROPOSALS]
                  if total_nats[building] > 0]
        gains = {building: _gain_nats(view, building, _without(links.city, building)[0])
                 for building in likely}
        for building in sorted(gains, key=gains.__getitem__, reverse=True):
            limit_nats = gains[building] - MIN_LEAD_NATS
            lower_by_m = building_height_sds_m(links.city)[building] * np.array(LOWER)
            if limit_nats > 0 and all(_gain_nats(view, building, _lower(links.city, building, by_m))
                                      < limit_nats for by_m in lower_by_m.tolist()):
                return [self.Params(building=building,
                                    centre_m=tuple(centres_m[building].tolist()))]
        return []

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the change of levels near the building if the map does not have it [dB]."""
        offset_db, with_it = np.zeros(len(links)), city_of(links, self.name)
        city, box = _without(with_it, self.params.building)
        rows = np.flatnonzero(links_near(box, links))
        near_links = links.select(rows)
        offset_db[rows] = level_at(near_links.with_city(city), True) - level_at(near_links, True)
        return Term.of_offset(offset_db)

    @override
    def exactly(self) -> Effect:
        return self

    @override
    def corrected_map(self, city: CityMap) -> CityMap:
        # Found by position, as other effects that remove or add buildings change the indices.
        apart_m = np.linalg.norm(buildings(city)[1] - np.array(self.params.centre_m), axis=1)
        nearest = int(apart_m.argmin())
        return _without(city, nearest)[0] if apart_m[nearest] < SAME_M else city

    @override
    def mark(self, links: Links) -> Mark | None:
        """Return the building's faces to draw on maps; None without a map."""
        city = links.city
        if city is None:
            return None
        faces = city.faces[buildings(city)[0] == self.params.building]
        return Mark("removed building", np.array(self.params.centre_m[:2]),
                    faces_m=city.vertices[faces][..., :2])

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield the rise without one building of median shadow (paths are slow), 1 dB behind it."""
        links = view.links
        assert links.city is not None
        blocker, (_, centres_m) = only_blocker(links), buildings(links.city)
        hiding = sorted(frequent_labels(blocker[blocker >= 0], MIN_HIDDEN),
                        key=lambda building: np.count_nonzero(blocker == building))
        if not hiding:
            return
        building = hiding[len(hiding) // 2]
        gone = self.with_params(self.Params(building=building,
                                            centre_m=tuple(centres_m[building].tolist())))
        rise_db = gone.term(links, view.level_at).offset_db
        mean_db = float(rise_db[blocker == building].mean())
        if mean_db > 0:
            yield Pattern("building", "dB", "of a building of the map, behind it on average",
                          rise_db / mean_db)

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(gone=(self.params.building,))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        params = self.params
        return {name: Parameter(value, value, value, "m")
                for name, value in zip(("x_m", "y_m", "height_m"), params.centre_m, strict=True)}


def _gain_nats(view: ResidualView, building: int, other: CityMap) -> float:
    """Compute the log-likelihood gain if a map that differs in one building were right [nats]."""
    assert view.links.city is not None
    rows = np.flatnonzero(links_near(_without(view.links.city, building)[1], view.links))
    near_links = view.links.select(rows)
    change_db = view.level_at(near_links.with_city(other), True) - view.level_at(near_links, True)
    return float(view.gain_nats(rows, change_db).sum())


def only_blocker(links: Links) -> np.ndarray:
    """Find the building (n,) that alone blocks each link; -1 if none, several or terrain does."""
    assert links.city is not None
    label = buildings(links.city)[0]
    blocker = np.full(len(links), -1)
    rows = np.flatnonzero(~links.los)
    a_m, b_m = links.device_m[links.device[rows]], links.receiver_m[rows]
    near, far = links.city.first_hits(a_m, b_m)[1], links.city.first_hits(b_m, a_m)[1]
    same = (near >= 0) & (far >= 0) & (label[near] == label[far])
    if links.city.terrain is not None:
        same &= ~links.city.terrain[near]
    blocker[rows[same]] = label[near[same]]
    return blocker


@lru_cache(maxsize=32)
def _lower(city: CityMap, building: int, by_m: float) -> CityMap:
    """Lower a building of a map, but not below `FLAT_M` above its base."""
    corners = np.unique(city.faces[buildings(city)[0] == building])
    vertices = city.vertices.copy()
    z_m = vertices[corners, 2]
    vertices[corners, 2] = np.maximum(z_m - by_m, np.minimum(z_m, z_m.min() + FLAT_M))
    return city.with_vertices(vertices)


@lru_cache(maxsize=32)
def _without(city: CityMap, building: int) -> tuple[CityMap, Box]:
    """Remove a building from a map, and return the box around it; BadInput: no such building."""
    label, centres_m = buildings(city)
    if building >= len(centres_m):
        raise BadInput(f"the effect removed_obstacle removes building {building}, but the map has "
                       f"{len(centres_m)}; give the scene that the twin was made with")
    faces = label == building
    corners_m = city.vertices[city.faces[faces]].reshape(-1, 3)
    low_m, high_m = corners_m.min(axis=0), corners_m.max(axis=0)
    (x_m, y_m, _), (length_m, width_m, _) = (low_m + high_m) / 2, high_m - low_m
    return city.without(faces), Box(x_m, y_m, length_m, width_m, high_m[2], 0.0)
