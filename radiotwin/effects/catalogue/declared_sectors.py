"""Sector antennas of which only the direction is known: a planner's table has it, not the pattern.

All declared devices have one pattern (that of `radiotwin.effects.antennas`), each turned to its own
azimuth and tilt, and levels that have much in common. All azimuths may be off by one small angle (a
compass, another north), and all tilts (what is electrical is in few tables); by a large one the
table is wrong. So it holds for a sector that nobody has measured, too, which a pattern learnt for
each device by itself does not. Beside what all share, each azimuth is judged by the device's own
readings: one that they contradict (cables exchanged, a digit) is turned to where they put it.

Levels have the more in common the more of a site devices share. Radios and cables of a mast come
from one installation, and sectors of one direction are carriers that share an antenna. So levels
are random effects, nested: of all, of a mast, of a direction there, of a device. What was heard of
the others then says what to expect of a sector that nobody has measured, and how surely.
"""

from collections import Counter
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import override

from radiotwin.effects.antennas import (
    BEAMWIDTHS_DEG,
    FRONT_TO_BACK_DB,
    LEVEL_SD_DB,
    MAX_PROPOSE_LINKS,
    MIN_LINKS,
    MIN_NATS,
    VERTICALS_DEG,
    Departures,
    SectorEffect,
    SectorPattern,
)
from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    QUANTILE_90,
    Allowed,
    Decibels,
    DeviceIndex,
    Estimate,
    Parameter,
    Variation,
    quantities,
    quantity,
)
from radiotwin.inference.gaussian import MAD_SD
from radiotwin.links import Links
from radiotwin.links.sites import antenna_of, site_of

GROUP_SD_DB = 3.0  # between masts, and between directions of a mast
DEVICE_SD_DB = 3.0  # between carriers of an antenna: powers and cables differ
MIN_DEVICES = 2  # of declared azimuth; of one, the pattern is that of `SectorAntenna`
TILT_SD_DEG = 4.0  # by which declared tilts are off: electrical ones are a few degrees
MAX_TURN_DEG = 20.0  # by which compasses, maps and declination are off; more is a wrong table
OFFSETS = ("azimuth_offset_deg", "tilt_offset_deg")  # numbers that all devices share
TURNS_DEG = np.arange(-170.0, 181.0, 10.0)  # that are tried
WRONG_TABLE, WRONG_AZIMUTH = 0.05, 0.02  # prior probability: of all azimuths, of one
SURE = 0.9  # probability from which on one azimuth is taken to be wrong
ROUNDS = 2  # the second knows how little the pattern leaves


class OwnTurn(NamedTuple):
    """By how much the declared azimuth of one device is off, clockwise [deg]."""

    turn_deg: Annotated[float, Field(ge=-180, le=180)]
    sd_deg: Annotated[float, Field(ge=0, le=180)]


def level_groups(links: Links, devices: list[int]) -> list[list[int]]:
    """Return those of some devices that are on one mast, and those that look one way from it.

    Groups are of at least two devices; one that is both, a mast of one direction, is in it twice.
    """
    found = [{tuple(other for other in group_of(links, device) if other in devices)
              for device in devices} for group_of in (site_of, antenna_of)]
    return [list(group) for kind in found for group in sorted(kind) if len(group) > 1]


