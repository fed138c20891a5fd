"""Declared radios of devices: power, cable loss, antenna and carrier frequency.

A channel model predicts gains between isotropic antennas at one frequency. The level of a link adds
the power that the device feeds to its antenna, the antenna gain towards the receiver, and 20 lg of
the frequency ratio (Friis 1946, 'A note on a simple transmission formula').
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from radiotwin.display import count, some
from radiotwin.errors import BadInput
from radiotwin.scene.antennas import Antenna, Pattern

if TYPE_CHECKING:
    from radiotwin.scene import Scene

MAX_EIRP_APART_DB = 0.5  # rounding between a declared EIRP and that of power, cable and antenna


@dataclass(frozen=True)
class Radio:
    """Declared radio of one device.

    Attributes:
        tx_power_dbm: at the output of the transmitter [dBm]; None: not known.
        cable_loss_db: between transmitter and antenna [dB].
        antenna: None: isotropic, or unknown and learnt as part of the levels.
        frequency_hz: carrier [Hz]; None: that of the scene.
    """

    tx_power_dbm: float | None = None
    cable_loss_db: float = 0.0
    antenna: Antenna | None = None
    frequency_hz: float | None = None

    @property
    def fed_dbm(self) -> float:
        """Power at the antenna's input [dBm]; an unknown transmit power counts as 0 dBm."""
        return (self.tx_power_dbm or 0.0) - self.cable_loss_db


def tx_power_dbm(device: str, power_dbm: float | None, eirp_dbm: float | None,
                 cable_loss_db: float, antenna: Antenna | None) -> float | None:
    """Return the declared transmit power [dBm], else that from a declared EIRP, else None.

    EIRP is the power minus the cable loss plus the antenna's peak gain, 0 dBi without an antenna
    (ITU-R V.573-6, A43). BadInput if both are declared and differ by more than `MAX_EIRP_APART_DB`.
    """
    if eirp_dbm is None:
        return power_dbm
    peak_dbi = 0.0 if antenna is None else antenna.pattern.peak_dbi
    by_eirp_dbm = eirp_dbm - peak_dbi + cable_loss_db
    if power_dbm is None:
        return by_eirp_dbm
    if abs(by_eirp_dbm - power_dbm) > MAX_EIRP_APART_DB:
        raise BadInput(
            f"device {device!r}: eirp_dbm = {eirp_dbm:g} contradicts tx_power_dbm = {power_dbm:g} "
            f"with cable_loss_db = {cable_loss_db:g} and an antenna of {peak_dbi:.1f} dBi (0 dBi "
            f"without the column antenna), which make {power_dbm - cable_loss_db + peak_dbi:.1f} "
            f"dBm; {MAX_EIRP_APART_DB:g} dB of difference are allowed: correct one, or leave one "
            "empty")
    return power_dbm


