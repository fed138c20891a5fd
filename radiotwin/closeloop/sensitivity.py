"""How large an effect would have had to be, to be seen in these measurements.

For each family a typical pattern is laid beside what the base may be wrong in
(`radiotwin.closeloop.hypotheses`): the size at which the expected evidence makes it probable
enough to be named. A search has conditions of its own, as that devices agree or that flights differ
little: so the pattern is also laid into the residual, larger and larger until the effect's search
proposes what explains it. What was not named and is smaller may be there. Only what was looked for
in these links is asked, and a size counts only within what its effect allows.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.hypotheses import Hypotheses
from radiotwin.closeloop.posterior import features, probability_of
from radiotwin.closeloop.typical_patterns import Pattern, typical_patterns
from radiotwin.effects import (
    episode,
    excess_attenuation,
    foliage,
    gain_offsets,
    missing_obstacle,
    position_errors,
)
from radiotwin.effects.base import GainEffect, Term
from radiotwin.effects.body_shadowing import Body, BodyShadowing
from radiotwin.effects.params import quantities
from radiotwin.effects.residual_view import ResidualView
from radiotwin.effects.sector_antenna import SectorAntenna, SectorPattern
from radiotwin.effects.vegetation import max_loss_db
from radiotwin.links import LinkData

MAX_NATS = 1e4  # more are not looked for
LARGER, MAX_TRIALS = 2.0, 5  # times the size before, where a search does not find it
EXPLAINED = 0.3  # of what the true pattern explains; what is found so is refined later
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
               there: Set[str] = frozenset()) -> list[Detectable]:
    """Return the least size that would have been named of each family that was looked for.

    Args:
        view: training links and residual of the last model.
        hypotheses: about what it lacks.
        criteria: with the probability that is needed.
        there: names of the effects of that model.
    """
    found: dict[tuple[type[GainEffect], str, str], list[float]] = {}
    rest_db, noise_db = hypotheses.sizes_db
    searches: dict[type[GainEffect], GainEffect] = {}
    for each in typical_patterns(view):
        search = searches.setdefault(each.effect, each.effect())
        named = search.name in there and not search.repeatable  # as all there can be of it
        if named or search.unavailable(view.links) is not None:
            continue
        information = hypotheses.information(each.change_db)
        nats = needed_nats(search.name, criteria.min_probability, rest_db / noise_db,
                           bool(there - {search.name})) + 0.5 * np.log(len(view.links))
        size = float(np.sqrt(2 * nats / information)) if information > 0 else np.inf
        low, high = _bounds(each.effect, view.links)
        found.setdefault((each.effect, each.unit, each.what), []).append(
            _size_found(search, view, each, max(size, low), high))
    return [Detectable(effect.name, float(np.median(sizes)), unit, what)
            for (effect, unit, what), sizes in found.items()]


def _size_found(search: GainEffect, view: ResidualView, pattern: Pattern, size: float,
                high: float) -> float:
    """Return the least size from one on at which a search finds a pattern; inf if at none."""
    for _ in range(MAX_TRIALS):
        if size > min(high, MAX_SIZE):
            break
        change_db = pattern.of_size_db(size)
        changed = replace(view, residual_db=view.residual_db + change_db)
        least = EXPLAINED * changed.score(Term.of_offset(change_db))
        if any(changed.score(search.term(view.links, params, view.level_at)) >= least
               for params in search.propose(changed)):
            return size
        size *= LARGER
    return np.inf


def needed_nats(name: str, probability: float, rest_over_noise: float,
                is_another_kind: bool = False) -> float:
    """Return the evidence that makes an effect so probable, if nothing competes with it [nats].

    inf where none does.
    """
    def lack(nats: float) -> float:
        return probability_of(name, features((nats, nats, nats), 0.0, rest_over_noise,
                                             is_another_kind)) - probability

    if lack(0.0) >= 0:
        return 0.0
    return float(brentq(lack, 0.0, MAX_NATS)) if lack(MAX_NATS) > 0 else np.inf


def _bounds(effect: type[GainEffect], links: LinkData) -> tuple[float, float]:
    """Return the least and the largest size that an effect may have, as of `implausible`."""
    known = bool(np.isfinite(links.frequency_hz))
    if effect in (gain_offsets.DeviceGainOffset, gain_offsets.ReceiverGainOffset):
        return gain_offsets.MIN_OFFSET_DB, np.inf
    if effect is episode.Episode:
        return episode.MIN_DB, np.inf
    if effect is position_errors.DevicePositionError:
        return position_errors.MIN_MOVE_M, position_errors.MAX_MOVE_M
    if effect is missing_obstacle.MissingObstacle:
        return 0.0, missing_obstacle.MAX_LOSS_DB
    if effect is foliage.Foliage:
        return 0.0, max_loss_db(links.frequency_hz) if known else foliage.UNKNOWN_MAX_LOSS_DB
    if effect is excess_attenuation.ExcessAttenuation and known:
        # Its pattern is the same at all heights.
        return 0.0, excess_attenuation.max_at_ground_db_km(
            links.frequency_hz, excess_attenuation.MAX_HEIGHT_M)
    if effect in (BodyShadowing, SectorAntenna):
        field = (quantities(Body)["depth_db"] if effect is BodyShadowing else
                 quantities(SectorPattern)["front_to_back_db"])
        return field["low"], field["high"]
    return 0.0, np.inf
