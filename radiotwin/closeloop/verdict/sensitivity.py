"""How large an effect would have had to be, to be seen in these measurements.

For each family a typical pattern is laid beside what the base may be wrong in (`hypotheses`): the
size at which the expected evidence makes it probable enough to be named. A search has conditions of
its own, as that devices agree or that flights differ little: so the pattern is also laid into the
residual, larger and larger until the effect's search proposes what explains it. What was not named
and is smaller may be there. Only what was looked for in these links is asked, and a size counts
only within what its effect allows.

Changes that a typical effect of each family makes, over the links that were measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import brentq

from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.closeloop.verdict.posterior import features, probability_of
from radiotwin.effects.arrays import ends_above_ground
from radiotwin.effects.base import GainEffect, ResidualView, Term
from radiotwin.effects.boxes import Box, buildings, cross
from radiotwin.effects.catalogue import (
    episode,
    excess_attenuation,
    foliage,
    gain_offsets,
    missing_obstacle,
    position_errors,
)
from radiotwin.effects.catalogue.body_shadowing import Body, BodyShadowing
from radiotwin.effects.catalogue.episode import Episode
from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight, is_first_or_last
from radiotwin.effects.catalogue.foliage import Foliage
from radiotwin.effects.catalogue.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.position_errors import DevicePositionError
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle, only_blocker
from radiotwin.effects.catalogue.sector_antenna import SectorAntenna, SectorPattern
from radiotwin.effects.losses import max_loss_db
from radiotwin.effects.params import quantities
from radiotwin.links import Links

MAX_MEMBERS = 5  # devices, receivers or flights of which the median is taken
MAX_PLACES = 3  # and of boxes in the way, whose search takes longer
MIN_LINKS = 30  # of each
BEAMWIDTH_DEG = 65.0  # of a sector antenna (3GPP TR 38.901, Table 7.3-1)
MOVE_M = 10.0  # of a device, for the slope of levels in its position
EPISODE = 0.1  # share of the time
WIDE_M, BUILDING_M, GROVE_M = 20.0, 15.0, 10.0  # width, and heights, of what hides links
PLACES, SHARES = 40, (0.1, 0.3, 0.5, 0.7, 0.9)  # links that it may stand on, and how far along
MAX_NATS = 1e4  # more are not looked for
LARGER, MAX_TRIALS = 2.0, 5  # times the size before, where a search does not find it
EXPLAINED = 0.3  # of what the true pattern explains; what is found so is refined later
MAX_SIZE = 1e3  # in any unit


@dataclass(frozen=True, eq=False)
class Pattern:
    """A change of levels, as an effect of each size makes it.

    Attributes:
        effect: whose it is.
        unit: of its size: dB, dB/km or m.
        what: its size is of.
        change_db: (n,) of the links' levels, of size 1.
        move_db: the same of a size, where that is not in proportion.
    """

    effect: type[GainEffect]
    unit: str
    what: str
    change_db: np.ndarray
    move_db: Callable[[float], np.ndarray] | None = None

    def of_size_db(self, size: float) -> np.ndarray:
        """Return what an effect of a size changes (n,)."""
        return size * self.change_db if self.move_db is None else self.move_db(size)


def typical_patterns(view: ResidualView) -> Iterator[Pattern]:
    """Yield patterns over n links, of a few members of each family."""
    links = view.links
    for end, label, offset, drift in (
            ("receiver", links.receiver, ReceiverGainOffset, ReceiverDrift),
            ("device", links.device, DeviceGainOffset, DeviceDrift)):
        for mine in _members(label):
            yield Pattern(offset, "dB", f"a constant of one {end}", mine * 1.0)
            yield from _timed(links, mine, end, drift)
    yield from _flights(links)
    yield Pattern(ExcessAttenuation, "dB/km", "on all links, at all heights alike",
                  -links.distance_m / 1000)
    if np.isfinite(links.body_azimuth_deg).any():
        back = 0.5 - 0.5 * np.cos(np.radians(np.nan_to_num(links.body_azimuth_deg)))
        yield Pattern(BodyShadowing, "dB", "behind the receiver's body", -back)
    for mine in _members(links.device):
        off = _signed_deg(links.azimuth_deg - median_azimuth_deg(links.azimuth_deg[mine]))
        yield Pattern(SectorAntenna, "dB",
                      f"front to back of one device, {BEAMWIDTH_DEG:.0f}° wide",
                      mine * -np.minimum(0.5 * (off / BEAMWIDTH_DEG) ** 2, 1.0))
        device = int(links.device[mine][0])
        if device in links.anchors:
            yield _moved(view, device)
    for inside_m in _crossed(links, BUILDING_M):
        yield Pattern(MissingObstacle, "dB", f"of a building {WIDE_M:.0f} m wide and "
                      f"{BUILDING_M:.0f} m high, behind it", -1.0 * (inside_m > 0))
    for inside_m in _crossed(links, GROVE_M):
        yield Pattern(Foliage, "dB", f"of a grove {WIDE_M:.0f} m wide and {GROVE_M:.0f} m high, "
                      "through its middle", -np.minimum(inside_m / WIDE_M, 1.0))
    if links.city is not None:
        yield from _gone(view)


def _moved(view: ResidualView, device: int) -> Pattern:
    """Return what changes if a device stands elsewhere, to the north."""
    def move_db(by_m: float) -> np.ndarray:
        params = DevicePositionError.Params(device=device, move_m=(0.0, by_m))
        return DevicePositionError().term(view.links, params, view.level_at).offset_db

    return Pattern(DevicePositionError, "m", "of one device", move_db(MOVE_M) / MOVE_M, move_db)


def _gone(view: ResidualView) -> Iterator[Pattern]:
    """Yield what changes if a building is not there that hides neither many links nor few.

    Over its mean behind it. One only: every map that is tried has paths of its own.
    """
    links = view.links
    assert links.city is not None
    blocker, (_, centres_m) = only_blocker(links), buildings(links.city)
    hiding = sorted(_frequent(blocker[blocker >= 0]).tolist(),
                    key=lambda each: np.count_nonzero(blocker == each))
    if not hiding:
        return
    building = hiding[len(hiding) // 2]
    params = RemovedObstacle.Params(building=building, exact=True,
                                    centre_m=tuple(centres_m[building].tolist()))
    rise_db = RemovedObstacle().term(links, params, view.level_at).offset_db
    mean_db = float(rise_db[blocker == building].mean())
    if mean_db > 0:
        yield Pattern(RemovedObstacle, "dB", "of a building of the map, behind it on average",
                      rise_db / mean_db)


def _timed(links: Links, mine: np.ndarray, end: str,
           drift: type[GainEffect]) -> Iterator[Pattern]:
    """Yield a drift of links (n,) of one end and, of a receiver, an episode."""
    timed = np.isfinite(links.time_s)
    if timed[mine].mean() <= 0.5 or np.ptp(links.time_s[mine & timed]) == 0:
        return
    first_s, last_s = np.nanmin(links.time_s[mine]), np.nanmax(links.time_s[mine])
    ramp = np.nan_to_num((links.time_s - first_s) / (last_s - first_s))
    yield Pattern(drift, "dB", f"from first to last of one {end}", mine * ramp)
    if end == "receiver":
        # Of the time that it measured: half-way may be between two flights.
        start_s, end_s = np.nanquantile(links.time_s[mine], [0.5 - EPISODE / 2, 0.5 + EPISODE / 2])
        during = (links.time_s >= start_s) & (links.time_s <= end_s)
        yield Pattern(Episode, "dB", f"over {100 * EPISODE:.0f} % of the time of one receiver",
                      -1.0 * (mine & during))


def _flights(links: Links) -> Iterator[Pattern]:
    """Yield a constant of flights between others, as a first or last one may be a step in time."""
    flights = _members(links.track)
    between = [mine for mine in flights if not is_first_or_last(
        int(links.receiver[mine][0]), int(links.flight[mine][0]), links)]
    for mine in between or flights:
        yield Pattern(FaultyFlight, "dB", "a constant of one flight of one receiver, "
                                          "neither its first nor its last", -1.0 * mine)


def _crossed(links: Links, high_m: float) -> Iterator[np.ndarray]:
    """Yield lengths (n,) of links with line of sight in boxes that such a link passes [m]."""
    rows = np.flatnonzero(links.los)
    a_m, b_m = ends_above_ground(links, rows)
    passed = np.linspace(0, len(rows) - 1, min(PLACES, len(rows))).astype(int)
    found = []
    for link, share in product(passed.tolist(), SHARES):
        x_m, y_m = (a_m[link, :2] + share * (b_m[link, :2] - a_m[link, :2])).tolist()
        inside_m = cross(Box(x_m, y_m, WIDE_M, WIDE_M, high_m, 0.0), a_m, b_m).inside_m
        inside_m = np.where(inside_m > 0, inside_m, 0.0)
        if np.count_nonzero(inside_m) >= MIN_LINKS:
            found.append(inside_m)
    found.sort(key=np.count_nonzero)
    for each in found[_spread(len(found), MAX_PLACES)]:
        own = np.zeros(len(links))
        own[rows] = each
        yield own


def median_azimuth_deg(azimuth_deg: np.ndarray) -> float:
    """Return the median of directions (n,), taken around their mean: there is no step at north."""
    mean_deg = np.degrees(np.angle(np.exp(1j * np.radians(azimuth_deg)).sum()))
    return float((mean_deg + np.median(_signed_deg(azimuth_deg - mean_deg))) % 360)


def _signed_deg(angle_deg: np.ndarray) -> np.ndarray:
    """Return the same angles from -180 up to 180 [deg]."""
    return (angle_deg + 180) % 360 - 180


def _members(label: np.ndarray) -> list[np.ndarray]:
    """Return masks (n,) of some labels with links enough, if there are two at least."""
    frequent = _frequent(label)
    if len(frequent) < 2:
        return []
    return [label == each for each in frequent[_spread(len(frequent), MAX_MEMBERS)]]


def _frequent(label: np.ndarray) -> np.ndarray:
    """Return the labels that `MIN_LINKS` have."""
    values, counts = np.unique(label, return_counts=True)
    return values[counts >= MIN_LINKS]


def _spread(count: int, maximum: int) -> slice:
    """Return which of so many to take, evenly from first to last, `maximum` of them at most."""
    return slice(None, None, -(-count // maximum) or 1)


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


def _bounds(effect: type[GainEffect], links: Links) -> tuple[float, float]:
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
