"""A receiver less sensitive than declared: its links are blank below a limit of its own.

A blank then means "below that limit" (Tobin 1958, 'Estimation of relationships for limited
dependent variables', Econometrica 26) and not "below the declared one". The likeliest limit is the
lowest level that the receiver has read.
"""

import numpy as np
from pydantic import Field
from scipy.special import stdtr
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels
from radiotwin.effects.base import LimitEffect
from radiotwin.effects.params import Decibels, EffectParams, Estimate, Parameter, ReceiverIndex
from radiotwin.effects.residual_view import ResidualView
from radiotwin.links import LinkData

MIN_READINGS, MIN_BLANKS = 40, 10  # of a receiver
MIN_NATS = 4.0  # that a limit must gain to be proposed for a receiver
MIN_RISE_DB = 2.0  # above the declared limit
DOF = 4.0  # of the errors: heavy tails
LOWEST = 0.005  # quantile: a single odd reading below the limit does not count
NEAREST = 10  # readings above the limit, for their usual gap


class DetectionLimit(LimitEffect):
    """A limit for each receiver whose blanks become likelier by it."""

    name = "noise_floor_censoring"
    variant = "a receiver's own limit of detection"
    confused_with = ("lock_loss", "missing_obstacle", "receiver_gain_offset")

    class Params(EffectParams):
        """Limits of receivers."""

        receivers: dict[ReceiverIndex, Decibels] = Field(
            description="Limit of detection of each receiver, by index [dB].")

    @override
    def unavailable(self, links: LinkData) -> str | None:
        return None if np.isnan(links.level_db).any() else "no link is blank"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links, found = view.links, {}
        blank = np.isnan(links.level_db)
        for receiver in frequent_labels(links.receiver[~blank], MIN_READINGS):
            mine = links.receiver == receiver
            declared_db = float(np.median(links.limit_db[mine]))
            missed = mine & blank
            if missed.sum() < MIN_BLANKS:
                continue
            limit_db = float(np.quantile(links.level_db[mine & ~blank], LOWEST))
            mean_db, scale_db = view.mean_db[missed], view.scale_db[missed]
            nats = np.log(stdtr(DOF, (limit_db - mean_db) / scale_db))
            if np.isfinite(declared_db):
                nats = nats - np.log(stdtr(DOF, (declared_db - mean_db) / scale_db))
            if (limit_db > declared_db + MIN_RISE_DB
                    and nats.sum() / view.design_effect > MIN_NATS):
                found[receiver] = limit_db
        return [self.Params(receivers=found)] if found else []

    @override
    def limits_db(self, links: LinkData, params: Params) -> np.ndarray:
        by_receiver_db = np.full(len(links.receiver_names), -np.inf)
        by_receiver_db[list(params.receivers)] = list(params.receivers.values())
        return by_receiver_db[links.receiver]

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        result, unit = {}, "dB" if links.is_gain else "dBm"
        for receiver, limit_db in params.receivers.items():
            mine = (links.receiver == receiver) & (links.level_db >= limit_db)
            read_db = np.sort(links.level_db[mine])
            nearest = min(NEAREST, len(read_db) - 1)
            gap_db = (read_db[nearest] - read_db[0]) / nearest
            # Gaps are exponential: one ln(10) times the usual is exceeded in 10 % of cases.
            low_db = limit_db - np.log(10.0) * float(gap_db)
            result[f"limit[{links.receiver_names[receiver]}]"] = Parameter(
                limit_db, low_db, float(read_db[0]), unit)
        return result
