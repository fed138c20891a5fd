"""`lock_loss`: a receiver that loses lock at times, so that links are blank or weaker at random.

A blank is either too weak or lost, P(blank) = p + (1 - p) F (the p-Tobit of Deaton and Irish 1984,
'Statistical models for zero expenditures in household budgets', Journal of Public Economics 23),
with one p per receiver. A receiver that still reads without lock has, with probability p, a level
that is lower by some decibels. Losses in sequences have the same p; their correlation widens the
interval.

All links of an instant share the receiver's state: lock kept or lost. So drops are a mixture of two
states of instants, fitted by EM (Dempster, Laird and Rubin 1977, JRSS B 39) from several start
values, and compared with one Student t of fitted tails. A drop that happens once is an episode or a
faulty flight; one at certain places is an error of the map.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import expit, logit, stdtr
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, MIN_NATS, frequent_labels
from radiotwin.effects.base import DetectionEffect, ResidualView
from radiotwin.effects.comparison import compared_where_possible_db
from radiotwin.effects.params import (
    QUANTILE_90,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Variation,
)
from radiotwin.inference.gaussian import robust_sd
from radiotwin.inference.student import DOF, Losses, log_density
from radiotwin.links import Links

TAILS = (1.2, 1.6, 2.2, 3.0, 4.0, 8.0)  # trial degrees of freedom of the single t
FIRST_DROPS_DB = (10.0, 15.0, 22.0, 32.0, 42.0)  # start values of EM
STEPS = 40  # iterations of EM
MIN_DROP_DB = 8.0  # a smaller one cannot be distinguished from shadowing
MAX_SHARE = 0.5  # largest share of the low state: the rarer state is the fault
MIN_RUNS = 4  # least number of separate periods with low levels
MAX_RUN = 0.5  # largest share of the low instants in the longest period
MAX_OTHERS = 0.3  # largest share of low readings of other receivers, relative to this one's
MIN_SEPARATION = 3.0  # least distance between the states [error scales]
STRONGEST = 0.25  # share of the strongest links, whose gain must also be positive
MIN_DEVICE_LINKS = 20  # of a device, to test whether its links gain
MIN_DEVICES = 0.6  # share of those devices whose links must gain
PROBABILITIES = np.geomspace(0.002, 0.9, 60)  # trial values
MIN_PROBABILITY = 1e-9  # least probability of a level below the limit; bounds the weight of a link
MAX_VARIED = 8  # receivers whose probabilities are refined; more take too long
STEP, MAX_CHANGE = 0.3, 1.0  # first step and bound of the search [log odds]
STEP_DB, MAX_CHANGE_DB = 1.0, 6.0  # the same for a drop
MAX_DROP_DB = 80.0  # dynamic range of a good receiver


@dataclass(frozen=True, eq=False)
class _States:
    """Mixture of two states over i instants."""

    share: float  # of the low state
    level_db: float  # of the high state
    drop_db: float  # distance to the low state
    scale_db: float  # of the errors
    low: np.ndarray  # (i,) posterior probability of the low state
    nats: np.ndarray  # (i,) log-likelihood


def _find_drops(view: ResidualView, receiver: int,
                rows: np.ndarray) -> tuple[_States, np.ndarray] | None:
    """Find random drops in a receiver's readings `rows` (r,), and each one's gain (r,) [nats].

    None if they are too weak, do not come and go, or are as frequent for other receivers.
    """
    compared_db, _ = compared_where_possible_db(view)
    rest_db, instant = compared_db[rows], _instants(view.links, rows)
    states = max((_two_states(rest_db, instant, drop_db) for drop_db in FIRST_DROPS_DB),
                 key=lambda tried: tried.nats.sum())
    single = _single_state(rest_db)
    nats = (states.nats / np.bincount(instant))[instant] - single
    if (nats.sum() < MIN_NATS * view.design_effect or states.drop_db < MIN_DROP_DB
            or states.drop_db < MIN_SEPARATION * states.scale_db
            or not 0 < states.share < MAX_SHARE):
        return None
    if not _comes_and_goes(view.links, rows, instant, states.low > 0.5):
        return None
    others = np.flatnonzero((view.links.receiver != receiver) & np.isfinite(view.links.level_db)
                            & (view.links.los == view.links.los[rows[0]]))
    low_db = states.level_db - 0.5 * states.drop_db
    if len(others) and ((compared_db[others] < low_db).mean()
                        > MAX_OTHERS * (rest_db < low_db).mean()):
        return None
    return states, nats


def _instants(links: Links, rows: np.ndarray) -> np.ndarray:
    """Return the instant (r,) of each row by flight and time; one without a time has its own."""
    time_s = links.time_s[rows]
    key = np.where(np.isfinite(time_s), time_s, rows)
    _, instant = np.unique(np.column_stack([links.flight[rows], key]), axis=0, return_inverse=True)
    return instant.ravel()


def _two_states(rest_db: np.ndarray, instant: np.ndarray, drop_db: float) -> _States:
    """Fit two states, normal and lower by a drop, by EM; all readings of an instant share one."""
    share, level_db = 0.2, float(np.quantile(rest_db, 0.6))
    scale_db = max(robust_sd(rest_db), 0.5) / 2
    low, total = np.zeros(instant.max() + 1), np.zeros(instant.max() + 1)
    for _ in range(STEPS):
        z = (rest_db[None] - level_db + np.array([[0.0], [drop_db]])) / scale_db
        link_nats = log_density(z, DOF) - np.log(scale_db)
        state_nats = np.array([np.bincount(instant, weights=nats) for nats in link_nats])
        state_nats += np.log([[1 - share], [share]])
        total = np.logaddexp(*state_nats)
        low = np.exp(state_nats[1] - total)
        weight = np.array([1 - low, low])[:, instant] * (DOF + 1) / (DOF + z * z)
        kept, dropped = weight.sum(axis=1)
        if min(kept, dropped) < 1.0:
            break
        centres = (weight * rest_db).sum(axis=1) / (kept, dropped)
        level_db, drop_db = float(centres[0]), float(centres[0] - centres[1])
        share = float(np.clip(low.mean(), 1e-4, 1 - 1e-4))
        square = (weight * (rest_db - centres[:, None]) ** 2).sum() / len(rest_db)
        scale_db = max(float(np.sqrt(square)), 0.3)
    return _States(share, level_db, drop_db, scale_db, low, total)


def _single_state(rest_db: np.ndarray) -> np.ndarray:
    """Fit one Student t of the best trial degrees of freedom: log-likelihoods (n,) [nats]."""
    best = np.full(len(rest_db), -np.inf)
    for dof in TAILS:
        level_db = float(np.median(rest_db))
        scale_db = robust_sd(rest_db) + 0.3
        for _ in range(STEPS):
            z = (rest_db - level_db) / scale_db
            weight = (dof + 1) / (dof + z * z)
            level_db = float(weight @ rest_db / weight.sum())
            scale_db = max(float(np.sqrt((weight * (rest_db - level_db) ** 2).mean())), 0.3)
        nats = log_density((rest_db - level_db) / scale_db, dof) - np.log(scale_db)
        best = max(best, nats, key=np.sum)
    return best


def _comes_and_goes(links: Links, rows: np.ndarray, instant: np.ndarray,
                    low: np.ndarray) -> bool:
    """Check whether instants of low level (i,) form several separate periods, none dominant."""
    flight = np.zeros(len(low), dtype=int)
    flight[instant] = links.flight[rows]
    begins = low & ~np.r_[False, low[:-1] & (flight[1:] == flight[:-1])]
    lengths = np.bincount(np.cumsum(begins)[low])[1:]
    return len(lengths) >= MIN_RUNS and lengths.max() <= MAX_RUN * lengths.sum()


class LockLoss(DetectionEffect):
    """A probability of loss for each receiver whose links gain likelihood by it."""

    name = "lock_loss"
    in_words = "loss of lock"
    acts_on = ("receiver", "flight", "receiver x flight", "time")
    parameter_labels = {"lost_share": "share lost", "drop_db": "level without lock, lower by"}
    confused_with = ("missing_obstacle", "noise_floor_censoring", "episode", "faulty_flight")

    class Params(EffectParams):
        """Receivers that lose lock."""

        receivers: dict[ReceiverIndex, Annotated[float, Field(ge=0, lt=1)]] = Field(
            description="Probability of a loss, of each receiver by index.")
        drops_db: dict[ReceiverIndex, Annotated[float, Field(gt=0, le=MAX_DROP_DB)]] = Field(
            default_factory=dict, description="By how much the level is lower without lock, of "
            "those receivers that are not blank then [dB].")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose shares of blank links by receiver; and separately, shares and sizes of drops."""
        links, blank, shares, drops_db = view.links, {}, {}, {}
        # Behind buildings links are also blank, or weak, because there is no path.
        clear = links.los if links.los.any() else np.ones(len(links), dtype=bool)
        for receiver in frequent_labels(links.receiver[clear], MIN_LINKS):
            rows = np.flatnonzero(clear & (links.receiver == receiver))
            probability = _blank_share(view, rows)
            if probability is not None:
                blank[receiver] = probability
            detected = rows[np.isfinite(links.level_db[rows])]
            found = _find_drops(view, receiver, detected) if len(detected) >= MIN_LINKS else None
            if found is not None and _most_devices_gain(links.device[detected], found[1]):
                shares[receiver], drops_db[receiver] = found[0].share, found[0].drop_db
        proposed = [self.Params(receivers=blank)] if blank else []
        if shares:
            proposed.append(self.Params(receivers=shares, drops_db=drops_db))
        return proposed

    @override
    def losses(self, links: Links) -> Losses:
        """Compute each link's (n,) probabilities of a blank and of a drop, and the drop [dB]."""
        blank, drop, drop_db = np.zeros((3, len(links.receiver_names)))
        for receiver, probability in self.params.receivers.items():
            (drop if receiver in self.params.drops_db else blank)[receiver] = probability
        drop_db[list(self.params.drops_db)] = list(self.params.drops_db.values())
        return Losses(*(each[links.receiver] for each in (blank, drop, drop_db)))

    @override
    def variation(self) -> Variation | None:
        """Put loss probabilities (log odds) and drops [dB] into a search vector; too many: None."""
        if len(self.params.receivers) > MAX_VARIED:
            return None
        log_odds = logit(np.array(list(self.params.receivers.values())))
        drops_db = np.array(list(self.params.drops_db.values()))
        start, change = np.r_[log_odds, drops_db], np.r_[
            np.full(len(log_odds), MAX_CHANGE), np.full(len(drops_db), MAX_CHANGE_DB)]
        least = np.r_[np.full(len(log_odds), -np.inf), np.full(len(drops_db), MIN_DROP_DB / 2)]
        most = np.r_[np.full(len(log_odds), np.inf), np.full(len(drops_db), MAX_DROP_DB)]

        def varied(numbers: np.ndarray) -> LockLoss:
            new_log_odds, new_drops_db = np.split(numbers, [len(log_odds)])
            return self.with_params(self.Params(
                receivers=dict(zip(self.params.receivers, expit(new_log_odds).tolist())),
                drops_db=dict(zip(self.params.drops_db, new_drops_db.tolist()))))

        return Variation(
            start, np.r_[np.full(len(log_odds), STEP), np.full(len(drops_db), STEP_DB)],
            np.maximum(start - change, least), np.minimum(start + change, most), varied)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report each receiver's share of lost links, and its drop [dB], with 90 % intervals."""
        sd = estimate.params_sd
        if not len(sd):  # too many receivers to refine
            sd = np.full(len(self.params.receivers) + len(self.params.drops_db), np.nan)
        shares_sd, drops_sd_db = np.split(sd, [len(self.params.receivers)])
        result = {}
        for (receiver, probability), log_odds_sd in zip(self.params.receivers.items(), shares_sd):
            low, high = expit(logit(probability) + QUANTILE_90 * log_odds_sd * np.array([-1, 1]))
            result[f"lost_share[{links.receiver_names[receiver]}]"] = Parameter(
                probability, float(low), float(high), "of its links")
        for (receiver, drop_db), sd_db in zip(self.params.drops_db.items(), drops_sd_db):
            result[f"drop_db[{links.receiver_names[receiver]}]"] = Parameter.normal(
                drop_db, sd_db, "dB")
        return result


