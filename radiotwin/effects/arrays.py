"""Helpers that effects share: cache per links, heights of ends, subsamples, powers, curves."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.links import Links
from radiotwin.scene.citymap import CityMap

NEPERS = np.log(10) / 10  # natural logarithm of power per decibel
MIN_POWER = 1e-290  # smallest argument of a logarithm
MIN_LINKS = 60  # least number of links to search for an effect, unless it has its own
MIN_NATS = 5.0  # gain of the log-likelihood, by a quick estimate, above which effects are proposed


class LinkCache:
    """Cache of values derived from links, kept for as long as those links are in use."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[Links, dict] = WeakKeyDictionary()

    def get(self, links: Links, key: Hashable, derive: Callable[[], Any]) -> Any:
        """Return the value of `derive()`, called only once for these links and this key."""
        known = self._known.setdefault(links, {})
        if key not in known:
            known[key] = derive()
        return known[key]

    def __reduce__(self) -> tuple[type, tuple[()]]:
        """Pickle as an empty cache: weak references cannot be sent to another process."""
        return type(self), ()

    def state(self) -> None:
        """Return nothing for the key of cached results: the values can be derived again."""


def city_of(links: Links, effect: str) -> CityMap:
    """Return the 3D map of links; `effect` is the name of the effect that needs it.

    Raises:
        BadInput: there is no map.
    """
    if links.city is None:
        raise BadInput(f"the effect {effect} needs a 3D map, and none is given; give it with "
                       "--scene")
    return links.city


def ends_above(links: Links, place_m: Sequence[float],
               rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends (n, 3) of links, with z counted from the ground height at one place [m].

    Args:
        links: links; without a 3D map the ground is at z = 0.
        place_m: x and y of the place [m].
        rows: n rows of the links.
    """
    ends_m = links.device_m[links.device[rows]], links.receiver_m[rows]
    if links.city is None or links.city.terrain is None:
        return ends_m
    base_m = [0.0, 0.0, float(links.city.ground_height_m(*place_m))]
    return ends_m[0] - base_m, ends_m[1] - base_m


def ends_above_ground(links: Links, rows: np.ndarray | slice = slice(None)
                      ) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends (n, 3) of links, z above the ground below each end [m].

    Args:
        links: links; without a 3D map the ground is at z = 0.
        rows: n rows of the links.
    """
    ends_m = links.device_m[links.device[rows]].copy(), links.receiver_m[rows].copy()
    if links.city is not None and links.city.terrain is not None:
        for end_m in ends_m:
            end_m[:, 2] -= links.city.ground_height_m(*end_m[:, :2].T)
    return ends_m


def subsample(rows: np.ndarray, maximum: int) -> np.ndarray:
    """Draw `maximum` of the rows (n,) at random (fixed seed), sorted; if fewer, return all as is.

    Every k-th row would be biased: devices, receivers and slots take turns in a file.
    """
    if len(rows) <= maximum:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, maximum, replace=False))


def one_hot(index: np.ndarray, members: list[int]) -> np.ndarray:
    """Build the indicator matrix (n, members): 1 if the index (n,) is the member, else 0."""
    return (index[:, None] == np.asarray(members)[None]).astype(float)


def frequent_labels(index: np.ndarray, minimum: int) -> list[int]:
    """List the values of an index (n,) that occur at least `minimum` times, in order."""
    values, counts = np.unique(index, return_counts=True)
    return [int(value) for value, count in zip(values, counts, strict=True) if count >= minimum]


def frequent_anchors(links: Links, minimum: int) -> list[int]:
    """List the devices of declared position with at least `minimum` links, in order.

    The error of a position estimated from these links looks like a move or an antenna pattern.
    """
    return [device for device in frequent_labels(links.device, minimum) if device in links.anchors]


def squares_about_mean(values: np.ndarray, weight: np.ndarray) -> float:
    """Compute the weighted sum of squares of values (n,) about their weighted mean."""
    return weight @ (values - weight @ values / weight.sum()) ** 2


def add_power(level_db: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add the powers of a level in dB and of a second signal given as linear power.

    Args:
        level_db: (n,) level [dB].
        power: (n,) added power, linear; 1 is 0 dB.

    Returns:
        (n,) level of the sum [dB], and (n,) its derivative with respect to `level_db`.
    """
    first = np.maximum(np.exp(level_db * NEPERS), MIN_POWER)
    total = first + power
    return np.log(total) / NEPERS, first / total


def curve_columns(value: np.ndarray, knots: int, circular: bool) -> np.ndarray:
    """Build columns (n, ≤ knots) of a piecewise linear curve over values (n,); 0 if unknown."""
    places = curve_knots(value[np.isfinite(value)], knots, circular)
    return curve_basis(value, np.array(places), circular)


def curve_knots(value: np.ndarray, count: int, circular: bool) -> list[float]:
    """Place knots evenly on the circle [deg], or at evenly spaced quantiles, equal ones merged."""
    if circular:
        return (np.arange(count) * 360.0 / count).tolist()
    return np.unique(np.quantile(value, (np.arange(count) + 0.5) / count)).tolist()


def curve_basis(value: np.ndarray, knots: np.ndarray, circular: bool) -> np.ndarray:
    """Build hat functions (n, knots) at values (n,), the basis of a piecewise linear curve.

    The curve is constant beyond the outer knots; `circular` values are angles [deg]. The row of a
    value that is NaN or infinite is 0.
    """
    known = np.isfinite(value)
    filled = np.where(known, value, knots[0])
    if circular:
        position = filled % 360 / 360 * len(knots)
        left = np.floor(position).astype(int) % len(knots)
        right, share = (left + 1) % len(knots), position % 1
    else:
        position = np.interp(filled, knots, np.arange(len(knots)))
        left = np.minimum(np.floor(position).astype(int), len(knots) - 1)
        right, share = np.minimum(left + 1, len(knots) - 1), position - left
    hats = np.zeros((len(value), len(knots)))
    rows = np.arange(len(value))
    np.add.at(hats, (rows, left), 1 - share)
    np.add.at(hats, (rows, right), share)
    return hats * known[:, None]