def own_sd_db(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Return the standard deviation of what no other device shares (k,) [dB].

    That of a device, and of a mast or a direction that it has for itself.
    """
    alone = 2 - membership(devices, groups).sum(axis=1)
    return np.sqrt(DEVICE_SD_DB**2 + GROUP_SD_DB**2 * alone)


def membership(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Return which groups each device is in, (k, groups) of 0 and 1."""
    return np.array([[float(device in group) for group in groups] for device in devices]
                    ).reshape(len(devices), len(groups))


def unheard_sd_db(devices: list[int], groups: list[list[int]], heard: set[int],
                  common_sd_db: float) -> dict[int, float]:
    """Return the standard deviation of the level of each device without a reading [dB].

    That of a normal distribution, on condition of the levels of all others.

    Args:
        devices: all k.
        groups: of them that have a level in common.
        heard: those whose levels are known.
        common_sd_db: between networks: of the level of all [dB].
    """
    member = membership(devices, groups)
    covariance = common_sd_db**2 + GROUP_SD_DB**2 * member @ member.T
    covariance += np.diag(own_sd_db(devices, groups) ** 2)
    known = np.isin(devices, list(heard))
    cross = covariance[np.ix_(~known, known)]
    explained = np.einsum("ij,ji->i", cross, np.linalg.solve(covariance[np.ix_(known, known)],
                                                             cross.T))
    sd_db = np.sqrt(np.diag(covariance)[~known] - explained)
    return {device: float(sd) for device, sd in zip(np.array(devices)[~known].tolist(), sd_db,
                                                    strict=True)}


class DeclaredSectors(SectorEffect):
    """One pattern for all devices of declared azimuth; links leave along the straight line.

    Attributes:
        straight: whether they do, or in the directions of the paths over the map. On the links that
            both are fitted to, paths over a map that is half guessed may well win; held-out links
            say which is right.
    """

    variant = "sector antennas of declared azimuth"
    straight: ClassVar[bool] = True
    is_declared = True
    parameter_labels = {"azimuth_offset_deg": "common error of the azimuths",
                        "tilt_offset_deg": "common error of the tilts"}

    class Params(SectorEffect.Params):
        """Antennas of devices, all of one pattern, at their declared azimuths and a common turn."""

        azimuth_offset_deg: float = quantity(
            0.0, unit="deg", low=-180.0, high=180.0, step=5.0, prior_sd=5.0,
            description="By which all declared azimuths are off, clockwise.")
        tilt_offset_deg: float = quantity(
            0.0, unit="deg", low=-60.0, high=80.0, step=4.0,
            description="By which all declared tilts are off, upwards; without any, the tilt.")
        has_tilts: bool = Field(False, description="Whether tilts are declared.")
        groups: list[list[DeviceIndex]] = Field(
            [], description="Devices whose levels have more in common: of a mast, of a direction.")
        unheard_sd_db: dict[DeviceIndex, Decibels] = Field(
            {}, description="How uncertain the level of each device without a reading is.")
        own_turns_deg: dict[DeviceIndex, OwnTurn] = Field(
            {}, description="Declared azimuths that are wrong: by how much, beside what all are.")

        @model_validator(mode="after")
        def _check_groups(self) -> Self:
            counts = Counter(device for group in self.groups for device in group)
            if any(len(set(group)) < max(len(group), 2) for group in self.groups) \
                    or not set(counts) <= set(self.devices) or max(counts.values(), default=0) > 2:
                raise ValueError("groups are not of two devices and more, each in two at most")
            return self

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        if missing := super().unavailable(links):
            return missing
        if len(_declared(links)) < MIN_DEVICES:
            return f"azimuth_deg of {MIN_DEVICES} devices of known position is not declared"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        declared = _declared(view.links)
        if np.isin(view.links.device, declared).sum() < MIN_LINKS:
            return []
        readings = _Readings.of(view, declared, self.straight)
        offset_deg, own = readings.turns()
        nats, shape = readings.best_shape(offset_deg, own)
        if nats <= MIN_NATS:
            return []
        groups = level_groups(view.links, declared)
        heard = view.links.device[np.isfinite(view.links.level_db)]
        unheard = unheard_sd_db(declared, groups, set(heard.tolist()), LEVEL_SD_DB)
        return [self.Params(devices=_turned(view.links, declared, shape, offset_deg, own),
                            own_turns_deg=own,
                            straight=self.straight, azimuth_offset_deg=offset_deg,
                            tilt_offset_deg=shape.tilt_deg, groups=groups, unheard_sd_db=unheard,
                            has_tilts=bool(np.isfinite(view.links.tilt_deg[declared]).any()))]

    @override
    def neg_log_prior(self) -> float:
        params = self.params
        tilt = 0.5 * (params.tilt_offset_deg / TILT_SD_DEG) ** 2 if params.has_tilts else 0.0
        return super().neg_log_prior() + tilt

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        params = self.params
        if len(params.own_turns_deg) > len(params.devices) / 2:
            return (f"of {len(params.devices)} declared azimuths {len(params.own_turns_deg)} are "
                    f"off by more than {MAX_TURN_DEG:g}° by the readings of their devices")
        if abs(params.azimuth_offset_deg) <= MAX_TURN_DEG:
            return None
        return (f"they fit azimuths that are all turned by {params.azimuth_offset_deg:+.0f}°; "
                "azimuth_deg counts clockwise from north")

    @override
    def contradicted_declarations(self, links: Links) -> list[str]:
        return [f"the declared azimuth of device {links.device_names[device]}, "
                f"{links.boresight_deg[device]:.0f}°, is contradicted by its own readings, which "
                f"put it {turn_deg:+.0f}° (± {QUANTILE_90 * sd_deg:.0f}°) away; all azimuths share "
                f"an error of {self.params.azimuth_offset_deg:+.0f}°"
                for device, (turn_deg, sd_deg) in self.params.own_turns_deg.items()]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        own = super().term(links, level_at)
        shared = _shared(self.params)
        sd_db = np.zeros(len(links))
        for device, level_sd_db in self.params.unheard_sd_db.items():
            sd_db[links.device == device] = level_sd_db
        return Term(own.offset_db, own.columns @ np.column_stack([shared, np.eye(len(shared))]),
                    np.r_[LEVEL_SD_DB, np.full(len(self.params.groups), GROUP_SD_DB),
                          own_sd_db(list(self.params.devices), self.params.groups)],
                    unheard_sd_db=sd_db)

    @override
    def variation(self) -> Variation:
        params = self.params
        fields = _numbers()
        first = next(iter(params.devices.values()))
        values = np.array([getattr(params if name in OFFSETS else first, name) for name in fields])
        steps, low, high = (np.array([each[key] for each in fields.values()], dtype=float)
                            for key in ("step", "low", "high"))
        # Each antenna's own tilt stays within its bounds.
        own_deg = [pattern.tilt_deg for pattern in params.devices.values()]
        bounds, at = quantities(SectorPattern)["tilt_deg"], [*fields].index("tilt_offset_deg")
        low[at] = values[at] + bounds["low"] - min(own_deg)
        high[at] = values[at] + bounds["high"] - max(own_deg)

        def varied(numbers: np.ndarray) -> DeclaredSectors:
            found = dict(zip(fields, numbers.tolist(), strict=True))
            offsets = {name: found.pop(name) for name in OFFSETS}
            turn_deg, up_deg = (each - getattr(params, name) for name, each in offsets.items())
            devices = {device: pattern.model_copy(update=found | {
                "azimuth_deg": pattern.azimuth_deg + turn_deg,
                "tilt_deg": pattern.tilt_deg + up_deg})
                for device, pattern in params.devices.items()}
            return self.changed(devices=devices, **offsets)

        return Variation(values, steps, low, high, varied)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        values = self.variation().values
        reported = {name: Parameter.normal(value, sd, field["unit"], Allowed.of(field))
                    for (name, field), value, sd in zip(_numbers().items(), values,
                                                        estimate.params_sd, strict=True)}
        if not self.params.has_tilts:
            reported["tilt_deg"] = reported.pop("tilt_offset_deg")
        if links.city is None or self.params.straight:
            reported.pop("scattered_db")
        for device, own_turn in self.params.own_turns_deg.items():
            reported[f"azimuth_error_deg[{links.device_names[device]}]"] = Parameter.normal(
                *own_turn, "deg", Allowed(-180.0, 180.0))
        # The common one is the channel's.
        shares = np.column_stack([_shared(self.params)[:, 1:], np.eye(len(self.params.devices))])
        level_db = shares @ estimate.coefficients[1:]
        sd_db = estimate.sd_of(np.column_stack([np.zeros(len(shares)), shares]))
        for device, value_db, each_sd_db in zip(self.params.devices, level_db, sd_db, strict=True):
            reported[f"gain_db[{links.device_names[device]}]"] = Parameter.normal(
                float(value_db), float(each_sd_db), "dB")
        return reported


class DeclaredSectorsOnPaths(DeclaredSectors):
    """The same, each path with the gain of the direction in which it leaves the device."""

    variant = "sector antennas of declared azimuth, along paths"
    straight = False
    needs_map = True


def _shared(params: Any) -> np.ndarray:
    """Return which level each device shares with others, all or a group, (k, 1 + groups)."""
    devices = list(params.devices)
    return np.column_stack([np.ones(len(devices)), membership(devices, params.groups)])


def _numbers() -> dict[str, dict]:
    """Return what is searched for: name -> step, bounds and unit."""
    common, shape = quantities(DeclaredSectors.Params), quantities(SectorPattern)
    return {name: common[name] for name in OFFSETS} | {
        name: field for name, field in shape.items() if name not in ("azimuth_deg", "tilt_deg")}


def _declared(links: Links) -> list[int]:
    """Return the devices of declared azimuth and position, also those without a reading."""
    return [device for device in np.flatnonzero(np.isfinite(links.boresight_deg)).tolist()
            if device in links.anchors]


def _turned(links: Links, devices: list[int], shape: SectorPattern,
            offset_deg: float, own: dict[int, OwnTurn]) -> dict[int, SectorPattern]:
    """Return device -> a pattern, turned to what is declared for it, and further.

    A tilt that is not declared is the median of those that are, or else 0; that of `shape` is
    added.
    """
    known = links.tilt_deg[devices]
    usual = float(np.median(known[np.isfinite(known)])) if np.isfinite(known).any() else 0.0
    bounds = quantities(SectorPattern)["tilt_deg"]
    tilts_deg = np.clip(np.where(np.isfinite(known), known, usual) + shape.tilt_deg,
                        bounds["low"], bounds["high"])
    return {device: shape.model_copy(
        update={"azimuth_deg": float(links.boresight_deg[device]) + offset_deg
                + (own[device].turn_deg if device in own else 0.0), "tilt_deg": tilt})
        for device, tilt in zip(devices, tilts_deg.tolist(), strict=True)}


class _Readings(NamedTuple):
    """Readings of the declared devices that patterns are compared by.

    Attributes:
        view: of all links.
        devices: all that are declared.
        parts: of each device with readings: its rows (r,), how many links each stands for, and the
            directions in which they leave it.
    """

    view: ResidualView
    devices: list[int]
    parts: dict[int, tuple[np.ndarray, float, Departures]]

    @classmethod
    def of(cls, view: ResidualView, devices: list[int], straight: bool) -> Self:
        parts = {}
        for device in devices:
            every = np.flatnonzero(view.links.device == device)
            rows = subsample(every, MAX_PROPOSE_LINKS)
            if len(rows):
                parts[device] = (rows, len(every) / len(rows),
                                 Departures.of(view.links, rows, straight))
        return cls(view, devices, parts)

    def nats(self, offsets_db: dict[int, np.ndarray]) -> float:
        """Return what offsets (r,) of devices gain, with one level for all [nats]."""
        rows = np.concatenate([self.parts[device][0] for device in offsets_db])
        times = np.concatenate([np.full(len(self.parts[device][0]), self.parts[device][1])
                                for device in offsets_db])
        offset_db = np.concatenate(list(offsets_db.values()))
        weight = self.view.weight[rows] * np.isfinite(self.view.links.level_db[rows])
        level_db = weight @ (self.view.residual_db[rows] - offset_db) / max(weight.sum(), 1e-12)
        return float(times @ self.view.gain_nats(rows, offset_db + level_db))

    def turns(self) -> tuple[float, dict[int, OwnTurn]]:
        """Return the turn that declared azimuths share, and those of devices with another one.

        A mixture: each azimuth has the common turn, or, rarely, any. So one that is wrong does not
        turn the others. Levels are each device's own, and patterns flat in elevation.
        """
        found: tuple[float, dict[int, OwnTurn]] = (0.0, {})
        view = self.view
        for _ in range(ROUNDS):
            common_deg, nats, shape = max((self._replace(view=view)._mixture(*numbers) for numbers
                                           in product(BEAMWIDTHS_DEG, FRONT_TO_BACK_DB)),
                                          key=lambda each: each[0])[1:]
            found = common_deg, {device: _own_turn(each, common_deg)
                                 for device, each in nats.items()
                                 if _chance_wrong(each, common_deg) >= SURE}
            turned = _turned(self.view.links, self.devices, shape, *found)
            left_db = [self.view.residual_db[rows] - rays.offset_db(turned[device])
                       for device, (rows, _, rays) in self.parts.items()]
            scale_db = MAD_SD * float(np.nanmedian(np.abs(np.concatenate(
                [each - np.nanmedian(each) for each in left_db]))))
            view = replace(self.view, scale_db=np.minimum(self.view.scale_db, max(scale_db, 1.0)))
        return found

    def _mixture(self, width_deg: float, back_db: float
                 ) -> tuple[float, float, dict[int, np.ndarray], SectorPattern]:
        """Return how likely a flat pattern is, its common turn, and the nats (t,) of turns."""
        shape = SectorPattern(beamwidth_deg=width_deg, front_to_back_db=back_db)
        declared = _turned(self.view.links, self.devices, shape, 0.0, {})
        nats = {device: np.array([self.nats({device: rays.offset_db(declared[device].model_copy(
            update={"azimuth_deg": declared[device].azimuth_deg + turn_deg}))})
            for turn_deg in TURNS_DEG]) for device, (_, _, rays) in self.parts.items()}
        likely = np.log(np.where(TURNS_DEG == 0, 1 - WRONG_TABLE, WRONG_TABLE / len(TURNS_DEG)))
        for each in nats.values():
            likely = likely + np.logaddexp(np.log(1 - WRONG_AZIMUTH) + each,
                                           np.log(WRONG_AZIMUTH) + _logmeanexp(each))
        best = int(likely.argmax())
        return float(likely[best]), float(TURNS_DEG[best]), nats, shape

    def best_shape(self, offset_deg: float, own: dict[int, OwnTurn]
                   ) -> tuple[float, SectorPattern]:
        """Return what the best pattern of a grid gains over a level [nats], and the pattern."""
        def tried(width: float, back_db: float, tilt: float, height: float
                  ) -> tuple[float, SectorPattern]:
            shape = SectorPattern(beamwidth_deg=width, front_to_back_db=back_db, tilt_deg=tilt,
                                  vertical_beamwidth_deg=height)
            turned = _turned(self.view.links, self.devices, shape, offset_deg, own)
            return self.nats({device: rays.offset_db(turned[device])
                              for device, (_, _, rays) in self.parts.items()}), shape

        best, shape = max((tried(*numbers, *vertical) for vertical in VERTICALS_DEG
                           for numbers in product(BEAMWIDTHS_DEG, FRONT_TO_BACK_DB)),
                          key=lambda each: each[0])
        flat_db = {device: np.zeros(len(rows)) for device, (rows, _, _) in self.parts.items()}
        return best - self.nats(flat_db), shape


def _logmeanexp(nats: np.ndarray) -> float:
    """Return the logarithm of the mean of exponentials (t,)."""
    return float(np.logaddexp.reduce(nats) - np.log(len(nats)))


def _chance_wrong(nats: np.ndarray, common_deg: float) -> float:
    """Return the probability that an azimuth has not the common turn, by the nats (t,) of turns.

    One within `MAX_TURN_DEG` of it counts as having it.
    """
    apart_deg = np.abs((TURNS_DEG - common_deg + 180) % 360 - 180)
    share = np.exp(nats - nats.max())
    right = (1 - WRONG_AZIMUTH) * share[apart_deg <= MAX_TURN_DEG].max()
    wrong = WRONG_AZIMUTH * share[apart_deg > MAX_TURN_DEG].sum() / len(TURNS_DEG)
    return float(wrong / (right + wrong))


def _own_turn(nats: np.ndarray, common_deg: float) -> OwnTurn:
    """Return the turn beside the common one, mean and standard deviation about the likeliest."""
    best_deg, share = TURNS_DEG[nats.argmax()], np.exp(nats - nats.max())
    off_deg = (TURNS_DEG - best_deg + 180) % 360 - 180
    mean_deg = share @ off_deg / share.sum()
    sd_deg = np.sqrt(share @ (off_deg - mean_deg) ** 2 / share.sum())
    turn_deg = (best_deg + mean_deg - common_deg + 180) % 360 - 180
    return OwnTurn(float(turn_deg), float(sd_deg))