@dataclass(frozen=True, eq=False)
class Declared:
    """Declared radios of k devices, and what they add to the levels of links.

    Attributes:
        radios: one for each device; empty: nothing is declared.
        frequency_hz: at which channel models predict [Hz]; NaN if unknown.
        has_power: whether levels are received powers, which include the transmit power.
        receiver_antenna: of all receivers; None: isotropic, or learnt as part of the levels.
    """

    radios: tuple[Radio, ...]
    frequency_hz: float
    has_power: bool
    receiver_antenna: Antenna | None = None

    @cached_property
    def fed_db(self) -> np.ndarray:
        """Level of each device before antenna and path gain, (k,) [dBm; dB if levels are gains].

        It is the transmit power, where levels are received powers (0 dBm if unknown), minus the
        cable loss, and minus 20 lg of the ratio of the device's carrier to the common one.
        """
        feed_db = np.zeros(len(self.radios))
        for number, radio in enumerate(self.radios):
            feed_db[number] = radio.fed_dbm if self.has_power else -radio.cable_loss_db
            if radio.frequency_hz is not None and np.isfinite(self.frequency_hz):
                feed_db[number] -= 20 * np.log10(radio.frequency_hz / self.frequency_hz)
        return feed_db

    @property
    def description(self) -> str:
        """The declared values in a few words."""
        known = [radio.tx_power_dbm for radio in self.radios if radio.tx_power_dbm is not None]
        parts = [f"tx_power_dbm {min(known):g} to {max(known):g}"] if known else []
        for name, empty in (("cable_loss_db", 0.0), ("antenna", None), ("frequency_hz", None)):
            having = sum(getattr(radio, name) != empty for radio in self.radios)
            parts += [f"{name} of {count(having, 'device')}"] if having else []
        return ", ".join(parts) or "nothing"

    @property
    def usual_db(self) -> float:
        """Median of `fed_db` over the devices, in its unit; 0 if nothing is declared."""
        return float(np.median(self.fed_db)) if self.radios else 0.0

    @cached_property
    def antennas(self) -> list[tuple[Antenna, np.ndarray]]:
        """Each different antenna, with a mask (k,) of the devices that have it."""
        all_antennas = [radio.antenna for radio in self.radios]
        different = {id(antenna): antenna for antenna in all_antennas if antenna is not None}
        return [(antenna, np.array([each is antenna for each in all_antennas]))
                for antenna in different.values()]

    @property
    def has_antennas(self) -> bool:
        """Whether the antenna of any device, or of the receivers, is declared."""
        return bool(self.antennas) or self.receiver_antenna is not None

    @property
    def knows_powers(self) -> bool:
        """Whether levels are received powers and all transmit powers are known."""
        return self.has_power and bool(self.radios) and all(
            radio.tx_power_dbm is not None for radio in self.radios)

    @cached_property
    def adds_nothing(self) -> bool:
        """Whether the declared radios leave all levels as they are (`added_db` is 0)."""
        return not self.fed_db.any() and not self.has_antennas

    def added_db(self, device: np.ndarray, ray_m: np.ndarray) -> np.ndarray | float:
        """Return declared power, cable loss and antenna gains (n,) [dB] of links, or the number 0.

        `ray_m` (n, 3) goes straight from the device to the receiver; NaN if that may be anywhere.
        """
        if self.adds_nothing:
            return 0.0
        added_db = self.fed_db[device]
        for antenna, of_device in self.antennas:
            rows = np.flatnonzero(of_device[device])
            added_db[rows] += antenna.gain_dbi(ray_m[rows])
        if self.receiver_antenna is not None:
            added_db += self.receiver_antenna.gain_dbi(-ray_m)
        return added_db

    def with_radios(self, radios: dict[int, Radio]) -> Declared:
        """Return a copy with new radios of some devices (by index); unchanged if none is declared.

        Where a new radio declares no value, or 0 dB of cable loss, the old value stays. A transmit
        power is replaced only if the old radio declared one, too.
        """
        if not self.radios:
            return self
        updated = list(self.radios)
        for number, radio in radios.items():
            old = updated[number]
            updated[number] = Radio(
                old.tx_power_dbm if None in (old.tx_power_dbm, radio.tx_power_dbm)
                else radio.tx_power_dbm,
                radio.cable_loss_db or old.cable_loss_db, radio.antenna or old.antenna,
                radio.frequency_hz or old.frequency_hz)
        return replace(self, radios=tuple(updated))

    def of_devices(self, index: np.ndarray) -> Declared:
        """Return a copy with the radios of other devices; `NOTHING` if the radios add nothing.

        `index` (j,) is the old device of each new one; -1: nothing is declared of the new device.
        """
        if self.adds_nothing:
            return NOTHING
        with_default = *self.radios, Radio()
        return replace(self, radios=tuple(with_default[number] for number in index))


NOTHING = Declared((), np.nan, False)


def radios_of(devices: pd.DataFrame, patterns: dict[str, Pattern], scene: Scene | None
              ) -> tuple[Radio, ...]:
    """Read the radio of each of k devices from their table; empty if nothing is declared.

    A device whose row names no antenna has that of the scene. `patterns`: file in column `antenna`
    -> pattern. BadInput if a power contradicts an EIRP, or a pattern is missing.
    """
    of_scene: dict[str, Antenna | None] = {}
    if scene is not None:
        of_scene = dict(zip((each.device for each in scene.config.devices), scene.device_antennas))
    found = []
    for row in devices.to_dict("records"):
        values: dict[str, float | None] = {
            name: None if pd.isna(row.get(name)) else float(row[name])
            for name in ("tx_power_dbm", "eirp_dbm", "cable_loss_db", "azimuth_deg", "tilt_deg",
                         "frequency_hz")}
        antenna = of_scene.get(row["device"])
        name = row.get("antenna")
        if isinstance(name, str) and name:
            if name not in patterns:
                raise BadInput(f"device {row['device']!r}: the content of its antenna's file "
                               f"{name!r} is not given; give it in antenna_files of Measurements")
            antenna = Antenna(patterns[name])
        if antenna is not None:
            azimuth_deg, tilt_deg = values["azimuth_deg"], values["tilt_deg"]
            antenna = Antenna(antenna.pattern,
                              antenna.azimuth_deg if azimuth_deg is None else azimuth_deg,
                              antenna.tilt_deg if tilt_deg is None else tilt_deg)
        loss_db = values["cable_loss_db"] or 0.0
        power_dbm = tx_power_dbm(row["device"], values["tx_power_dbm"], values["eirp_dbm"],
                                 loss_db, antenna)
        found.append(Radio(power_dbm, loss_db, antenna, values["frequency_hz"]))
    return tuple(found) if any(radio != Radio() for radio in found) else ()


