"""Sensitivity of the search: the least size of each effect that would have been named.

For a typical pattern of each effect, the Fisher information given the nuisances (`hypotheses`)
gives the size from which the expected evidence makes it probable enough. An effect's search has
further conditions, for example that devices agree. So the pattern is also added to the residual,
larger and larger, until the search finds it. Smaller effects may be present and are not named.
"""

from __future__ import annotations

from collections.abc import Iterable, Set
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from radiotwin.closeloop.verdict.criteria import EXPLAINED, SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.closeloop.verdict.posterior import features, probability_of
from radiotwin.effects.base import Effect, ResidualView, Term
from radiotwin.effects.patterns import Pattern

MAX_NATS = 1e4  # upper end of the search for the evidence that is needed
GROWTH, MAX_TRIALS = 2.0, 5  # factor by which a size grows until a search finds it; largest number
MAX_SIZE = 1e3  # in the effect's unit


@dataclass(frozen=True)
class Detectable:
    """Least size of an effect from which it would have been named.

    Attributes:
        name: name of the effect.
        size: least size, in `unit`; inf if no allowed size suffices.
        unit: dB, dB/km or m.
        pattern: description of the typical pattern.
    """

    name: str
    size: float
    unit: str
    pattern: str


def detectable(view: ResidualView, hypotheses: Hypotheses, criteria: SelectionCriteria,
               effects: Iterable[Effect], found_names: Set[str] = frozenset()) -> list[Detectable]:
    """Return the least size from which each effect, had it been present, would have been named.

    Left out are effects that were found (unless repeatable), declared or unavailable in the data.

    Args:
        view: training links and residual of the last fit.
        hypotheses: evidence for further effects of that fit.
        criteria: with the probability that is needed.
        effects: effects of the catalogue.
        found_names: names of the effects in that fit.
    """
    found: dict[tuple[int, Effect, str, str], list[float]] = {}
    rest_db, noise_db = hypotheses.rest_and_noise_db
    for effect in effects:
        is_complete = effect.name in found_names and not effect.repeatable
        if is_complete or effect.is_declared or effect.unavailable(view.links) is not None:
            continue
        for pattern in effect.typical_patterns(view):
            information = hypotheses.information(pattern.change_db)
            nats = needed_nats(effect.name, criteria.min_probability, rest_db / noise_db,
                               bool(found_names - {effect.name})) + 0.5 * np.log(len(view.links))
            size = float(np.sqrt(2 * nats / information)) if information > 0 else np.inf
            found.setdefault((pattern.rank, effect, pattern.unit, pattern.what), []).append(
                _size_found(effect, view, pattern, max(size, pattern.low)))
    return [Detectable(effect.name, float(np.median(sizes)), unit, what)
            for (_, effect, unit, what), sizes in sorted(found.items(),
                                                         key=lambda each: each[0][0])]


def _size_found(effect: Effect, view: ResidualView, pattern: Pattern, size: float) -> float:
    """Return the size from which an effect's search finds a pattern added to the residual; or inf.

    The size grows from the given one by `GROWTH` [unit of the pattern]. The search finds the
    pattern if a proposal explains at least `EXPLAINED` of what the pattern itself explains.
    """
    for _ in range(MAX_TRIALS):
        if size > min(pattern.high, MAX_SIZE):
            break
        change_db = pattern.of_size_db(size)
        changed = replace(view, residual_db=view.residual_db + change_db)
        least = EXPLAINED * changed.score(Term.of_offset(change_db))
        if any(changed.score(effect.with_params(params).term(view.links, view.level_at)) >= least
               for params in effect.propose(changed)):
            return size
        size *= GROWTH
    return np.inf


def needed_nats(name: str, probability: float, rest_over_noise: float,
                is_another_kind: bool = False) -> float:
    """Return the least evidence for an effect without rivals to reach a probability [nats]; or inf.

    Args:
        name: name of the effect.
        probability: the probability to be reached.
        rest_over_noise: sd of the residual that depends on the place over the sd of noise.
        is_another_kind: whether an effect of another name was found already.
    """
    def excess(nats: float) -> float:
        return probability_of(name, features((nats, nats, nats), rest_over_noise,
                                             is_another_kind)) - probability

    if excess(0.0) >= 0:
        return 0.0
    return float(brentq(excess, 0.0, MAX_NATS)) if excess(MAX_NATS) > 0 else np.inf
