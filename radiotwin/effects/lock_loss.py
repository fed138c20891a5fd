"""A receiver that loses lock now and then: links are blank, or weaker, whatever their level.

A blank is either too weak or lost, P(blank) = p + (1 - p) F (the p-tobit of Deaton and Irish 1984,
'Statistical models for zero expenditures in household budgets', Journal of Public Economics 23),
with a p for each receiver. Of a receiver that goes on reading without lock the level is lower by
some decibels with a probability p. Losses in sequences have the same p as losses at random; that
neighbouring links are lost together widens the interval.
"""

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import expit, logit, stdtr
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels
from radiotwin.effects.base import DetectionEffect
from radiotwin.effects.level_drops import MIN_DROP_DB, find_drops
from radiotwin.effects.params import (
    QUANTILE_90,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Variation,
)
from radiotwin.effects.residual_view import ResidualView
from radiotwin.inference.student import Losses
from radiotwin.links import LinkData

MIN_LINKS = 60  # of a receiver, with line of sight
MIN_NATS = 5.0  # that losses must gain to be proposed for a receiver
STRONGEST = 0.25  # share of the links, which must gain, too
MIN_DEVICE_LINKS = 20  # of a device, to be asked whether it gains
MIN_DEVICES = 0.6  # share of those devices that must gain
PROBABILITIES = np.geomspace(0.002, 0.9, 60)  # tried
MIN_PROBABILITY = 1e-9  # of a level below the limit; bounds the weight of one link
MAX_VARIED = 8  # receivers whose probabilities are refined; more take too long
STEP, MAX_CHANGE = 0.3, 1.0  # of the log-odds
STEP_DB, MAX_CHANGE_DB = 1.0, 6.0  # of a drop
MAX_DROP_DB = 80.0  # the range of a good receiver


class LockLoss(DetectionEffect):
    """A probability of loss for each receiver whose links become likelier by it."""

    name = "lock_loss"
    confused_with = ("missing_obstacle", "noise_floor_censoring", "episode", "faulty_flight")

    class Params(EffectParams):
        """Receivers that lose lock."""

        receivers: dict[ReceiverIndex, Annotated[float, Field(ge=0, lt=1)]] = Field(
            description="Probability of a loss, of each receiver by index.")
        drops_db: dict[ReceiverIndex, Annotated[float, Field(gt=0, le=MAX_DROP_DB)]] = Field(
            default_factory=dict, description="By how much the level is lower without lock, of "
            "those receivers that are not blank then [dB].")

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links, blank, shares, drops_db = view.links, {}, {}, {}
        # Behind buildings, links are blank, or weak, for want of a path, too.
        clear = links.los if links.los.any() else np.ones(len(links), dtype=bool)
        for receiver in frequent_labels(links.receiver[clear], MIN_LINKS):
            rows = np.flatnonzero(clear & (links.receiver == receiver))
            probability = _blank_share(view, rows)
            if probability is not None:
                blank[receiver] = probability
            heard = rows[np.isfinite(links.level_db[rows])]
            found = find_drops(view, receiver, heard, view.design_effect, MIN_NATS) \
                if len(heard) >= MIN_LINKS else None
            if found is not None and _most_devices_gain(links.device[heard], found.nats):
                shares[receiver], drops_db[receiver] = found.share, found.drop_db
        proposed = [self.Params(receivers=blank)] if blank else []
        if shares:
            proposed.append(self.Params(receivers=shares, drops_db=drops_db))
        return proposed

    @override
    def losses(self, links: LinkData, params: Params) -> Losses:
        blank, drop, drop_db = np.zeros((3, len(links.receiver_names)))
        for receiver, probability in params.receivers.items():
            (drop if receiver in params.drops_db else blank)[receiver] = probability
        drop_db[list(params.drops_db)] = list(params.drops_db.values())
        return Losses(*(each[links.receiver] for each in (blank, drop, drop_db)))

    @override
    def variation(self, params: Params) -> Variation | None:
        if len(params.receivers) > MAX_VARIED:
            return None
        log_odds = logit(np.array(list(params.receivers.values())))
        drops_db = np.array(list(params.drops_db.values()))
        start, change = np.r_[log_odds, drops_db], np.r_[
            np.full(len(log_odds), MAX_CHANGE), np.full(len(drops_db), MAX_CHANGE_DB)]
        least = np.r_[np.full(len(log_odds), -np.inf), np.full(len(drops_db), MIN_DROP_DB / 2)]
        most = np.r_[np.full(len(log_odds), np.inf), np.full(len(drops_db), MAX_DROP_DB)]

        def changed(numbers: np.ndarray) -> LockLoss.Params:
            shares, own_db = np.split(numbers, [len(log_odds)])
            return self.Params(receivers=dict(zip(params.receivers, expit(shares).tolist())),
                               drops_db=dict(zip(params.drops_db, own_db.tolist())))

        return Variation(
            start, np.r_[np.full(len(log_odds), STEP), np.full(len(drops_db), STEP_DB)],
            np.maximum(start - change, least), np.minimum(start + change, most), changed)

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        sd = estimate.params_sd
        if not len(sd):  # too many to be varied
            sd = np.full(len(params.receivers) + len(params.drops_db), np.nan)
        shares_sd, drops_sd_db = np.split(sd, [len(params.receivers)])
        result = {}
        for (receiver, probability), own_sd in zip(params.receivers.items(), shares_sd):
            low, high = expit(logit(probability) + QUANTILE_90 * own_sd * np.array([-1, 1]))
            result[f"lost_share[{links.receiver_names[receiver]}]"] = Parameter(
                probability, float(low), float(high), "of its links")
        for (receiver, drop_db), sd_db in zip(params.drops_db.items(), drops_sd_db):
            result[f"drop_db[{links.receiver_names[receiver]}]"] = Parameter.normal(
                drop_db, sd_db, "dB")
        return result


def _blank_share(view: ResidualView, rows: np.ndarray) -> float | None:
    """Return the likeliest share of the links (n,) of a receiver that are lost; None: no gain."""
    links = view.links
    blank = np.isnan(links.level_db[rows])
    if not blank.any() or not np.isfinite(links.limit_db[rows]).all():
        return None
    margin = (links.limit_db[rows] - view.mean_db[rows]) / view.scale_db[rows]
    probability, nats = _likeliest(stdtr(DOF, margin), blank)
    # A receiver less sensitive than declared misses no strong links, and an obstacle affects some
    # devices only.
    strong = margin <= np.quantile(margin, STRONGEST)
    gains = (nats.sum() > MIN_NATS * view.design_effect and nats[strong].sum() > 0
             and _most_devices_gain(links.device[rows], nats))
    return probability if gains else None


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
