"""Readings of a receiver that are now and then lower by the same amount, whatever the place.

All links of an instant share the receiver's state: lock kept or lost. So the likelihood is a
mixture over instants, fitted by EM (Dempster, Laird and Rubin 1977, JRSS B 39) from several first
drops, and held against one Student t whose tails are as heavy as the levels want them. A drop that
comes once is an episode or a faulty flight, and one that comes at certain places is the map's.
"""

from dataclasses import dataclass

import numpy as np

from radiotwin.effects.arrays import robust_sd
from radiotwin.effects.comparison import compared_where_possible_db
from radiotwin.effects.residual_view import ResidualView
from radiotwin.inference.student import log_density
from radiotwin.links import LinkData

DOF = 4.0  # of the errors within a state
TAILS = (1.2, 1.6, 2.2, 3.0, 4.0, 8.0)  # degrees of freedom of the single t, tried
FIRST_DROPS_DB = (10.0, 15.0, 22.0, 32.0, 42.0)
STEPS = 40  # of EM
MIN_DROP_DB = 8.0  # a smaller one cannot be told from shadowing
MAX_SHARE = 0.5  # of two states the rarer one is the fault
MIN_RUNS = 4  # stretches of time in which levels are low
MAX_RUN = 0.5  # share of the low instants in the longest of them
MAX_OTHERS = 0.3  # share of low readings of other receivers, over this one's
MIN_APART = 3.0  # error scales between the states


@dataclass(frozen=True, eq=False)
class Drops:
    """Drops of a receiver's level.

    Attributes:
        share: of its instants.
        drop_db: how much lower they are.
        nats: (n,) gain in log-likelihood of each of its readings.
    """

    share: float
    drop_db: float
    nats: np.ndarray


@dataclass(frozen=True, eq=False)
class _States:
    """Two states of instants: (i,) probability of the low one, and log-likelihood (i,) [nats]."""

    share: float
    level_db: float
    drop_db: float
    scale_db: float
    low: np.ndarray
    nats: np.ndarray


def find_drops(view: ResidualView, receiver: int, rows: np.ndarray, design_effect: float,
               min_nats: float) -> Drops | None:
    """Return how the readings of a receiver drop now and then; None where they do not.

    Args:
        view: the training links.
        receiver: its index.
        rows: (n,) its detected links, with line of sight where there are any.
        design_effect: how many links count as one.
        min_nats: least gain.
    """
    every_db, _ = compared_where_possible_db(view)
    rest_db, instant = every_db[rows], _instants(view.links, rows)
    states = max((_two_states(rest_db, instant, drop_db) for drop_db in FIRST_DROPS_DB),
                 key=lambda each: each.nats.sum())
    single = _single_state(rest_db)
    nats = (states.nats / np.bincount(instant))[instant] - single
    if (nats.sum() < min_nats * design_effect or states.drop_db < MIN_DROP_DB
            or states.drop_db < MIN_APART * states.scale_db or not 0 < states.share < MAX_SHARE):
        return None
    if not _comes_and_goes(view.links, rows, instant, states.low > 0.5):
        return None
    others = np.flatnonzero((view.links.receiver != receiver) & np.isfinite(view.links.level_db)
                            & (view.links.los == view.links.los[rows[0]]))
    low_db = states.level_db - 0.5 * states.drop_db
    if len(others) and (every_db[others] < low_db).mean() > MAX_OTHERS * (rest_db < low_db).mean():
        return None
    return Drops(states.share, states.drop_db, nats)


def _instants(links: LinkData, rows: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the instant of each link, in the order of time."""
    time_s = links.time_s[rows]
    key = np.where(np.isfinite(time_s), time_s, rows)
    _, instant = np.unique(np.column_stack([links.flight[rows], key]), axis=0, return_inverse=True)
    return instant.ravel()


def _two_states(rest_db: np.ndarray, instant: np.ndarray, drop_db: float) -> _States:
    """Return the likeliest two states of instants, from a first drop on."""
    share, level_db = 0.2, float(np.quantile(rest_db, 0.6))
    scale_db = max(robust_sd(rest_db), 0.5) / 2
    low, total = np.zeros(instant.max() + 1), np.zeros(instant.max() + 1)
    for _ in range(STEPS):
        z = (rest_db[None] - level_db + np.array([[0.0], [drop_db]])) / scale_db
        of_links = log_density(z, DOF) - np.log(scale_db)
        of_instants = np.array([np.bincount(instant, weights=each) for each in of_links])
        of_instants += np.log([[1 - share], [share]])
        total = np.logaddexp(*of_instants)
        low = np.exp(of_instants[1] - total)
        mine = np.array([1 - low, low])[:, instant]
        weight = mine * (DOF + 1) / (DOF + z * z)
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
    """Return the log-likelihood of each residual (n,) by the likeliest single t [nats]."""
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


def _comes_and_goes(links: LinkData, rows: np.ndarray, instant: np.ndarray,
                    low: np.ndarray) -> bool:
    """Return whether the low instants (i,) are several stretches of time, none of them most."""
    flight = np.zeros(len(low), dtype=int)
    flight[instant] = links.flight[rows]
    begins = low & ~np.r_[False, low[:-1] & (flight[1:] == flight[:-1])]
    lengths = np.bincount(np.cumsum(begins)[low])[1:]
    return len(lengths) >= MIN_RUNS and lengths.max() <= MAX_RUN * lengths.sum()
