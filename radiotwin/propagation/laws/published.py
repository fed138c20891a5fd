"""Published path loss laws, not fitted: their base class; COST 231 and ITU-R P.1411 for cities.

They are priors if no device of known position was measured, and baselines otherwise. A law has a
LoS and a NLoS branch. A 3D map decides which one applies; without a map both are mixed by the
law's probability of line of sight.

Recommendations are written for a fixed station and a terminal. Propagation is reciprocal, so most
laws here take the height of the higher and of the lower end above the ground. Laws of aerial
terminals are in `aerial`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from typing_extensions import override

from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import Limit
from radiotwin.io.texts import percent, shortly
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.base import MAX_DB, ChannelModel, require_names, require_number
from radiotwin.scene.citymap import CityMap

MAX_FACTOR = 2.0  # a law is extrapolated to this factor beyond its frequencies, with a warning
MIN_ROOF_M = 2.5  # lowest building
GRID = 128  # points along each side of the map at which roof heights are sampled
MAX_ROOF_M = 1e4  # highest mean roof in a file
Bounds = tuple[float | np.ndarray, float | np.ndarray]
"""Least and greatest value, one for all links or (n,)."""
# COST 231 Walfisch-Ikegami
BUILDING_M = 35.0  # distance between buildings: the middle of the report's 20 to 50 m
STREET_M = BUILDING_M / 2  # street width, the report's default
STREET_ANGLE_DEG = 90.0  # between street and direct path, the report's default
MIN_BELOW_ROOF_M = 1.0  # least height of roofs over the mobile
LOS_M = 20.0  # least distance of the LoS law, which equals free space there
# The report gives a standard deviation of 4 to 8 dB: the ends are used for LoS and NLoS.
LOS_SD_DB, NLOS_SD_DB = 4.0, 8.0
BASE_M, MOBILE_M = (4.0, 50.0), (1.0, 3.0)  # ranges of antenna heights
# ITU-R P.1411-12: alpha, beta [dB], gamma, sd [dB], for NLoS, for LoS
BELOW_ROOFS = (4.00, 10.2, 2.36, 7.60), (2.12, 29.2, 2.11, 5.06)  # Table 4
OVER_ROOFS = (4.39, -6.27, 2.30, 6.89), (2.29, 28.6, 1.96, 3.48)  # Table 8
# Ranges of distance of the same rows [m]
BELOW_ROOFS_M, OVER_ROOFS_M = ((30.0, 715.0), (5.0, 660.0)), ((260.0, 1200.0), (55.0, 1200.0))


class Validity(NamedTuple):
    """Ranges of parameters for which a law was published.

    Attributes:
        frequency_hz: of the radio [Hz].
        distance_m: between the ends [m].
        high_m, low_m: height of the higher and of the lower end above the ground [m].
    """

    frequency_hz: Bounds
    distance_m: Bounds
    high_m: Bounds = (0.0, np.inf)
    low_m: Bounds = (0.0, np.inf)


class Branch(NamedTuple):
    """Median path loss (n,) [dB] in LoS, or in NLoS, and standard deviation of shadowing [dB]."""

    loss_db: np.ndarray
    sd_db: np.ndarray | float


class PublishedLaw(ChannelModel):
    """A published path loss law; the predicted gain is minus its median loss.

    Attributes:
        source: recommendation, and section or table.
        frequency_range_hz: least and greatest published frequency [Hz].
        needs_map: True if the law has no LoS probability, so that a map must decide.
        frequency_hz: of the radio [Hz].
        with_map: True if `los` of links decides the branch; False: the LoS probability.
        roof_m: mean height of the map's roofs [m]; 0 without a map.
        power_dbm: transmit power if levels are received powers [dBm]; 0 for gains.
    """

    uses_map = True
    needs_map: ClassVar[bool] = False
    source: ClassVar[str]
    frequency_range_hz: ClassVar[tuple[float, float]]

    def __init__(self, frequency_hz: float = np.nan, with_map: bool = False, roof_m: float = 0.0,
                 power_dbm: float = 0.0) -> None:
        self.frequency_hz, self.with_map = frequency_hz, with_map
        self.roof_m, self.power_dbm = roof_m, power_dbm

    @abstractmethod
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return loss and shadowing of n links by the LoS branch, or the NLoS branch."""

    @abstractmethod
    def validity(self, links: LinkGeometry) -> Validity:
        """Return the published ranges of parameters for n links."""

    def los_probability(self, links: LinkGeometry) -> np.ndarray:
        """Return the probability (n,) of line of sight; subclasses with `needs_map` have none."""
        raise NotImplementedError(f"{self.name} has no probability of line of sight")

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        """Take frequency and, if `needs_map`, mean roof height from the links, nothing from levels.

        Raises:
            BadInput: the frequency is unknown or far out of range, or the law needs a map with
                buildings and there is none.
        """
        low_hz, high_hz = self.frequency_range_hz
        if not low_hz / MAX_FACTOR <= links.frequency_hz <= high_hz * MAX_FACTOR:
            given = ("is not known; give frequency_hz" if np.isnan(links.frequency_hz)
                     else f"is {links.frequency_hz / 1e9:g} GHz; take another model")
            raise BadInput(f"the radio's frequency {given}: {self.name} ({self.source}) holds from "
                           f"{low_hz / 1e9:g} to {high_hz / 1e9:g} GHz, and is used from half to "
                           "twice that")
        self.frequency_hz, self.with_map = links.frequency_hz, links.city is not None
        if self.needs_map:
            if links.city is None:
                raise BadInput(f"{self.name} needs a 3D map, which says which links have line of "
                               "sight and how high roofs are; give a scene, or take tr36777_uma or "
                               "al_hourani_urban, which have a probability of line of sight")
            self.roof_m = mean_roof_m(links.city)
            if self.roof_m == 0.0:
                raise BadInput(f"{self.name} is a law of cities, and the 3D map has no building "
                               f"above {MIN_ROOF_M:g} m; take another model")
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Predict mean and standard deviation (n,) [dB] by the LoS and NLoS branches.

        LoS has the weight 1 or 0 by the map, or else its published probability. The variance is the
        mean of both variances plus the variance between the two medians.
        """
        los, nlos = self.branch(links, True), self.branch(links, False)
        los_share = links.los.astype(float) if self.with_map else self.los_probability(links)
        loss_db = los_share * los.loss_db + (1 - los_share) * nlos.loss_db
        variance = (los_share * np.square(los.sd_db) + (1 - los_share) * np.square(nlos.sd_db)
                    + los_share * (1 - los_share) * (los.loss_db - nlos.loss_db) ** 2)
        return self.power_dbm - loss_db, np.sqrt(variance)

    def outside(self, links: LinkGeometry) -> list[str]:
        """Return a message for each quantity, such as distance, outside its published range."""
        found = []
        for what, value, least, greatest, unit in self._quantities(links):
            out = (value < least) | (value > greatest)
            if not out.any():
                continue
            ends = dict.fromkeys((shortly(value[out].min()), shortly(value[out].max())))
            share = "" if (value == value[0]).all() and out.all() else f" in {percent(out.mean())}"
            ranges = sorted(set(zip(least[out].tolist(), greatest[out].tolist(), strict=True)))
            published = " or ".join(
                f"{low:g} and more" if np.isinf(high) else f"{low:g} to {high:g}"
                for low, high in ranges)
            found.append(f"{self.name} is used outside what {self.source} was published for: the "
                         f"{what} is {' to '.join(ends)} {unit}{share and share + ' of the links'}"
                         f", published is {published} {unit}")
        return found

    def inside(self, links: LinkGeometry) -> np.ndarray:
        """Return (n,) bool: all quantities of the link are within the law's validity."""
        result = np.ones(len(links), dtype=bool)
        for _, value, least, greatest, _ in self._quantities(links):
            result &= (value >= least) & (value <= greatest)
        return result

    def _quantities(self, links: LinkGeometry,
                    ) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray, str]]:
        """List name, value, least and greatest published value (n,), and unit of all quantities."""
        high_m, low_m = ends_m(links)
        valid = self.validity(links)
        least_hz, greatest_hz = valid.frequency_hz
        frequency_ghz = np.full(len(links), self.frequency_hz / 1e9)
        quantities = [
            ("frequency", frequency_ghz, (np.divide(least_hz, 1e9), np.divide(greatest_hz, 1e9)),
             "GHz"),
            ("distance", links.distance_m, valid.distance_m, "m"),
            ("height of the higher end", high_m, valid.high_m, "m"),
            ("height of the lower end", low_m, valid.low_m, "m")]
        return [(what, value, np.broadcast_to(least, value.shape),
                 np.broadcast_to(greatest, value.shape), unit)
                for what, value, (least, greatest), unit in quantities if len(value)]

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return {}, {"frequency_hz": float(self.frequency_hz), "with_map": bool(self.with_map),
                    "roof_m": float(self.roof_m), "power_dbm": float(self.power_dbm)}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore the law from its `state`, after checking it against the law's ranges."""
        require_names("arrays", arrays, [])
        require_names("settings", settings, ["frequency_hz", "with_map", "roof_m", "power_dbm"])
        if not isinstance(settings["with_map"], bool):
            raise ValueError("with_map is neither true nor false")
        if cls.needs_map and not settings["with_map"]:
            raise ValueError(f"{cls.name} needs a map")
        low_hz, high_hz = cls.frequency_range_hz
        frequency_hz = require_number(settings, "frequency_hz", low_hz / MAX_FACTOR,
                                      high_hz * MAX_FACTOR)
        roof_m = require_number(settings, "roof_m", MIN_ROOF_M if cls.needs_map else 0.0,
                                MAX_ROOF_M)
        return cls(frequency_hz, settings["with_map"], roof_m,
                   require_number(settings, "power_dbm", -MAX_DB, MAX_DB))


