"""Where devices of unknown position are, by the model that the loop has corrected: for networks without a 3D map, too.

The posterior over the ground of each device by itself: the likelihood of its links (`regression`), with everything that
was found of their receivers, and a level of the device's own that nobody knows (hand, pocket, battery), which is
integrated out (Gauss and Hermite). Flat over the area; a coarse grid first, then a finer one where the probability is.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from radiotwin.closeloop.bases import FittedBase
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Solution, expect, nll, residual_db
from radiotwin.effects.base import Effect, Setting

COARSE_CELLS = 1500
FINE_CELLS = 640  # at most
FINEST = 4  # times
HELD = 0.999  # of the probability, by the cells that are looked at again
NODES = 7
CREDIBLE = 0.9
LEAST_LINKS = 3
LEAST_SLOPE = 0.5
TEMPERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08)
MOST_TASKS = 100
LEAST_DEVICES = 50  # fewer do not tell a share of nine in ten
AROUND_M = 300.0  # beyond all ends that are known
LINKS_AT_ONCE = 400_000  # of all cells together: bounds memory, 260 bytes each without a map


@dataclass(frozen=True)
class Place:
    """Where a device may be.

    Attributes:
        device: row of the records' devices.
        x_m, y_m: the place of least expected distance.
        radius_m: around it, of 90 % of the probability.
        links: that tell it.
    """

    device: int
    x_m: float
    y_m: float
    radius_m: float
    links: int


@dataclass(frozen=True, eq=False)
class Corrected:
    """A base with effects, ready for links of devices that it does not know.

    Attributes:
        base, effects, solution, dof: as fitted.
        device_m: (k, 3) positions of the devices that it knows; effects count devices by their rows.
        first_s: time of the first measurement that it was fitted to [s].
        device_spread_db: see `device_spread_db`.
        temper: power of the likelihood, see `calibrated_temper`.
    """

    base: FittedBase
    effects: list[tuple[Effect, Setting]]
    solution: Solution
    dof: float
    device_m: np.ndarray
    first_s: float
    device_spread_db: float
    temper: float = 1.0

    @classmethod
    def of(cls, side: Side, fit: Solution) -> "Corrected":
        """What was learned from the training links of a side."""
        return cls(side.base, [(part.effect, part.setting) for part in side.parts], fit, side.dof,
                   side.records.device_m, side.records.first_s, device_spread_db(side, fit))


def locate(model: Corrected, records: Records, area_m: tuple[float, float, float, float],
           tell: Callable[[], None] = lambda: None) -> Iterator[Place]:
    """Find the devices of some links, whatever position they have in the records but for their height.

    Args:
        model: counts receivers as `records` do.
        records: links of the devices.
        area_m: west, east, south and north end of where they may be.
        tell: called after each device.
    """
    coarse_m, width_m = _grid(area_m)
    for device in np.unique(records.device):
        mine = records.select(records.device == device)
        if len(mine) < LEAST_LINKS:
            tell()
            continue
        fine_m, fine_width_m = _finer(_log_likelihood(model, mine, coarse_m), model.temper, coarse_m, width_m)
        yield _place(int(device), fine_m, _log_likelihood(model, mine, fine_m), model.temper, fine_width_m, len(mine),
                     cdist(fine_m, fine_m))
        tell()


def whole_area(model: Corrected, records: Records) -> tuple[float, float, float, float]:
    """West, east, south and north end of where devices may be: around all ends that are known."""
    known = np.vstack([records.receiver_m[:, :2], model.device_m[:, :2]])
    (west, south), (east, north) = known.min(axis=0) - AROUND_M, known.max(axis=0) + AROUND_M
    return west, east, south, north


def calibrated_temper(models: list[Corrected], held_out: list[Records], area_m: tuple[float, float, float, float],
                      seed: int) -> float:
    """The power of the likelihood with which as many places lie within their radius as ought to.

    Links of one device err alike, and what was learned on other days is not all that holds today; so the likelihood
    alone is too sure of itself. Tried on devices of known position with models that have not seen their links
    (Holmes and Walker 2017, 'Assigning a value to a power likelihood in a general Bayesian model', Biometrika 104).

    Args:
        models: as many as folds, each learned without one.
        held_out: links of each fold, devices where they are.
        area_m: as of `locate`.
        seed: of which devices are taken.

    Returns:
        the power; 1 where devices are too few to tell
    """
    if len(np.unique(np.concatenate([records.device for records in held_out]))) < LEAST_DEVICES:
        return 1.0
    coarse_m, width_m = _grid(area_m)
    tasks = [(model, records, device) for model, records in zip(models, held_out)
             for device in np.flatnonzero(np.bincount(records.device) >= LEAST_LINKS)]
    chosen = np.random.default_rng(seed).permutation(len(tasks))[:MOST_TASKS]
    inside = np.zeros(len(TEMPERS))
    for number in chosen:
        model, records, device = tasks[number]
        mine = records.select(records.device == device)
        fine_m, fine_width_m = _finer(_log_likelihood(model, mine, coarse_m), TEMPERS[-1], coarse_m, width_m)
        log_likelihood, apart_m = _log_likelihood(model, mine, fine_m), cdist(fine_m, fine_m)
        for i, temper in enumerate(TEMPERS):
            place = _place(int(device), fine_m, log_likelihood, temper, fine_width_m, 0, apart_m)
            inside[i] += np.hypot(*(records.device_m[device, :2] - (place.x_m, place.y_m))) <= place.radius_m
    enough = np.flatnonzero(inside >= CREDIBLE * len(chosen))
    return float(TEMPERS[enough[0]] if len(enough) else TEMPERS[-1])


def device_spread_db(side: Side, fit: Solution) -> float:
    """Standard deviation of what the training links of a device have in common [dB], beyond what single links make of
    their mean (method of moments)."""
    problem = side.training
    expected = expect(problem, fit)
    slope = np.broadcast_to(expected.slope, problem.level_db.shape)
    # At a receiver that passes little on a device's own level does not show.
    seen = np.isfinite(problem.level_db) & (slope > LEAST_SLOPE)
    rest_db, scale_db = (residual_db(problem, fit) / slope)[seen], (expected.scale_db / slope)[seen]
    device = side.records.device[side.train][seen]
    rest_db = np.clip(rest_db, -4 * scale_db, 4 * scale_db)
    count = np.bincount(device)
    enough = count >= LEAST_LINKS
    if enough.sum() < LEAST_LINKS:
        return 0.0
    mean_db = np.bincount(device, weights=rest_db)[enough] / count[enough]
    within = np.bincount(device, weights=rest_db**2)[enough] / count[enough] - mean_db**2
    noise = (within / (count[enough] - 1)).mean()
    return float(np.sqrt(max(mean_db.var() - noise, 0.0)))


def _log_likelihood(model: Corrected, mine: Records, places_m: np.ndarray) -> np.ndarray:
    """(c,) of the links of one device, if it stood at places (c, 2)."""
    cells = max(LINKS_AT_ONCE // len(mine), 1)
    return np.concatenate([_log_likelihood_at(model, mine, places_m[first:first + cells])
                           for first in range(0, len(places_m), cells)])


def _log_likelihood_at(model: Corrected, mine: Records, places_m: np.ndarray) -> np.ndarray:
    """The same, for all places at once."""
    links, cells, spread_db = len(mine), len(places_m), model.device_spread_db
    height_m = mine.device_m[mine.device[0], 2]
    rows = np.tile(np.arange(links), cells)
    every = replace(
        mine.select(rows), device=len(model.device_m) + np.repeat(np.arange(cells), links),
        device_m=np.vstack([model.device_m, np.column_stack([places_m, np.full(cells, height_m)])]),
        # Effects count devices as the model does; the file may have others.
        device_names=[f"device {i}" for i in range(len(model.device_m) + cells)], anchors=frozenset())
    every.__dict__["first_s"] = model.first_s
    every.__dict__["time_in_flight_s"] = mine.time_in_flight_s[rows]
    everything, base = np.ones(len(every), dtype=bool), model.base
    side = Side(every, everything, everything, base, base.mean_db(every), *base.columns(every), base.group(every),
                model.dof)
    problem = side.with_parts([side.part(*each) for each in model.effects]).problem(slice(None))
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if spread_db > 0 else 1)
    values = []
    for node, weight in zip(nodes, weights / weights.sum()):
        moved = replace(problem, gain_db=problem.gain_db + node * spread_db)
        values.append(np.log(weight) - nll(moved, model.solution).reshape(cells, links).sum(axis=1))
    return np.logaddexp.reduce(values, axis=0)


def _finer(log_likelihood: np.ndarray, temper: float, coarse_m: np.ndarray,
           width_m: float) -> tuple[np.ndarray, float]:
    """Centres (c, 2) of finer cells where nearly all of the probability is, and their width [m]: the fewer the coarse
    cells (k,) that hold it, the finer."""
    share = _share(temper * log_likelihood)
    order = np.argsort(-share)
    held = order[:int(np.searchsorted(np.cumsum(share[order]), HELD)) + 1]
    times = int(np.clip(np.sqrt(FINE_CELLS / len(held)), 1, FINEST))
    steps_m = (np.arange(times) + 0.5) * width_m / times - width_m / 2
    around_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    return (coarse_m[held, None] + around_m).reshape(-1, 2), width_m / times


def _share(log_likelihood: np.ndarray) -> np.ndarray:
    share = np.exp(log_likelihood - log_likelihood.max())
    return share / share.sum()


def _place(device: int, places_m: np.ndarray, log_likelihood: np.ndarray, temper: float, width_m: float, links: int,
           apart_m: np.ndarray) -> Place:
    """Of places (c, 2) with a likelihood (c,), apart (c, c) [m]. The likelihood as it is says where, the tempered one
    how surely."""
    best = int((apart_m @ _share(log_likelihood)).argmin())
    order = np.argsort(apart_m[best])
    reached = int(np.searchsorted(np.cumsum(_share(temper * log_likelihood)[order]), CREDIBLE))
    radius_m = apart_m[best][order[min(reached, len(order) - 1)]] + width_m / 2
    return Place(device, float(places_m[best, 0]), float(places_m[best, 1]), float(radius_m), links)


def _grid(area_m: tuple[float, float, float, float]) -> tuple[np.ndarray, float]:
    """Centres (c, 2) of the coarse cells, and their width [m]."""
    west, east, south, north = area_m
    width_m = max(np.sqrt((east - west) * (north - south) / COARSE_CELLS), 1.0)
    x, y = (np.arange(low + width_m / 2, high + width_m / 2, width_m) for low, high in ((west, east), (south, north)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), width_m
