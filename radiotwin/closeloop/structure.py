"""What the residual depends on: one test for each variable, against permutations that keep what is alike together."""

from dataclasses import dataclass

import numpy as np

from radiotwin.closeloop.records import Records

BINS = 10
CELL_M = 60.0  # on the ground, of places
PERMUTATIONS = 2500
ENOUGH = 20  # permutations that are stronger than what was observed
MOST_LINKS = 20_000
MOST_Z = 4.0  # an outlier counts as this many scales
LEAST_LEVELS = 2


@dataclass(frozen=True)
class Driver:
    """A variable and whether the residual depends on it.

    Attributes:
        variable: its name.
        p_value: corrected for the number of variables (Holm 1979).
        effect_db: standard deviation of the residual's mean over the variable [dB].
    """

    variable: str
    p_value: float
    effect_db: float


def find_drivers(records: Records, residual_db: np.ndarray, scale_db: np.ndarray, mean_db: np.ndarray,
                 seed: int) -> list[Driver]:
    """Test all variables that the data has.

    Args:
        records: n links.
        residual_db, scale_db, mean_db: (n,) on held-out links; NaN where there is none.
        seed: of the permutations.

    Returns:
        the strongest first
    """
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(np.isfinite(residual_db))
    if len(rows) > MOST_LINKS:
        # Whole series, so that neighbours stay neighbours.
        series = records.track[rows] * len(records.device_names) + records.device[rows]
        names = rng.permutation(np.unique(series))
        kept = np.cumsum(np.bincount(series, minlength=names.max() + 1)[names]) <= MOST_LINKS
        rows = rows[np.isin(series, names[kept])] if kept.any() else rows[:MOST_LINKS]
    part = records.select(rows)
    z = np.clip(residual_db[rows] / scale_db[rows], -MOST_Z, MOST_Z)
    z = z - z.mean()
    series = np.unique(part.track * len(part.device_names) + part.device, return_inverse=True)[1]
    order = np.lexsort((np.arange(len(rows)), np.nan_to_num(part.time_s), series))
    starts = np.flatnonzero(np.r_[True, np.diff(series[order]) > 0, True])
    results = []
    for name, values in variables(part, mean_db[rows]).items():
        level = _levels(values)
        if level is None:
            continue
        observed = _between(level, z)
        permuted = _shifted if _moves_in_series(level[order], starts) else _swapped
        beaten, tried = 0, 0
        while tried < PERMUTATIONS and beaten < ENOUGH:  # (Besag and Clifford 1991, 'Sequential Monte Carlo p-values')
            beaten += _between(level, permuted(z, order, starts, rng)) >= observed
            tried += 1
        means = np.bincount(level, weights=residual_db[rows]) / np.maximum(np.bincount(level), 1)
        effect_db = float(np.sqrt(np.average((means - residual_db[rows].mean()) ** 2, weights=np.bincount(level))))
        results.append((beaten / tried if beaten == ENOUGH else (beaten + 1) / (tried + 1), name, effect_db))
    return _holm(results)


def variables(records: Records, mean_db: np.ndarray) -> dict[str, np.ndarray]:
    """Everything that a residual may depend on; integers are labels, NaN is unknown."""
    middle_m = 0.5 * (records.receiver_m + records.device_m[records.device])
    cells = [np.unique(np.floor(place_m[:, :2] / CELL_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
             for place_m in (middle_m, records.receiver_m)]
    return {
        "distance_m": records.distance_m, "elevation_deg": records.elevation_deg, "azimuth_deg": records.azimuth_deg,
        "body_azimuth_deg": records.body_azimuth_deg, "heading_deg": records.heading_deg,
        "time_in_flight_s": records.time_in_flight_s, "time_s": records.time_s, "flight": records.flight,
        "altitude_m": records.receiver_m[:, 2], "receiver": records.receiver, "device": records.device,
        "los": records.los.astype(int), "predicted_level_db": mean_db,
        "metres_inside_m": records.metres_inside, "diffraction_parameter": records.diffraction_parameter,
        "quality": np.full(len(records), np.nan) if records.quality is None else records.quality,
        "place_of_ray": cells[0], "place_of_receiver": cells[1],
    }


def _levels(values: np.ndarray) -> np.ndarray | None:
    """(n,) bin of each value; None where there is nothing to compare."""
    if values.dtype.kind in "iu":
        level = np.unique(values, return_inverse=True)[1]
        return level if level.max() + 1 >= LEAST_LEVELS and level.max() < len(level) // 5 else None
    if np.isfinite(values).mean() < 0.5 or np.nanstd(values) < 1e-9:
        return None
    edges = np.unique(np.nanquantile(values, np.linspace(0, 1, BINS + 1)[1:-1]))
    level = np.where(np.isfinite(values), np.searchsorted(edges, values), len(edges) + 1)
    level = np.unique(level, return_inverse=True)[1]
    return level if level.max() >= 1 else None


def _between(level: np.ndarray, z: np.ndarray) -> float:
    """Sum of squares between the bins."""
    count = np.maximum(np.bincount(level), 1)
    return float((np.bincount(level, weights=z) ** 2 / count).sum())


def _moves_in_series(level: np.ndarray, starts: np.ndarray) -> bool:
    """Whether the variable changes within most series."""
    changes = np.add.reduceat(np.r_[0, np.diff(level) != 0], starts[:-1])
    changes = changes - (np.r_[0, np.diff(level) != 0][starts[:-1]])
    return bool(np.mean(changes > 0) > 0.5)


def _shifted(z, order, starts, rng):
    """Each series turned round by a random number of slots: neighbours stay neighbours."""
    result = np.empty_like(z)
    length = np.diff(starts)
    shift = (rng.random(len(length)) * length).astype(int)
    place = np.arange(len(z)) - np.repeat(starts[:-1], length)
    source = np.repeat(starts[:-1], length) + (place + np.repeat(shift, length)) % np.repeat(length, length)
    result[order] = z[order][source]
    return result


def _swapped(z, order, starts, rng):
    """Whole series change places: the mean of each goes elsewhere, what is around it stays."""
    length = np.diff(starts)
    means = np.add.reduceat(z[order], starts[:-1]) / length
    result = np.empty_like(z)
    result[order] = z[order] + np.repeat(rng.permutation(means) - means, length)
    return result


def _holm(results: list[tuple[float, str, float]]) -> list[Driver]:
    worst, drivers = 0.0, []
    for rank, (p_value, name, effect_db) in enumerate(sorted(results, key=lambda result: (result[0], -result[2]))):
        worst = max(worst, min(p_value * (len(results) - rank), 1.0))
        drivers.append(Driver(name, worst, effect_db))
    return drivers
