"""A receiver that now and then loses lock: a link is blank although its level is well above the limit.

A blank is then either too weak or lost, P(blank) = p + (1 - p) F (the p-tobit of Deaton and Irish 1984, 'Statistical
models for zero expenditures in household budgets', Journal of Public Economics 23), with a p for each receiver. Losses
in stretches have the same p as losses at random; that links close to each other are lost together widens the interval.
"""

import numpy as np
from scipy.special import expit, logit, stdtr

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured

LEAST_LINKS = 60
LEAST_NATS = 5.0
LEAST_ALIKE = 20  # links of a device that tell whether it is lost as others are
ALIKE = 0.6  # share of the devices that must want it
STRONG = 0.25  # share of the links, the strongest, that must want it
DOF = 4.0
SHARES = np.geomspace(0.002, 0.9, 60)
LEAST_CHANCE = 1e-9
MOST_VARIED = 8
STEP = 0.3  # of the log-odds
FARTHEST = 1.0


class LockLoss(Effect):
    """A share of lost links for each receiver that it helps."""

    name = "lock_loss"
    of_receiver = True
    stage = "detection"
    confused_with = ("missing_obstacle", "noise_floor_censoring")

    def lacks(self, records) -> str | None:
        if records.limit_db is None:
            return "the limit of detection is not known, so that a blank tells nothing"
        return None if np.isnan(records.level_db).any() else "no link is blank"

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, {}
        # Where buildings stand between, links are blank for want of a path, too.
        clear = records.los if records.los.any() else np.ones(len(records), dtype=bool)
        for receiver in measured(records.receiver[clear], LEAST_LINKS):
            rows = np.flatnonzero(clear & (records.receiver == receiver))
            margin = (records.limit_db - view.mean_db[rows]) / view.scale_db[rows]
            share, nats = _likeliest_share(stdtr(DOF, margin), np.isnan(records.level_db[rows]))
            # A receiver that is deafer than declared misses no strong links, and an obstacle hides some devices' only.
            strong = margin <= np.quantile(margin, STRONG)
            if (nats.sum() > LEAST_NATS * view.design_effect and nats[strong].sum() > 0
                    and _alike(records.device[rows], nats)):
                found[str(receiver)] = share
        return [{"receivers": found}] if found else []

    def term(self, records, setting, at) -> Term:
        return Term.of_offset(np.zeros(len(records)))

    def loses(self, records, setting) -> np.ndarray:
        share = np.zeros(len(records.receiver_names))
        for receiver, value in setting["receivers"].items():
            share[int(receiver)] = value
        return share[records.receiver]

    def vary(self, setting) -> Variation | None:
        receivers = list(setting["receivers"])
        if len(receivers) > MOST_VARIED:
            return None
        odds = logit(np.array(list(setting["receivers"].values())))

        def again(numbers: np.ndarray) -> dict:
            return {"receivers": dict(zip(receivers, map(float, expit(numbers))))}
        return Variation(odds, np.full(len(odds), STEP), odds - FARTHEST, odds + FARTHEST, again)

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        spreads = found.setting_deviations
        if not len(spreads):  # too many to be varied
            spreads = np.full(len(setting["receivers"]), np.nan)
        result = {}
        for (receiver, share), spread in zip(setting["receivers"].items(), spreads):
            low, high = expit(logit(share) + 1.645 * spread * np.array([-1, 1]))
            result[f"lost_share[{records.receiver_names[int(receiver)]}]"] = Parameter(
                share, float(low), float(high), "of its links")
        return result


def _likeliest_share(below: np.ndarray, blank: np.ndarray) -> tuple[float, np.ndarray]:
    """The likeliest share of lost links, and what each link gains by it (n,) [nats].

    Args:
        below: (n,) chance of a level below the limit.
        blank: (n,) bool.
    """
    below = np.maximum(below, LEAST_CHANCE)

    def nats(share, below):
        return np.log((share + (1 - share) * below) / below)

    total = nats(SHARES[:, None], below[blank]).sum(axis=1) + (~blank).sum() * np.log1p(-SHARES)
    share = float(SHARES[total.argmax()])
    return share, np.where(blank, nats(share, below), np.log1p(-share))


def _alike(device: np.ndarray, nats: np.ndarray) -> bool:
    """Whether most devices want it; those with few links do not count."""
    counts, sums = np.bincount(device), np.bincount(device, weights=nats)
    large = counts >= LEAST_ALIKE
    return not large.any() or float((sums[large] > 0).mean()) > ALIKE
