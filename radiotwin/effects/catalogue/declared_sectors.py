"""`antenna_pattern` of sectors with declared azimuth: one common pattern, random levels by site.

All declared devices share one pattern (`radiotwin.effects.antennas`), turned to their declared
azimuth and tilt, so it also applies to a sector without readings. All azimuths may have one small
common error (compass, another north), and all tilts (electrical tilt is in few tables); a large
common error means that the table is wrong. An azimuth that the device's own readings contradict
(exchanged cables, a wrong digit) is turned to where they put it.

Levels are nested random effects: of all devices, of a mast (one installation), of a direction of
the mast (carriers that share an antenna), of a device. The levels of other sectors thus predict
that of a sector without readings, with its uncertainty.
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
    VERTICALS_DEG,
    Departures,
    SectorEffect,
    SectorPattern,
)
from radiotwin.effects.arrays import MIN_NATS, subsample
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

GROUP_SD_DB = 3.0  # sd of levels between masts, and between directions of a mast
DEVICE_SD_DB = 3.0  # sd of levels between carriers of an antenna: powers and cables differ
MIN_DEVICES = 2  # with declared azimuth; for one device there is `SectorAntenna`
TILT_SD_DEG = 4.0  # prior sd of the common tilt error: electrical tilts are a few degrees
MAX_TURN_DEG = 20.0  # largest error of compass, map and declination; more: the table is wrong
OFFSETS = ("azimuth_offset_deg", "tilt_offset_deg")  # parameters that all devices share
TURNS_DEG = np.arange(-170.0, 181.0, 10.0)  # trial errors of an azimuth
WRONG_TABLE, WRONG_AZIMUTH = 0.05, 0.02  # prior probability that all azimuths, or one, are wrong
SURE = 0.9  # posterior probability from which an azimuth counts as wrong
ROUNDS = 2  # the second one uses the residual scale left by the first one's pattern


class OwnTurn(NamedTuple):
    """Error of the declared azimuth of one device in addition to the common one [deg]."""

    turn_deg: Annotated[float, Field(ge=-180, le=180)]
    sd_deg: Annotated[float, Field(ge=0, le=180)]


def level_groups(links: Links, devices: list[int]) -> list[list[int]]:
    """Group the devices of each mast, then the devices of each direction (antenna) of a mast.

    Only groups of two or more; a mast with one direction is listed twice.
    """
    found = [{tuple(other for other in group_of(links, device) if other in devices)
              for device in devices} for group_of in (site_of, antenna_of)]
    return [list(group) for kind in found for group in sorted(kind) if len(group) > 1]


def unshared_sd_db(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Compute the prior sd (k,) of the part of each device's level that no other shares [dB].

    The device's own variance, and that of its mast and of its direction if it is alone there.
    """
    unshared_groups = 2 - membership(devices, groups).sum(axis=1)
    return np.sqrt(DEVICE_SD_DB**2 + GROUP_SD_DB**2 * unshared_groups)


