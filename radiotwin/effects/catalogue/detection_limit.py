"""`noise_floor_censoring`: a receiver with a higher limit of detection than the others.

Its blanks mean "below that limit" (Tobin 1958, 'Estimation of relationships for limited dependent
variables', Econometrica 26), not "below the usual one". Small differences, and a wrong declared
limit, are handled in `radiotwin.links.limits`. A limit above some of the receiver's readings is
rejected: its blanks have another reason, e.g. no path.
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.base import LimitEffect, ResidualView
from radiotwin.effects.params import Decibels, EffectParams, Estimate, Parameter, ReceiverIndex
from radiotwin.links import Links
from radiotwin.links.limits import MIN_NATS, contradict_limit, receiver_limit

MIN_RISE_DB = 2.0  # least excess over the usual limit


class DetectionLimit(LimitEffect):
    """A higher limit of detection for each receiver whose blanks it explains better."""

    name = "noise_floor_censoring"
    in_words = "a limit of detection"
    acts_on = ("receiver", "level")
    parameter_labels = {"limit": "limit of detection"}
    variant = "a receiver's own limit of detection"
    confused_with = ("lock_loss", "missing_obstacle", "receiver_gain_offset")
    nlos_only = True  # links with line of sight are far above any limit

    class Params(EffectParams):
        """Limits of receivers."""

        receivers: dict[ReceiverIndex, Decibels] = Field(
            description="Limit of detection of each receiver, by index [dB].")
        sd_db: dict[ReceiverIndex, Decibels] = Field(
            default_factory=dict, description="Standard deviation of each [dB].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        return None if np.isnan(links.level_db).any() else "no link is blank"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose receivers whose readings clearly end above their declared limit of detection."""
        links, found, sd_db = view.links, {}, {}
        detected = np.isfinite(links.level_db)
        for receiver in np.unique(links.receiver):
            rows = links.receiver == receiver
            declared_db = float(np.median(links.limit_db[rows]))
            limit = receiver_limit(links.level_db[rows], view.mean_db[rows], view.scale_db[rows],
                                   view.design_effect, declared_db)
            if (limit is not None and limit.is_sure and limit.limit_db > declared_db + MIN_RISE_DB
                    and (np.isinf(declared_db) or limit.over_declared_nats > MIN_NATS)
                    and not contradict_limit(links.level_db[rows & detected], limit.limit_db)):
                found[int(receiver)], sd_db[int(receiver)] = limit.limit_db, limit.sd_db
        return [self.Params(receivers=found, sd_db=sd_db)] if found else []

    @override
    def limits_db(self, links: Links) -> np.ndarray:
        by_receiver_db = np.full(len(links.receiver_names), -np.inf)
        by_receiver_db[list(self.params.receivers)] = list(self.params.receivers.values())
        return by_receiver_db[links.receiver]

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        unit = links.level_unit
        return {f"limit[{links.receiver_names[receiver]}]": Parameter.normal(
                    limit_db, self.params.sd_db.get(receiver, np.nan), unit)
                for receiver, limit_db in self.params.receivers.items()}
