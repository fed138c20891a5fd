"""Test by permutations on which variables a residual depends; estimate the noise of readings."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.inference.dependence import Series, holm, levels_of, permutation_p_value
from radiotwin.links import Links, residual_variables
from radiotwin.links.sites import repeats_at_places, shared_names
from radiotwin.runtime.pieces import cached

MAX_LINKS = 20_000  # of more links, whole series are sampled
MAX_Z = 4.0  # residuals are clipped to this many scales


@dataclass(frozen=True)
class ResidualDependence:
    """Test of the residual's dependence on one variable.

    Attributes:
        variable: name of the variable.
        p_value: corrected for the number of variables (Holm 1979).
        effect_db: standard deviation of the residual's mean over the variable [dB].
    """

    variable: str
    p_value: float
    effect_db: float


def dependences(model: CrossFit, seed: int) -> list[ResidualDependence]:
    """Test on which variables a model's held-out residual depends; the most significant first.

    Left out are links with a fault that the training links of their fold do not show. The `seed`
    draws the permutations of the tests.
    """
    mean_db = model.held_out_mean_db
    residual_db = np.where(model.not_learnable, np.nan, model.links.level_db - mean_db)
    inputs = model.links, residual_db, model.held_out_reading[1], mean_db, seed
    return cached("dependences", inputs, lambda: _tested(*inputs),
                  lambda found: ({}, [asdict(each) for each in found]), _read)


def significant(dependences: list[ResidualDependence],
                criteria: SelectionCriteria) -> list[ResidualDependence]:
    """Return the dependences with a small p-value and at least `min_dependence_db`."""
    return [each for each in dependences if each.p_value <= criteria.max_dependence_p_value
            and each.effect_db >= criteria.min_dependence_db]


def _read(_: dict[str, np.ndarray], content: Any) -> list[ResidualDependence]:
    return [ResidualDependence(str(each["variable"]), float(each["p_value"]),
                               float(each["effect_db"])) for each in content]


def _tested(links: Links, residual_db: np.ndarray, scale_db: np.ndarray, mean_db: np.ndarray,
            seed: int) -> list[ResidualDependence]:
    """Run the tests of `dependences`: residual, error scale and prediction (n,) each [dB]."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(np.isfinite(residual_db))
    if len(rows) > MAX_LINKS:
        # Whole series are kept, so that correlated neighbours stay together.
        series = links.track[rows] * len(links.device_names) + links.device[rows]
        shuffled = rng.permutation(np.unique(series))
        total = np.cumsum(np.bincount(series, minlength=shuffled.max() + 1)[shuffled])
        fits = total <= MAX_LINKS
        rows = rows[np.isin(series, shuffled[fits])] if fits.any() else rows[:MAX_LINKS]
    part = links.select(rows)
    z = np.clip(residual_db[rows] / scale_db[rows], -MAX_Z, MAX_Z)
    z = z - z.mean()
    label = part.track * len(part.device_names) + part.device
    series = Series.sort(np.unique(label, return_inverse=True)[1], np.nan_to_num(part.time_s))
    found = []
    for name, values in residual_variables(part, mean_db[rows]).items():
        level = levels_of(values)
        if level is None:
            continue
        count = np.bincount(level)
        means = np.bincount(level, weights=residual_db[rows]) / np.maximum(count, 1)
        squares = (means - residual_db[rows].mean()) ** 2
        effect_db = float(np.sqrt(np.average(squares, weights=count)))
        found.append((permutation_p_value(level, z, series, rng), name, effect_db))
    found.sort(key=lambda each: (each[0], -each[2]))
    corrected = holm(np.array([p_value for p_value, _, _ in found]))
    return [ResidualDependence(name, float(p_value), effect_db)
            for p_value, (_, name, effect_db) in zip(corrected, found, strict=True)]


def noise_floor_db(links: Links, criteria: SelectionCriteria) -> float:
    """Estimate the standard deviation of one reading from repeats at one position [dB].

    NaN with fewer than `min_repeats_for_noise` repeats.
    """
    repeats = repeats_at_places(links).without(list(shared_names(links)))
    freedom = round(float(repeats.freedom.sum()))
    if freedom < criteria.min_repeats_for_noise:
        return float("nan")
    return float(np.sqrt(repeats.squares_db2.sum() / freedom))