def membership(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Build the membership matrix (k, groups) of devices in groups, 0 or 1."""
    return np.array([[float(device in group) for group in groups] for device in devices]
                    ).reshape(len(devices), len(groups))


def unheard_sd_db(devices: list[int], groups: list[list[int]], heard: set[int],
                  common_sd_db: float) -> dict[int, float]:
    """Compute how uncertain the level of each device without a reading is: device -> sd [dB].

    Conditional normal distribution given the levels of all devices with readings.

    Args:
        devices: k devices.
        groups: groups of devices with a shared level, see `level_groups`.
        heard: devices with readings.
        common_sd_db: standard deviation of the level common to all devices [dB].
    """
    member = membership(devices, groups)
    covariance = common_sd_db**2 + GROUP_SD_DB**2 * member @ member.T
    covariance += np.diag(unshared_sd_db(devices, groups) ** 2)
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
        straight: True: departures along the straight line; False: of the paths over the map.
            Held-out links decide between both: on the training links, paths over a partly guessed
            map may fit better by chance.
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
            """Reject groups with repeated or unknown devices, or a device in more than two."""
            counts = Counter(device for group in self.groups for device in group)
            if any(len(set(group)) < max(len(group), 2) for group in self.groups) \
                    or not set(counts) <= set(self.devices) or max(counts.values(), default=0) > 2:
                raise ValueError("groups are not of two devices and more, each in two at most")
            return self

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why there are too few declared azimuths to use them; None if there are enough."""
        if missing := super().unavailable(links):
            return missing
        if len(_declared(links)) < MIN_DEVICES:
            return f"azimuth_deg of {MIN_DEVICES} devices of known position is not declared"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the common antenna pattern and azimuth errors that fit the declared sectors."""
        declared = _declared(view.links)
        if np.isin(view.links.device, declared).sum() < MIN_LINKS:
            return []
        readings = _Readings.of(view, declared, self.straight)
        offset_deg, own_turns = readings.turns()
        nats, shape = readings.best_shape(offset_deg, own_turns)
        if nats <= MIN_NATS:
            return []
        groups = level_groups(view.links, declared)
        heard = view.links.device[np.isfinite(view.links.level_db)]
        unheard = unheard_sd_db(declared, groups, set(heard.tolist()), LEVEL_SD_DB)
        return [self.Params(devices=_turned(view.links, declared, shape, offset_deg, own_turns),
                            own_turns_deg=own_turns, straight=self.straight,
                            azimuth_offset_deg=offset_deg, tilt_offset_deg=shape.tilt_deg,
                            groups=groups, unheard_sd_db=unheard,
                            has_tilts=bool(np.isfinite(view.links.tilt_deg[declared]).any()))]

    @override
    def neg_log_prior(self) -> float:
        params = self.params
        tilt = 0.5 * (params.tilt_offset_deg / TILT_SD_DEG) ** 2 if params.has_tilts else 0.0
        return super().neg_log_prior() + tilt

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why declared azimuths are unusable (large common error, many wrong); else None."""
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
        """Return a sentence for each device whose readings contradict its declared azimuth."""
        return [f"the declared azimuth of device {links.device_names[device]}, "
                f"{links.boresight_deg[device]:.0f}°, is contradicted by its own readings, which "
                f"put it {turn_deg:+.0f}° (± {QUANTILE_90 * sd_deg:.0f}°) away; all azimuths share "
                f"an error of {self.params.azimuth_offset_deg:+.0f}°"
                for device, (turn_deg, sd_deg) in self.params.own_turns_deg.items()]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return pattern gains [dB] and fitted levels: of all, by mast, by direction, by device."""
        by_device = super().term(links, level_at)
        shared = _shared_levels(self.params)
        sd_db = np.zeros(len(links))
        for device, level_sd_db in self.params.unheard_sd_db.items():
            sd_db[links.device == device] = level_sd_db
        return Term(by_device.offset_db,
                    by_device.columns @ np.column_stack([shared, np.eye(len(shared))]),
                    np.r_[LEVEL_SD_DB, np.full(len(self.params.groups), GROUP_SD_DB),
                          unshared_sd_db(list(self.params.devices), self.params.groups)],
                    unheard_sd_db=sd_db)

    @override
    def variation(self) -> Variation:
        """Put the pattern's shape and the common azimuth and tilt errors into a search vector."""
        params = self.params
        fields = _searched_fields()
        first = next(iter(params.devices.values()))
        values = np.array([getattr(params if name in OFFSETS else first, name) for name in fields])
        steps, low, high = (np.array([field[key] for field in fields.values()], dtype=float)
                            for key in ("step", "low", "high"))
        # The tilt of every antenna stays within its bounds.
        tilts_deg = [pattern.tilt_deg for pattern in params.devices.values()]
        bounds, tilt = quantities(SectorPattern)["tilt_deg"], [*fields].index("tilt_offset_deg")
        low[tilt] = values[tilt] + bounds["low"] - min(tilts_deg)
        high[tilt] = values[tilt] + bounds["high"] - max(tilts_deg)

        def varied(numbers: np.ndarray) -> DeclaredSectors:
            found = dict(zip(fields, numbers.tolist(), strict=True))
            offsets = {name: found.pop(name) for name in OFFSETS}
            turn_deg, up_deg = (new - getattr(params, name) for name, new in offsets.items())
            devices = {device: pattern.model_copy(update=found | {
                "azimuth_deg": pattern.azimuth_deg + turn_deg,
                "tilt_deg": pattern.tilt_deg + up_deg})
                for device, pattern in params.devices.items()}
            return self.changed(devices=devices, **offsets)

        return Variation(values, steps, low, high, varied)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report shape, azimuth errors [deg], and devices' gains over their common level [dB]."""
        values = self.variation().values
        reported = {name: Parameter.normal(value, sd, field["unit"], Allowed.of(field))
                    for (name, field), value, sd in zip(_searched_fields().items(), values,
                                                        estimate.params_sd, strict=True)}
        if not self.params.has_tilts:
            reported["tilt_deg"] = reported.pop("tilt_offset_deg")
        if links.city is None or self.params.straight:
            reported.pop("scattered_db")
        for device, own_turn in self.params.own_turns_deg.items():
            reported[f"azimuth_error_deg[{links.device_names[device]}]"] = Parameter.normal(
                *own_turn, "deg", Allowed(-180.0, 180.0))
        # Relative to the level common to all devices, which belongs to the channel.
        shares = np.column_stack([_shared_levels(self.params)[:, 1:],
                                  np.eye(len(self.params.devices))])
        level_db = shares @ estimate.coefficients[1:]
        sd_db = estimate.sd_of(np.column_stack([np.zeros(len(shares)), shares]))
        for device, gain_db, gain_sd_db in zip(self.params.devices, level_db, sd_db, strict=True):
            reported[f"gain_db[{links.device_names[device]}]"] = Parameter.normal(
                float(gain_db), float(gain_sd_db), "dB")
        return reported


class DeclaredSectorsOnPaths(DeclaredSectors):
    """Declared sectors whose paths over the map each have the gain of their departure direction."""

    variant = "sector antennas of declared azimuth, along paths"
    straight = False
    needs_map = True


def _shared_levels(params: Any) -> np.ndarray:
    """Build indicators (k, 1 + groups) of the levels that devices share: of all, of each group."""
    devices = list(params.devices)
    return np.column_stack([np.ones(len(devices)), membership(devices, params.groups)])


def _searched_fields() -> dict[str, dict]:
    """List the parameters of the search, common offsets and shape: name -> step, bounds, unit."""
    common, shape = quantities(DeclaredSectors.Params), quantities(SectorPattern)
    return {name: common[name] for name in OFFSETS} | {
        name: field for name, field in shape.items() if name not in ("azimuth_deg", "tilt_deg")}


def _declared(links: Links) -> list[int]:
    """List the devices of declared azimuth and position, also those without a reading."""
    return [device for device in np.flatnonzero(np.isfinite(links.boresight_deg)).tolist()
            if device in links.anchors]


def _turned(links: Links, devices: list[int], shape: SectorPattern, offset_deg: float,
            own_turns: dict[int, OwnTurn]) -> dict[int, SectorPattern]:
    """Turn a pattern to each device's declared azimuth and tilt: device -> pattern.

    Azimuths get the common error `offset_deg` and the device's own. The tilt of `shape` is added,
    within its bounds; a missing declared tilt is replaced by the median of the declared ones, or 0.
    """
    given_deg = links.tilt_deg[devices]
    known = np.isfinite(given_deg)
    usual_deg = float(np.median(given_deg[known])) if known.any() else 0.0
    bounds = quantities(SectorPattern)["tilt_deg"]
    tilts_deg = np.clip(np.where(known, given_deg, usual_deg) + shape.tilt_deg,
                        bounds["low"], bounds["high"])
    return {device: shape.model_copy(
        update={"azimuth_deg": float(links.boresight_deg[device]) + offset_deg
                + (own_turns[device].turn_deg if device in own_turns else 0.0), "tilt_deg": tilt})
        for device, tilt in zip(devices, tilts_deg.tolist(), strict=True)}


class _Readings(NamedTuple):
    """Subsample of the declared devices' readings, to compare patterns.

    Attributes:
        view: residuals of all links.
        devices: all declared devices.
        parts: device with readings -> rows (r,) of the subsample, links that each row represents,
            and departures.
    """

    view: ResidualView
    devices: list[int]
    parts: dict[int, tuple[np.ndarray, float, Departures]]

    @classmethod
    def of(cls, view: ResidualView, devices: list[int], straight: bool) -> Self:
        """Draw some links of each device at random, and find at which angles they depart."""
        parts = {}
        for device in devices:
            device_rows = np.flatnonzero(view.links.device == device)
            rows = subsample(device_rows, MAX_PROPOSE_LINKS)
            if len(rows):
                parts[device] = (rows, len(device_rows) / len(rows),
                                 Departures.of(view.links, rows, straight))
        return cls(view, devices, parts)

    def nats(self, offsets_db: dict[int, np.ndarray]) -> float:
        """Compute the log-likelihood gain of offsets (r,) by device and one fitted level [nats]."""
        rows = np.concatenate([self.parts[device][0] for device in offsets_db])
        links_per_row = np.concatenate([np.full(len(self.parts[device][0]), self.parts[device][1])
                                        for device in offsets_db])
        offset_db = np.concatenate(list(offsets_db.values()))
        weight = self.view.weight[rows] * np.isfinite(self.view.links.level_db[rows])
        level_db = weight @ (self.view.residual_db[rows] - offset_db) / max(weight.sum(), 1e-12)
        return float(links_per_row @ self.view.gain_nats(rows, offset_db + level_db))

    def turns(self) -> tuple[float, dict[int, OwnTurn]]:
        """Estimate the common error of declared azimuths, and which devices have another error.

        Mixture model: each azimuth has the common error or, rarely, any error, so that a wrong
        azimuth does not bias the others. Each device has its own level; patterns are flat in
        elevation. Returns the common error [deg] and device -> its error relative to that.
        """
        found: tuple[float, dict[int, OwnTurn]] = (0.0, {})
        view = self.view
        for _ in range(ROUNDS):
            common_deg, nats, shape = max((self._replace(view=view)._mixture(*numbers) for numbers
                                           in product(BEAMWIDTHS_DEG, FRONT_TO_BACK_DB)),
                                          key=lambda tried: tried[0])[1:]
            found = common_deg, {device: _own_turn(turn_nats, common_deg)
                                 for device, turn_nats in nats.items()
                                 if _chance_wrong(turn_nats, common_deg) >= SURE}
            turned = _turned(self.view.links, self.devices, shape, *found)
            left_db = [self.view.residual_db[rows] - rays.offset_db(turned[device])
                       for device, (rows, _, rays) in self.parts.items()]
            scale_db = MAD_SD * float(np.nanmedian(np.abs(np.concatenate(
                [residual_db - np.nanmedian(residual_db) for residual_db in left_db]))))
            view = replace(self.view, scale_db=np.minimum(self.view.scale_db, max(scale_db, 1.0)))
        return found

    def _mixture(self, width_deg: float, back_db: float
                 ) -> tuple[float, float, dict[int, np.ndarray], SectorPattern]:
        """Rate one pattern, flat in elevation, by the mixture of `turns` over azimuth errors.

        Returns log posterior [nats], likeliest common error [deg], device -> gain of each trial
        error (t,) [nats], and the pattern.
        """
        shape = SectorPattern(beamwidth_deg=width_deg, front_to_back_db=back_db)
        declared = _turned(self.view.links, self.devices, shape, 0.0, {})
        nats = {device: np.array([self.nats({device: rays.offset_db(declared[device].model_copy(
            update={"azimuth_deg": declared[device].azimuth_deg + turn_deg}))})
            for turn_deg in TURNS_DEG]) for device, (_, _, rays) in self.parts.items()}
        log_p = np.log(np.where(TURNS_DEG == 0, 1 - WRONG_TABLE, WRONG_TABLE / len(TURNS_DEG)))
        for turn_nats in nats.values():
            any_turn = float(np.logaddexp.reduce(turn_nats) - np.log(len(turn_nats)))
            log_p = log_p + np.logaddexp(np.log(1 - WRONG_AZIMUTH) + turn_nats,
                                         np.log(WRONG_AZIMUTH) + any_turn)
        best = int(log_p.argmax())
        return float(log_p[best]), float(TURNS_DEG[best]), nats, shape

    def best_shape(self, offset_deg: float, own_turns: dict[int, OwnTurn]
                   ) -> tuple[float, SectorPattern]:
        """Return the gain over a constant level [nats] of the likeliest trial pattern, and it."""
        def rate_shape(width_deg: float, back_db: float, tilt_deg: float, vertical_deg: float
                       ) -> tuple[float, SectorPattern]:
            shape = SectorPattern(beamwidth_deg=width_deg, front_to_back_db=back_db,
                                  tilt_deg=tilt_deg, vertical_beamwidth_deg=vertical_deg)
            turned = _turned(self.view.links, self.devices, shape, offset_deg, own_turns)
            return self.nats({device: rays.offset_db(turned[device])
                              for device, (_, _, rays) in self.parts.items()}), shape

        best, shape = max((rate_shape(*numbers, *vertical) for vertical in VERTICALS_DEG
                           for numbers in product(BEAMWIDTHS_DEG, FRONT_TO_BACK_DB)),
                          key=lambda pair: pair[0])
        flat_db = {device: np.zeros(len(rows)) for device, (rows, _, _) in self.parts.items()}
        return best - self.nats(flat_db), shape


def _chance_wrong(nats: np.ndarray, common_deg: float) -> float:
    """Compute the posterior probability that the declared azimuth of a device is wrong.

    Wrong: its error differs by more than `MAX_TURN_DEG` from the common one. `nats` (t,) are the
    log-likelihood gains of trial errors `TURNS_DEG`.
    """
    apart_deg = np.abs((TURNS_DEG - common_deg + 180) % 360 - 180)
    share = np.exp(nats - nats.max())
    right = (1 - WRONG_AZIMUTH) * share[apart_deg <= MAX_TURN_DEG].max()
    wrong = WRONG_AZIMUTH * share[apart_deg > MAX_TURN_DEG].sum() / len(TURNS_DEG)
    return float(wrong / (right + wrong))


def _own_turn(nats: np.ndarray, common_deg: float) -> OwnTurn:
    """Estimate how far a device's azimuth error is from the common one, with its sd [deg]."""
    best_deg, share = TURNS_DEG[nats.argmax()], np.exp(nats - nats.max())
    off_deg = (TURNS_DEG - best_deg + 180) % 360 - 180
    mean_deg = share @ off_deg / share.sum()
    sd_deg = np.sqrt(share @ (off_deg - mean_deg) ** 2 / share.sum())
    turn_deg = (best_deg + mean_deg - common_deg + 180) % 360 - 180
    return OwnTurn(float(turn_deg), float(sd_deg))