def heights_m(links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights of devices (n,) and of receivers (n,) above the ground [m]."""
    device_m, receiver_m = links.device_m[:, 2], links.receiver_m[:, 2]
    if links.city is not None and links.city.terrain is not None:
        device_m = device_m - links.city.ground_height_m(*links.device_m[:, :2].T)
        receiver_m = receiver_m - links.city.ground_height_m(*links.receiver_m[:, :2].T)
    return device_m, receiver_m


def ends_m(links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights above the ground of the higher and of the lower end, (n,) each [m]."""
    both_m = heights_m(links)
    return np.maximum(*both_m), np.minimum(*both_m)


def ground_m(links: LinkGeometry) -> np.ndarray:
    """Return the horizontal distance (n,) between device and receiver [m]."""
    offset_m = links.receiver_m[:, :2] - links.device_m[:, :2]
    return np.hypot(offset_m[:, 0], offset_m[:, 1])


def free_space_db(distance_m: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Return the free-space basic transmission loss (n,) [dB] (ITU-R P.525-4, Eq. 4)."""
    return 32.45 + 20 * np.log10(frequency_hz / 1e6) + 20 * np.log10(distance_m / 1e3)


def mean_roof_m(city: CityMap) -> float:
    """Return the mean height of a map's roofs over MIN_ROOF_M above the ground [m]; 0: none."""
    low_m, high_m = city.vertices[:, :2].min(axis=0), city.vertices[:, :2].max(axis=0)
    fraction = (np.arange(GRID) + 0.5) / GRID
    x_m, y_m = (low + fraction * (high - low) for low, high in zip(low_m, high_m, strict=True))
    height_m = city.height_at(*np.meshgrid(x_m, y_m)) - city.ground_height_m(*np.meshgrid(x_m, y_m))
    roofs_m = height_m[height_m > MIN_ROOF_M]
    return float(roofs_m.mean()) if len(roofs_m) else 0.0


class WalfischIkegami(PublishedLaw):
    """COST 231 Walfisch-Ikegami path loss, medium-sized city: along a street or over roofs.

    COST Action 231, "Digital mobile radio towards future generation systems", final report, EUR
    18957, 1999, Sec. 4.4.1. The higher end is the base station, the lower end the mobile in the
    street. Roofs have the mean height of the map's; street width and distance of buildings are the
    report's defaults. The distance is the slant distance: in the report's range it hardly differs
    from the horizontal one, which is no measure of loss for a receiver above the device.
    """

    name = "cost231_wi"
    source = "COST 231 final report, Walfisch-Ikegami"
    frequency_range_hz = (0.8e9, 2.0e9)
    needs_map = True
    city_factor: ClassVar[float] = 0.7  # of k_f

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        return Validity(self.frequency_range_hz, (20.0, 5000.0), BASE_M, MOBILE_M)

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return the loss along a street (LoS) or over roofs (NLoS), and its sd [dB].

        Free space in LoS nearer than LOS_M. At least free space in NLoS, with the heights of the
        ends clipped to BASE_M and MOBILE_M.
        """
        free_db = free_space_db(links.distance_m, self.frequency_hz)
        if los:
            street_db = (42.6 + 26 * np.log10(links.distance_m / 1e3)
                         + 20 * np.log10(self.frequency_hz / 1e6))
            return Branch(np.where(links.distance_m < LOS_M, free_db, street_db), LOS_SD_DB)
        excess_db = self._roof_to_street_db(links) + self._many_screens_db(links)
        return Branch(free_db + np.maximum(excess_db, 0.0), NLOS_SD_DB)

    def _roof_to_street_db(self, links: LinkGeometry) -> np.ndarray:
        """Return the rooftop-to-street diffraction loss L_rts (n,) [dB] (Ikegami)."""
        mobile_m = np.clip(ends_m(links)[1], *MOBILE_M)
        below_m = np.maximum(self.roof_m - mobile_m, MIN_BELOW_ROOF_M)
        orientation_db = 4.0 - 0.114 * (STREET_ANGLE_DEG - 55)
        return (-16.9 - 10 * np.log10(STREET_M) + 10 * np.log10(self.frequency_hz / 1e6)
                + 20 * np.log10(below_m) + orientation_db)

    def _many_screens_db(self, links: LinkGeometry) -> np.ndarray:
        """Return the multiple-screen diffraction loss L_msd (n,) [dB] (Walfisch and Bertoni)."""
        base_m = np.clip(ends_m(links)[0], *BASE_M)
        over_m, kilometres = base_m - self.roof_m, links.distance_m / 1e3
        above = over_m > 0
        shadow_db = np.where(above, -18 * np.log10(1 + np.maximum(over_m, 0.0)), 0.0)
        near = np.minimum(kilometres / 0.5, 1.0)
        k_a = np.where(above, 54.0, 54.0 - 0.8 * over_m * near)
        k_d = np.where(above, 18.0, 18.0 - 15.0 * over_m / self.roof_m)
        k_f = -4 + self.city_factor * (self.frequency_hz / 925e6 - 1)
        return (shadow_db + k_a + k_d * np.log10(kilometres)
                + k_f * np.log10(self.frequency_hz / 1e6) - 9 * np.log10(BUILDING_M))


class WalfischIkegamiMetropolitan(WalfischIkegami):
    """COST 231 Walfisch-Ikegami path loss, metropolitan centre."""

    name = "cost231_wi_metropolitan"
    city_factor = 1.5


class P1411(PublishedLaw):
    """ITU-R P.1411-12 site-general path loss in street canyons and over rooftops.

    Both ends below the mean roof: Sec. 4.1.1, Table 4. Higher end above it: Sec. 4.2.1, Table 8,
    published for 2.2 to 73 GHz. Both are L = 10 alpha log10 d + beta + 10 gamma log10 f, d in
    metres and f in GHz (Eqs. 1 and 20). NLoS uses the rows for urban high-rise, the only ones
    published below 10 GHz; its loss is L_FS + 10 log10(10^(A / 10) + 1) with A = L - L_FS and the
    free-space loss L_FS, as the recommendation says.
    """

    name = "p1411"
    source = "ITU-R P.1411-12 Sec. 4.1.1 and 4.2.1"
    frequency_range_hz = (0.8e9, 82e9)
    needs_map = True

    @override
    def validity(self, links: LinkGeometry) -> Validity:
        """Return the published ranges of frequency and distance: in a street, or over roofs."""
        over, los = self._is_over(links), links.los.astype(int)
        least_m, greatest_m = np.where(over[:, None], np.array(OVER_ROOFS_M)[los],
                                       np.array(BELOW_ROOFS_M)[los]).T
        low_hz, high_hz = self.frequency_range_hz
        return Validity((np.where(over, 2.2e9, low_hz), np.where(over, 73e9, high_hz)),
                        (least_m, greatest_m))

    @override
    def branch(self, links: LinkGeometry, los: bool) -> Branch:
        """Return the loss in a street or, with the higher end above the roofs, over roofs [dB]."""
        over = self._is_over(links)
        alpha, beta_db, gamma, sd_db = np.where(over[:, None], OVER_ROOFS[los], BELOW_ROOFS[los]).T
        loss_db = (10 * alpha * links.log_distance + beta_db
                   + 10 * gamma * np.log10(self.frequency_hz / 1e9))
        if not los:
            free_db = free_space_db(links.distance_m, self.frequency_hz)
            loss_db = free_db + 10 * np.log10(10 ** ((loss_db - free_db) / 10) + 1)
        return Branch(loss_db, sd_db)

    def _is_over(self, links: LinkGeometry) -> np.ndarray:
        """Return (n,) bool: the higher end is above the mean roof."""
        return ends_m(links)[0] > self.roof_m