def _blank_share(view: ResidualView, rows: np.ndarray) -> float | None:
    """Estimate the probability that a receiver loses a link (rows) whatever its level.

    By maximum likelihood, beside links that are undetected as their level is below the limit. None
    if a limit is unknown, or if random losses do not explain the blanks clearly better.
    """
    links = view.links
    blank = np.isnan(links.level_db[rows])
    if not blank.any() or not np.isfinite(links.limit_db[rows]).all():
        return None
    margin = (links.limit_db[rows] - view.mean_db[rows]) / view.scale_db[rows]
    probability, nats = _likeliest(stdtr(DOF, margin), blank)
    # If the likelihood of the strongest links does not rise, the limit of detection is higher than
    # declared; if that of most devices does not, an obstacle explains the blanks.
    strong = margin <= np.quantile(margin, STRONGEST)
    gains = (nats.sum() > MIN_NATS * view.design_effect and nats[strong].sum() > 0
             and _most_devices_gain(links.device[rows], nats))
    return probability if gains else None


def _likeliest(below: np.ndarray, blank: np.ndarray) -> tuple[float, np.ndarray]:
    """Estimate the probability of random loss, and each link's log-likelihood gain (n,) [nats].

    `below` (n,) is the probability that the level is below the limit of detection.
    """
    below = np.maximum(below, MIN_PROBABILITY)

    def nats(probability: float | np.ndarray, below: np.ndarray) -> np.ndarray:
        return np.log((probability + (1 - probability) * below) / below)

    total = (nats(PROBABILITIES[:, None], below[blank]).sum(axis=1)
             + (~blank).sum() * np.log1p(-PROBABILITIES))
    best = float(PROBABILITIES[total.argmax()])
    return best, np.where(blank, nats(best, below), np.log1p(-best))


def _most_devices_gain(device: np.ndarray, nats: np.ndarray) -> bool:
    """Check whether most devices with enough links gain likelihood; True if there are none."""
    counts, sums = np.bincount(device), np.bincount(device, weights=nats)
    enough = counts >= MIN_DEVICE_LINKS
    return not enough.any() or float((sums[enough] > 0).mean()) > MIN_DEVICES