def complete(names: Sequence[str], radios: tuple[Radio, ...], has_power: bool,
             scene: Scene | None) -> tuple[tuple[Radio, ...], list[str]]:
    """Fill in missing transmit powers if any device declares one, and note every assumption.

    The scene's declared power is assumed first, else the median of the other devices. Without
    `has_power` levels are gains, and no power is filled in.
    """
    notes: list[str] = []
    known_dbm = [radio.tx_power_dbm for radio in radios if radio.tx_power_dbm is not None]
    if known_dbm and not has_power:
        notes.append("tx_power_dbm of devices is declared and levels are gains, without the power: "
                     "it is not used to learn or to locate, and is that of the devices in coverage")
    elif known_dbm:
        radios, notes = _with_powers(names, radios, known_dbm, "the median of the others", scene)
    if any(radio.antenna for radio in radios):
        notes += _missing(names, radios, lambda radio: radio.antenna is None,
                          "the antenna of {} is not declared, as others' are, and taken for "
                          "isotropic")
    return radios, notes


def antenna_of_uavs(scene: Scene | None, receivers: Sequence[str]
                    ) -> tuple[Antenna | None, list[str]]:
    """Return the scene's antenna of its UAVs, if all receivers (names) are such UAVs, and notes."""
    if scene is None or scene.uav_antenna is None:
        return None, []
    others = sorted(set(receivers) - {each.uav for each in scene.config.uavs})
    if not others:
        return scene.uav_antenna, []
    return None, ["the antenna that the scene declares for its UAVs is not used, and is a part of "
                  f"what is learnt: receivers {some(others)} are none of its UAVs"]


def match_learnt_law(names: Sequence[str], declared: Declared, learnt: Declared, scene: Scene | None
              ) -> tuple[Declared, list[str]]:
    """Adapt the radios of k new devices to a law of channel gain that was learnt from others.

    If the law was learnt with declared transmit powers, missing ones are assumed: the scene's, else
    the median of the learnt devices. If it was learnt without, the powers are part of the law, and
    declared ones are dropped. Notes say so.
    """
    notes: list[str] = []
    radios = declared.radios or tuple(Radio() for _ in names)
    if learnt.knows_powers:
        radios, notes = _with_powers(
            names, radios, [radio.tx_power_dbm or 0.0 for radio in learnt.radios],
            "the median of the twin's devices", scene)
    elif declared.knows_powers:
        notes.append(f"tx_power_dbm of {some(names)} is not used: the twin was learnt "
                     "from received powers of devices that declared none; declare theirs in "
                     "devices.csv and fit again")
        radios = tuple(replace(radio, tx_power_dbm=None) for radio in radios)
    if any(radio.antenna for radio in radios) and not learnt.antennas:
        notes.append("the law of the twin's devices contains whatever antennas they have, and those"
                     " of the devices to be located are added to it: unless they are isotropic "
                     "they count twice; declare their antennas in devices.csv and fit again")
    frequency_hz = declared.frequency_hz if np.isnan(learnt.frequency_hz) else learnt.frequency_hz
    return Declared(radios, frequency_hz, declared.has_power,
                    None if learnt.receiver_antenna is None else declared.receiver_antenna), notes


def _with_powers(names: Sequence[str], radios: tuple[Radio, ...], known_dbm: list[float],
                 source: str, scene: Scene | None) -> tuple[tuple[Radio, ...], list[str]]:
    """Fill in missing transmit powers [dBm], with a note: the scene's power, else a median.

    The median is that of `known_dbm`, which the note calls `source`; `names` are of the devices.
    """
    usual_dbm = float(np.median(known_dbm))
    if scene is not None and scene.config.radio.declares_power:
        usual_dbm, source = scene.config.radio.tx_power_dbm, "the scene's tx_power_dbm"
    notes = _missing(names, radios, lambda radio: radio.tx_power_dbm is None, "tx_power_dbm of {} "
                     f"is not declared and taken for {usual_dbm:g} dBm, {source}")
    return tuple(replace(radio, tx_power_dbm=usual_dbm) if radio.tx_power_dbm is None else radio
                 for radio in radios), notes


def _missing(names: Sequence[str], radios: tuple[Radio, ...], lacks: Callable[[Radio], bool],
             text: str) -> list[str]:
    """Return the note `text` with the names of the radios that lack a value; empty if none does."""
    missing = [name for name, radio in zip(names, radios, strict=True) if lacks(radio)]
    return [text.format(some(missing))] if missing else []
