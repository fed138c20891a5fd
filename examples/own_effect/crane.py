"""A crane that no map shows: it weakens the links that pass through its tower.

A tower of steel lattice, 4 m wide, takes some decibels of what passes through it and hides nothing
behind it; a building would hide all.
"""

from collections.abc import Iterator

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects import EffectParams, Estimate, GainEffect, Parameter, Term
from radiotwin.effects.arrays import ends_above
from radiotwin.effects.base import LevelAt, ResidualView
from radiotwin.effects.boxes import Box, cross
from radiotwin.effects.params import Metres
from radiotwin.effects.patterns import Pattern, lengths_in_boxes
from radiotwin.effects.places import Correction, Mark
from radiotwin.links import Links

WIDE_M, HIGH_M, NEAR_M = 4.0, 60.0, 30.0
PLACES = 25  # along each side of the area, that are tried
MAX_LOSS_DB = 15.0
MIN_NATS = 5.0


class Crane(GainEffect):
    """The tower of a crane; one step finds one."""

    name = "crane"
    figure = "links"
    repeatable = True
    confused_with = ("missing_obstacle", "foliage")
    calibrated_like = "foliage"  # which is found in the same way
    settled_by = "look for it on the site"

    class Params(EffectParams):
        """Where it stands."""

        place_m: tuple[Metres, Metres] = Field(description="x and y of the tower [m].")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        ends_m = np.vstack([view.links.device_m[view.links.device], view.links.receiver_m])[:, :2]
        grid = np.meshgrid(*np.linspace(ends_m.min(axis=0), ends_m.max(axis=0), PLACES).T)
        tried = [self.Params(place_m=place_m)
                 for place_m in zip(*(axis.ravel().tolist() for axis in grid), strict=True)]
        nats = [view.score(self.with_params(each).term(view.links, view.level_at))
                for each in tried]
        best = int(np.argmax(nats))
        return [tried[best]] if nats[best] > MIN_NATS else []

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        inside_m = cross(_tower(self.params), *ends_above(links, self.params.place_m)).inside_m
        return Term.of_columns(-(inside_m > 0).astype(float)[:, None], prior_sd_db=5.0)

    @override
    def reach(self, links: Links) -> np.ndarray:
        around = _tower(self.params)._replace(length_m=2 * NEAR_M, width_m=2 * NEAR_M)
        return cross(around, *ends_above(links, self.params.place_m)).inside_m > 0

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        loss_db = coefficients[0]
        return None if 0 < loss_db < MAX_LOSS_DB else f"a lattice does not take {loss_db:.1f} dB"

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        for inside_m in lengths_in_boxes(view.links, HIGH_M):
            yield Pattern("place", "dB", "of links through a tower", -1.0 * (inside_m > 0),
                          high=MAX_LOSS_DB)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return {"loss_db": Parameter.normal(estimate.coefficients[0], estimate.coefficients_sd[0],
                                            "dB")}

    @override
    def mark(self, links: Links) -> Mark:
        return Mark(self.label, np.array(self.params.place_m), _tower(self.params).outline_m)

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(boxes=(_tower(self.params),))


def _tower(params: Crane.Params) -> Box:
    return Box(*params.place_m, WIDE_M, WIDE_M, HIGH_M, 0.0)
