"""`foliage`: a box of vegetation that the map does not show.

Loss over d metres inside: A_m (1 − exp(−γ d / A_m)), saturating (ITU-R P.833-10, Eq. 1), with A_m
up to that of the recommendation at the frequency. It is located by back-projection. If only links
of one device cross it, its distance along them is unknown, and the box gives its direction only.
"""

from collections.abc import Iterator
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, ends_above, ends_above_ground
from radiotwin.effects.base import GainEffect, ResidualView
from radiotwin.effects.boxes import (
    CELL_M,
    ESTIMATED_PLACES,
    HEIGHTS_M,
    Box,
    back_project,
    best_cells,
    cross,
    devices_through,
    is_seen_from_estimated_places,
    obstruction_nats,
)
from radiotwin.effects.losses import UNKNOWN_MAX_LOSS_DB, max_loss_db
from radiotwin.effects.params import Allowed, EffectParams, Estimate, Parameter, Variation
from radiotwin.effects.patterns import WIDE_M, Pattern, lengths_in_boxes
from radiotwin.effects.places import Mark
from radiotwin.links import Links

MAX_CELLS = 3  # proposed cells, each with all `SIDES_M`
SIDES_M = (25.0, 55.0)  # sides of a proposed box
MIN_HEIGHT_M, MAX_PROPOSED_HEIGHT_M = 3.0, 26.0  # height of tree tops
LOSSES_DB = (3.0, 6.0, 9.0, 12.0, 16.0, 20.0)  # loss of a link through it, equally probable
TYPICAL_HEIGHT_M = 10.0  # of a grove whose detectable loss is reported


class VegetationLoss(NamedTuple):
    """Loss as a function of the metres inside, A_m (1 − exp(−γ d / A_m)).

    Attributes:
        specific_db_m: specific attenuation γ [dB/m].
        max_db: greatest loss A_m [dB].
    """

    specific_db_m: Annotated[float, Field(gt=0, le=1000)] = 0.6
    max_db: Annotated[float, Field(ge=1e-6, le=1000)] = 15.0


class Foliage(GainEffect):
    """A box of vegetation; each search step finds one."""

    name = "foliage"
    in_words = "vegetation"
    acts_on = ("device", "device x receiver", "direction", "place")
    settled_by = "fly low on both sides of the suspected place"
    figure = "links"
    repeatable = True
    confused_with = ("missing_obstacle", "excess_attenuation", "device_gain_offset",
                     "antenna_pattern")

    class Params(EffectParams):
        """A grove."""

        box: Box = Field(description="Up to the tree tops.")
        law: VegetationLoss = Field(VegetationLoss(), description="Loss over the metres inside.")
        ceiling_db: float = Field(UNKNOWN_MAX_LOSS_DB, gt=0, le=1000, description=(
            "Greatest loss of vegetation at the frequency [dB]; what costs more is none."))

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose boxes of vegetation where links lack power, at the best ground cells."""
        links = view.links
        nats = obstruction_nats(view.residual_db, view.scale_db, LOSSES_DB) / view.design_effect
        centres_m, total_nats = back_project(*ends_above_ground(links), nats)
        allowed = [i for i, height_m in enumerate(HEIGHTS_M)
                   if MIN_HEIGHT_M <= height_m <= MAX_PROPOSED_HEIGHT_M]
        ceiling_db = max_loss_db(links.frequency_hz)
        law = VegetationLoss(max_db=min(VegetationLoss().max_db, ceiling_db))
        return [self.Params(box=Box(x_m, y_m, side_m, side_m, HEIGHTS_M[allowed[height]], 0.0),
                            law=law, ceiling_db=ceiling_db)
                for (x_m, y_m), height, cell_nats in best_cells(
                    centres_m, total_nats[:, allowed], MAX_CELLS)
                if cell_nats > MIN_NATS for side_m in SIDES_M]

    @override
    def gain_db(self, links: Links) -> np.ndarray:
        crossing = cross(self.params.box, *ends_above(links, self.params.box[:2]))
        specific_db_m, max_db = self.params.law
        return -max_db * (1 - np.exp(-crossing.inside_m * specific_db_m / max_db))

    @override
    def variation(self) -> Variation:
        """Put the box and the logarithms of attenuation and greatest loss into a search vector."""
        x_m, y_m = self.params.box[:2]
        low = [x_m - 80, y_m - 80, 5.0, 5.0, MIN_HEIGHT_M, -90.0, np.log(0.05),
               np.log(min(3.0, self.params.ceiling_db))]
        high = [x_m + 80, y_m + 80, 200.0, 200.0, 30.0, 90.0, np.log(5.0),
                np.log(self.params.ceiling_db)]
        return Variation(
            np.array([*self.params.box, *np.log(self.params.law)]),
            np.array([CELL_M, CELL_M, 12.0, 12.0, 3.0, 20.0, 0.4, 0.3]),
            np.array(low), np.array(high),
            lambda numbers: self.changed(box=Box(*numbers[:6].tolist()),
                                         law=VegetationLoss(*np.exp(numbers[6:]).tolist())))

    @override
    def contradicted(self, links: Links) -> str | None:
        through = devices_through(self.params.box, links)
        return ESTIMATED_PLACES if is_seen_from_estimated_places(through, links) else None

    @override
    def mark(self, links: Links) -> Mark:
        box = self.params.box
        return Mark(f"{self.label}\n{box.height_m:.0f} m high", np.array(box[:2]), box.outline_m)

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield the loss by a grove, 1 dB through its middle, for several places."""
        for inside_m in lengths_in_boxes(view.links, TYPICAL_HEIGHT_M):
            yield Pattern("place", "dB", f"of a grove {WIDE_M:.0f} m wide and "
                          f"{TYPICAL_HEIGHT_M:.0f} m high, through its middle",
                          -np.minimum(inside_m / WIDE_M, 1.0),
                          high=max_loss_db(view.links.frequency_hz))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the box [m, deg], its attenuation [dB/m] and its greatest loss [dB]."""
        variation = self.variation()
        low, high = variation.low.tolist(), variation.high.tolist()
        reported = {name: Parameter.normal(value, sd, "deg" if name == "turn_deg" else "m",
                                           Box.allowed(name, least, most))
                    for name, value, sd, least, most in zip(Box._fields, self.params.box,
                                                            estimate.params_sd, low, high)}
        names = {"specific_attenuation_db_m": "dB/m", "greatest_loss_db": "dB"}
        return reported | {
            name: Parameter.log_normal(value, sd, unit, Allowed(least, most, is_log=True))
            for (name, unit), value, sd, least, most in zip(
                names.items(), self.params.law, estimate.params_sd[6:], np.exp(low[6:]).tolist(),
                np.exp(high[6:]).tolist(), strict=True)}

    @override
    def like(self, other: "Foliage") -> "Foliage":
        return self.changed(box=self.params.box.like(other.params.box))
