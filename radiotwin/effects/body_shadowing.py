"""The receiver's body is in the way: loss depends on the direction in the body frame only.

First harmonic of the loss over the direction of arrival. Airframe shadowing is described by Khawaja
et al., 'A survey of air-to-ground propagation channel modeling for unmanned aerial vehicles', IEEE
COMST 21(3), 2019.
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels
from radiotwin.effects.base import GainEffect, Term
from radiotwin.effects.params import EffectParams, Estimate, Parameter, ReceiverIndex, Unique
from radiotwin.effects.residual_view import LevelAt, ResidualView
from radiotwin.effects.tilted_dipole import TiltedDipole
from radiotwin.links import LinkData

MIN_LINKS = 100  # of a receiver, with a heading
PRIOR_SD_DB = 8.0  # of each of the two amplitudes


class BodyShadowing(GainEffect):
    """Receivers that lose more on one side."""

    name = "body_shadowing"
    figure = "pattern"
    of_receiver = True
    confused_with = ("antenna_pattern",)

    class Params(EffectParams):
        """Receivers whose bodies shadow."""

        members: Unique[ReceiverIndex] = Field(description="Indices of the receivers.")

    @override
    def unavailable(self, links: LinkData) -> str | None:
        return TiltedDipole().unavailable(links)  # which needs headings, too

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        headed = np.isfinite(view.links.heading_deg)
        members = frequent_labels(view.links.receiver[headed], MIN_LINKS)
        return [self.Params(members=members)] if members else []

    @override
    def term(self, links: LinkData, params: Params, level_at: LevelAt) -> Term:
        psi = np.radians(links.body_azimuth_deg)
        columns = []
        for member in params.members:
            mine = (links.receiver == member) & np.isfinite(psi)
            columns += [np.where(mine, wave, 0.0) for wave in (np.cos(psi), np.sin(psi))]
        return Term.of_columns(np.column_stack(columns), PRIOR_SD_DB)

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        result = {}
        for member, (front_db, right_db), sd_db in zip(
                params.members, estimate.coefficients.reshape(-1, 2),
                estimate.coefficients_sd.reshape(-1, 2).mean(axis=1)):
            name, size_db = links.receiver_names[member], np.hypot(front_db, right_db)
            result[f"front_to_back_db[{name}]"] = Parameter.normal(2 * size_db, 2 * sd_db, "dB")
            result[f"clearest_side_deg[{name}]"] = Parameter.normal(
                np.degrees(np.arctan2(right_db, front_db)) % 360,
                np.degrees(sd_db / max(size_db, 0.1)), "deg")
        return result
