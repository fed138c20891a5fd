"""How large an effect would have had to be, to be seen in these measurements.

For each family a typical pattern is laid beside what the base may be wrong in (`hypotheses`): the
size at which the expected evidence makes it probable enough to be named. A search has conditions of
its own, as that devices agree or that flights differ little: so the pattern is also laid into the
residual, larger and larger until the effect's search proposes what explains it. What was not named
and is smaller may be there. Only what was looked for in these links is asked, and a size counts
only within what its effect allows.
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

MAX_NATS = 1e4  # more are not looked for
LARGER, MAX_TRIALS = 2.0, 5  # times the size before, where a search does not find it
MAX_SIZE = 1e3  # in any unit


@dataclass(frozen=True)
class Detectable:
    """Least size of an effect that would have been named.

    Attributes:
        name: of the effect.
        size: in `unit`; inf where no size would do that the effect may have.
        unit: dB, dB/km or m.
        pattern: what its size is of.
    """

    name: str
    size: float
    unit: str
    pattern: str


def detectable(view: ResidualView, hypotheses: Hypotheses, criteria: SelectionCriteria,
               effects: Iterable[Effect], there: Set[str] = frozenset()) -> list[Detectable]:
    """Return the least size that would have been named of each family that was looked for.

    Args:
        view: training links and residual of the last model.
        hypotheses: about what it lacks.
        criteria: with the probability that is needed.
        effects: of the catalogue.
        there: names of the effects of that model.
    """
    found: dict[tuple[int, Effect, str, str], list[float]] = {}
    rest_db, noise_db = hypotheses.sizes_db
    for effect in effects:
        named = effect.name in there and not effect.repeatable  # as all there can be of it
        if named or effect.is_declared or effect.unavailable(view.links) is not None:
            continue
        for pattern in effect.typical_patterns(view):
            information = hypotheses.information(pattern.change_db)
            nats = needed_nats(effect.name, criteria.min_probability, rest_db / noise_db,
                               bool(there - {effect.name})) + 0.5 * np.log(len(view.links))
            size = float(np.sqrt(2 * nats / information)) if information > 0 else np.inf
            found.setdefault((pattern.rank, effect, pattern.unit, pattern.what), []).append(
                _size_found(effect, view, pattern, max(size, pattern.low)))
    return [Detectable(effect.name, float(np.median(sizes)), unit, what)
            for (_, effect, unit, what), sizes in sorted(found.items(),
                                                         key=lambda each: each[0][0])]


def _size_found(effect: Effect, view: ResidualView, pattern: Pattern, size: float) -> float:
    """Return the least size from one on at which a search finds a pattern; inf if at none."""
    for _ in range(MAX_TRIALS):
        if size > min(pattern.high, MAX_SIZE):
            break
        change_db = pattern.of_size_db(size)
        changed = replace(view, residual_db=view.residual_db + change_db)
        least = EXPLAINED * changed.score(Term.of_offset(change_db))
        if any(changed.score(effect.with_params(params).term(view.links, view.level_at)) >= least
               for params in effect.propose(changed)):
            return size
        size *= LARGER
    return np.inf


def needed_nats(name: str, probability: float, rest_over_noise: float,
                is_another_kind: bool = False) -> float:
    """Return the evidence that makes an effect so probable, if nothing competes with it [nats].

    inf where none does.
    """
    def lack(nats: float) -> float:
        return probability_of(name, features((nats, nats, nats), rest_over_noise,
                                             is_another_kind)) - probability

    if lack(0.0) >= 0:
        return 0.0
    return float(brentq(lack, 0.0, MAX_NATS)) if lack(MAX_NATS) > 0 else np.inf
