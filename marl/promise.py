"""Predict the share of data that a plan collects, with quantiles over possible worlds.

Plans are searched with the expected levels, and with levels lowered by several standard deviations
(cautious plans, which use spare battery as a reserve). The plan with the best mean in some worlds
(`marl.worlds`) is evaluated in other, independent worlds. The sizing repeats this for numbers of
UAVs, batteries and bases.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from marl.belief import Belief, Prior
from marl.flights import evaluate
from marl.mission import Mission
from marl.planner import Plan, PlanPolicy, plan
from marl.replanning import weighted
from marl.settings import stream
from marl.worlds import WorldSource

QUANTILES = (0.1, 0.5, 0.9)
CAUTION = (0.0, 0.7, 1.4, 2.1)  # SNRs are lowered by this many standard deviations of errors
TRIED_PLANS, CHOOSING_WORLDS = len(CAUTION), 20  # number of plans; worlds that choose the best
SCHEMA = "radiotwin.plan/1"


@dataclass(frozen=True, eq=False)
class Promise:
    """Shares of data that a plan collects in W possible worlds.

    Attributes:
        plan: the plan.
        share: (W,) share of the data of transmitting devices, in each world.
        by_device: (W, K) share of each device's data; NaN if it does not transmit.
    """

    plan: Plan
    share: np.ndarray
    by_device: np.ndarray

    @property
    def quantiles(self) -> dict[str, float]:
        """P10, P50 and P90 of the share; P10 is exceeded in nine of ten worlds."""
        return _quantiles(self.share)

    def chance(self, wanted: float) -> float:
        """Return the share of worlds in which at least a wanted share is collected."""
        return float((self.share >= wanted).mean())

    def record(self, names: Iterable[str], silent: np.ndarray) -> dict[str, Any]:
        """Return the entries of `plan.json` on shares of all data and of each device.

        `silent` (K,) is the probability that each of the devices `names` does not transmit.
        """
        devices = [{"device": name, "silent": float(round(s, 3)),
                    "share": _quantiles(each[np.isfinite(each)])
                    if np.isfinite(each).any() else None}
                   for name, each, s in zip(names, self.by_device.T, silent, strict=True)]
        return {"schema": SCHEMA, "share": self.quantiles, "worlds": len(self.share),
                "devices": devices}


def promise(prior: Prior, mission: Mission, worlds: int, iterations: int, seed: int,
            on_progress: Callable[[int], None] = lambda _: None) -> Promise:
    """Search plans, choose the best, and evaluate it in worlds drawn from the prior.

    Each plan is made in a map lowered by another `CAUTION`; a few worlds choose the best.
    `on_progress` is called with the number of searches done since the last call; see
    `marl.plan_flights.PlanSettings` for the others.
    """
    source = WorldSource(prior, mission)
    best: tuple[float, Plan] | None = None
    trials = [source.draw(stream(seed, "choice", number)) for number in range(CHOOSING_WORLDS)]
    for number, caution in enumerate(CAUTION):
        belief = Belief(_cautious(prior, caution), mission)
        data_units, value = weighted(belief, mission.data_units)
        planned = mission._replace(level=np.arange(mission.uavs), data_units=data_units)
        found = plan(planned, iterations, seed + number, value)
        mean = float(np.mean([_flown(found, *world, stream(seed, "choice", number))[0]
                              for number, world in enumerate(trials)]))
        if best is None or mean > best[0]:
            best = mean, found
        on_progress(1)
    assert best is not None
    rngs = [stream(seed, "twin evaluation", number) for number in range(worlds)]
    flown = [_flown(best[1], *source.draw(rng), rng) for rng in rngs]
    return Promise(best[1], np.array([share for share, _ in flown]),
                   np.array([each for _, each in flown]))


def _cautious(prior: Prior, caution: float) -> Prior:
    """Lower a prior's SNRs by `caution` standard deviations of errors that last for a flight.

    Only errors that change in every slot remain uncertain.
    """
    if not caution:
        return prior
    of_device = prior.level_sd_db**2 + prior.common_sd_db**2
    sd_db = np.sqrt(of_device[:, None, None, None, None] + prior.share * prior.sd_db**2)
    return prior._replace(
        snr_db=(prior.snr_db - caution * sd_db).astype(np.float32), common_sd_db=0.0,
        level_sd_db=np.zeros_like(prior.level_sd_db),
        sd_db=(prior.sd_db * np.sqrt(1 - prior.share)).astype(np.float32), share=0.0)


def _flown(found: Plan, real: Mission, transmits: np.ndarray,
           rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """Fly a plan in a world; return the collected share of all data, and of each device's (K,).

    The latter is NaN for silent devices. Without any data, the share is 1.
    """
    flights = evaluate(real, PlanPolicy(found.actions), 1, rng)
    served, taken = flights.frames.assigned[0], np.zeros(real.devices)
    np.add.at(taken, served[served >= 0], flights.collected[0][served >= 0])
    with np.errstate(invalid="ignore"):
        by_device = np.where(transmits, taken / real.data_units, np.nan)
    total = float(real.data_units.sum())
    return (min(float(taken.sum()) / total, 1.0) if total else 1.0), by_device


def _quantiles(share: np.ndarray) -> dict[str, float]:
    """Return `p10`, `p50` and `p90` of shares (W,)."""
    return {f"p{100 * q:.0f}": float(round(value, 4))
            for q, value in zip(QUANTILES, np.quantile(share, QUANTILES), strict=True)}


@dataclass(frozen=True)
class Size:
    """A number of UAVs with a battery each [moves] and a base, and quantiles of the share of data.

    `chance` is the share of worlds in which the wanted share is collected.
    """

    uavs: int
    battery: float
    base: str
    p10: float
    p50: float
    p90: float
    chance: float


def sized(mission: Mission, uavs: Iterable[int], battery: float) -> Mission:
    """Return a mission with copies of its UAVs of some numbers, and another battery [moves]."""
    rows = np.array(list(uavs))
    return mission._replace(
        steps_home=mission.steps_home[rows], start=mission.start[rows],
        battery=np.full(len(rows), int(2 * battery)), level=mission.level[rows],
        altitude_m=mission.altitude_m[rows])


def bases(mission: Mission, names: list[str]) -> dict[str, list[int]]:
    """Return the UAVs by base (common start and terminal), named after the base's first UAV.

    With several bases, `all` has the UAVs of all bases in turn.
    """
    found: dict[tuple, list[int]] = {}
    for u in range(mission.uavs):
        home = np.argwhere(mission.steps_home[u] == 0)
        found.setdefault((*mission.start[u].tolist(), *home.ravel().tolist()), []).append(u)
    named = {names[group[0]]: group for group in found.values()}
    if len(named) > 1:
        longest = max(len(group) for group in named.values())
        turns = [group[number % len(group)] for number in range(longest)
                 for group in named.values()]
        named["all"] = turns
    return named


def sizes(prior: Prior, mission: Mission, names: list[str], counts: Iterable[int],
          batteries: Iterable[float], wanted: float, worlds: int, iterations: int, seed: int,
          on_progress: Callable[[int], None] = lambda _: None) -> list[Size]:
    """Evaluate `promise` for combinations of numbers of UAVs, batteries [moves] and bases.

    `names` are those of the mission's UAVs. Batteries that do not reach from start to terminal are
    left out.
    """
    rows, counts, batteries = [], list(counts), list(batteries)
    for base, group in bases(mission, names).items():
        for count in counts:
            chosen = [group[number % len(group)] for number in range(count)]
            needed = max(int(mission.steps_home[u][tuple(mission.start[u])]) for u in chosen)
            for battery in batteries:
                if battery < needed:
                    on_progress(TRIED_PLANS)
                    continue
                found = promise(prior, sized(mission, chosen, battery), worlds, iterations, seed,
                                on_progress)
                rows.append(Size(count, float(battery), base, **found.quantiles,
                                 chance=round(found.chance(wanted), 4)))
    return rows


def smallest(rows: list[Size], confidence: float) -> Size | None:
    """Return the size with the fewest UAVs, then the least battery, with a sufficient chance."""
    enough = [row for row in rows if row.chance >= confidence]
    return min(enough, key=lambda row: (row.uavs, row.battery), default=None)
