"""A receiver that loses lock now and then: a link is blank although its level is above the limit.

A blank is then either too weak or lost, P(blank) = p + (1 - p) F (the p-tobit of Deaton and Irish
1984, 'Statistical models for zero expenditures in household budgets', Journal of Public Economics
23), with a p for each receiver. Losses in sequences have the same p as losses at random; that
neighbouring links are lost together widens the interval.
"""

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import expit, logit, stdtr
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels
from radiotwin.effects.base import DetectionEffect
from radiotwin.effects.params import (
    QUANTILE_90,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Variation,
)
from radiotwin.effects.residual_view import ResidualView
from radiotwin.links import LinkData

MIN_LINKS = 60  # of a receiver, with line of sight
MIN_NATS = 5.0  # that dropouts must gain to be proposed for a receiver
STRONGEST = 0.25  # share of the links, which must gain, too
MIN_DEVICE_LINKS = 20  # of a device, to be asked whether it gains
MIN_DEVICES = 0.6  # share of those devices that must gain
DOF = 4.0  # of the errors: heavy tails
PROBABILITIES = np.geomspace(0.002, 0.9, 60)  # tried
MIN_PROBABILITY = 1e-9  # of a level below the limit; bounds the weight of one link
MAX_VARIED = 8  # receivers whose probabilities are refined; more take too long
STEP, MAX_CHANGE = 0.3, 1.0  # of the log-odds


class LockLoss(DetectionEffect):
    """A dropout probability for each receiver whose links become likelier by it."""

    name = "lock_loss"
    confused_with = ("missing_obstacle", "noise_floor_censoring")

    class Params(EffectParams):
        """Dropout probabilities of receivers."""

        receivers: dict[ReceiverIndex, Annotated[float, Field(ge=0, lt=1)]] = Field(
            description="Dropout probability of each receiver, by index.")

    @override
    def unavailable(self, links: LinkData) -> str | None:
        if not np.isfinite(links.limit_db).any():
            return "the limit of detection is not known, so that a blank has no meaning"
        return None if np.isnan(links.level_db).any() else "no link is blank"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links, found = view.links, {}
        # Behind buildings, links are blank for want of a path, too.
        clear = links.los if links.los.any() else np.ones(len(links), dtype=bool)
        for receiver in frequent_labels(links.receiver[clear], MIN_LINKS):
            rows = np.flatnonzero(clear & (links.receiver == receiver))
            margin = (links.limit_db[rows] - view.mean_db[rows]) / view.scale_db[rows]
            probability, nats = _likeliest(stdtr(DOF, margin), np.isnan(links.level_db[rows]))
            # A receiver less sensitive than declared misses no strong links, and an obstacle
            # affects some devices only.
            strong = margin <= np.quantile(margin, STRONGEST)
            if (nats.sum() > MIN_NATS * view.design_effect and nats[strong].sum() > 0
                    and _most_devices_gain(links.device[rows], nats)):
                found[receiver] = probability
        return [self.Params(receivers=found)] if found else []

    @override
    def dropout_probability(self, links: LinkData, params: Params) -> np.ndarray:
        by_receiver = np.zeros(len(links.receiver_names))
        by_receiver[list(params.receivers)] = list(params.receivers.values())
        return by_receiver[links.receiver]

    @override
    def variation(self, params: Params) -> Variation | None:
        if len(params.receivers) > MAX_VARIED:
            return None
        log_odds = logit(np.array(list(params.receivers.values())))
        return Variation(
            log_odds, np.full(len(log_odds), STEP), log_odds - MAX_CHANGE, log_odds + MAX_CHANGE,
            lambda numbers: self.Params(
                receivers=dict(zip(params.receivers, expit(numbers).tolist()))))

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        log_odds_sd = estimate.params_sd
        if not len(log_odds_sd):  # too many to be varied
            log_odds_sd = np.full(len(params.receivers), np.nan)
        result = {}
        for (receiver, probability), sd in zip(params.receivers.items(), log_odds_sd):
            low, high = expit(logit(probability) + QUANTILE_90 * sd * np.array([-1, 1]))
            result[f"lost_share[{links.receiver_names[receiver]}]"] = Parameter(
                probability, float(low), float(high), "of its links")
        return result


def _likeliest(below: np.ndarray, blank: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the likeliest dropout probability, and the gain of each link by it (n,) [nats].

    Args:
        below: (n,) probability of a level below the limit.
        blank: (n,) bool.
    """
    below = np.maximum(below, MIN_PROBABILITY)

    def nats(probability: float | np.ndarray, below: np.ndarray) -> np.ndarray:
        return np.log((probability + (1 - probability) * below) / below)

    total = (nats(PROBABILITIES[:, None], below[blank]).sum(axis=1)
             + (~blank).sum() * np.log1p(-PROBABILITIES))
    best = float(PROBABILITIES[total.argmax()])
    return best, np.where(blank, nats(best, below), np.log1p(-best))


def _most_devices_gain(device: np.ndarray, nats: np.ndarray) -> bool:
    """Return whether most devices with enough links gain."""
    counts, sums = np.bincount(device), np.bincount(device, weights=nats)
    enough = counts >= MIN_DEVICE_LINKS
    return not enough.any() or float((sums[enough] > 0).mean()) > MIN_DEVICES
