"""File format of twins: `twin.json` (typed and bounded), and `channel.safetensors`.

Bounds of numbers are far wider than any measurement.
"""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from radiotwin.effects.base import Effect, Levels
from radiotwin.effects.params import Seconds
from radiotwin.effects.registry import effect_named
from radiotwin.errors import BadInput
from radiotwin.io.files import require_folder
from radiotwin.io.forms import MAX_POSITION_M, Origin, Real
from radiotwin.io.inputs import parse_json
from radiotwin.links.declared import NOTHING, Declared, Radio
from radiotwin.links.links import Columns, Ends, Flown, Links, World
from radiotwin.links.plausible import (
    FREQUENCIES_HZ,
    MAX_ANGLE_DEG,
    MAX_CABLE_LOSS_DB,
    MAX_LEVEL_DB,
    MAX_TILT_DEG,
)
from radiotwin.propagation.laws import ChannelModel
from radiotwin.propagation.laws.base import MAX_DB, MAX_SD_DB, require_array, require_names
from radiotwin.propagation.laws.registry import BUILT_IN, decode_both, encode_channel
from radiotwin.scene.antennas import MAX_GAIN_DBI, Antenna, Pattern
from radiotwin.twin.localize.estimate import Name, TwinDevice
from radiotwin.twin.model.blend import Blend
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing
from radiotwin.twin.model.model import FittedModel, Unheard

if TYPE_CHECKING:
    from radiotwin.twin.twin import Twin

SCHEMA = "radiotwin.twin/2"
PATTERN = "pattern"  # prefix of arrays of antenna patterns, followed by the pattern's number
CHANNEL_FILE = "channel.safetensors"
_Decibels = Annotated[float, Field(ge=-MAX_DB, le=MAX_DB)]
_SdDb = Annotated[float, Field(ge=1e-9, le=MAX_SD_DB)]
_Scalar = str | int | float | bool | None
_Json = _Scalar | list[_Scalar] | dict[str, _Scalar] | list[dict[str, _Scalar]]
TWIN_FILE = "twin.json"
TWIN_FILES = {TWIN_FILE, CHANNEL_FILE, "report.html"}  # the last is made by `radiotwin report`


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class FittedEffectRecord(_Strict):
    """A fitted effect; its class checks `params`; `levels` None: the class's default."""

    name: str
    variant: str
    params: dict[str, Any]
    levels: Levels | None = None
    coefficients: list[_Decibels]


class UnheardRecord(_Strict):
    """Content of `Unheard`: offsets to expect of devices without a reading."""

    devices: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    mean_db: _Decibels
    sd_db: Annotated[float, Field(ge=0, le=MAX_SD_DB)]


class FittedRecord(_Strict):
    """Content of `FittedModel` without its channel."""

    level_coefficients: Annotated[list[_Decibels], Field(min_length=2, max_length=4)]
    scale_db: Annotated[list[_SdDb], Field(min_length=1, max_length=2)]
    dof: Annotated[float, Field(gt=2, le=1e6)]
    effects: list[FittedEffectRecord]
    receivers: list[Name]
    first_s: Seconds | None
    device_sd_db: Annotated[float, Field(ge=0, le=MAX_SD_DB)]
    likelihood_power: Annotated[float, Field(gt=0, le=1)]
    shadowing: dict[str, Any] | None
    radius_factor: Annotated[float, Field(ge=1, le=1e6)] = 1.0
    typical_misfit: Annotated[float, Field(ge=0, le=1e6)] | None = None
    blend: dict[str, Any] | None = None
    unheard: UnheardRecord | None = None

    @field_validator("receivers")
    @classmethod
    def _unique(cls, receivers: list[str]) -> list[str]:
        if len(set(receivers)) < len(receivers):
            raise ValueError("a receiver is listed twice")
        return receivers


class AntennaRecord(_Strict):
    """Antenna of a device or receiver; `pattern` numbers the arrays in the channel's file."""

    pattern: Annotated[int, Field(ge=0)]
    azimuth_deg: Annotated[float, Field(ge=-MAX_ANGLE_DEG, le=MAX_ANGLE_DEG)]
    tilt_deg: Annotated[float, Field(ge=-MAX_TILT_DEG, le=MAX_TILT_DEG)]


class RadioRecord(_Strict):
    """Declared radio of a device."""

    tx_power_dbm: Annotated[float, Field(ge=-2 * MAX_LEVEL_DB, le=2 * MAX_LEVEL_DB)] | None
    cable_loss_db: Annotated[float, Field(ge=0, le=MAX_CABLE_LOSS_DB)]
    antenna: AntennaRecord | None
    frequency_hz: Annotated[float, Field(ge=FREQUENCIES_HZ[0], le=FREQUENCIES_HZ[1])] | None


class DeclaredRecord(_Strict):
    """Declared radio of each device, and the carrier frequency of the channel."""

    radios: list[RadioRecord]
    receiver_antenna: AntennaRecord | None = None
    frequency_hz: Annotated[float, Field(ge=FREQUENCIES_HZ[0], le=FREQUENCIES_HZ[1])] | None


class ChannelRecord(_Strict):
    """Name of the channel model, and its file."""

    model: str
    file: Literal["channel.safetensors"]


class _ErrorCorrelation(_Strict):
    """Content of `ErrorCorrelation`."""

    share: Annotated[float, Field(ge=0, le=1)]
    length_m: Annotated[float, Field(gt=0, le=MAX_POSITION_M)]
    level_sd_db: Annotated[float, Field(ge=0, le=100)]
    devices: Annotated[int, Field(ge=0)]


class _LawParameter(_Strict):
    """A row of `radiotwin.twin.law.COLUMNS`."""

    links: Literal["all", "LoS", "NLoS"]
    parameter: str
    value: Real
    low: Real | None
    high: Real | None
    unit: str


class _HeldOutError(_Strict):
    """A row of `HeldOut.record`."""

    model: str
    rmse_db: Real
    by: Literal["flight", "block"]
    as_good: bool


class _Provenance(BaseModel):
    """Fields of the provenance that are read; others are stored without checks."""

    model_config = ConfigDict(strict=True)

    scene: str | None = None
    scene_hash: str | None = None
    origin: Origin | None = None
    receiver_heights_m: Annotated[list[Real], Field(min_length=2, max_length=2)] | None = None
    map_errors: _ErrorCorrelation | None = None
    held_out: Annotated[list[_HeldOutError], Field(max_length=10)] | None = None
    law: Annotated[list[_LawParameter], Field(max_length=10)] | None = None


class TwinRecord(_Strict):
    """Content of `twin.json`."""

    schema_: Literal["radiotwin.twin/2"] = Field(alias="schema")
    channel: ChannelRecord
    devices: Annotated[list[TwinDevice], Field(min_length=1)]
    level: Literal["gain_db", "rssi_dbm"]
    limit_db: _Decibels | None
    provenance: dict[str, _Json]
    fitted: FittedRecord | None = None
    declared: DeclaredRecord | None = None

    @field_validator("devices")
    @classmethod
    def _unique(cls, devices: list[TwinDevice]) -> list[TwinDevice]:
        names = [device.device for device in devices]
        if len(set(names)) < len(names):
            raise ValueError("a device is listed twice")
        return devices

    @field_validator("provenance")
    @classmethod
    def _readable(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        _Provenance.model_validate(provenance)
        return provenance


def encode_twin(twin: Twin) -> tuple[str, bytes]:
    """Encode a twin as the contents of its two files, `twin.json` and the channel."""
    fitted = twin.fitted
    declared, patterns = _declared_record(twin.declared)
    beside = patterns | (fitted.blend.state()[0] if fitted.blend else {})
    record = {"schema": SCHEMA, "channel": {"model": twin.channel.name, "file": CHANNEL_FILE},
              "level": twin.level, "limit_db": twin.limit_db,
              "devices": [device.record for device in twin.devices],
              "fitted": None if fitted.is_channel_alone else _fitted_record(fitted),
              "provenance": twin.provenance}
    if declared is not None:
        record["declared"] = declared
    return json.dumps(record, indent=1, allow_nan=False), encode_channel(twin.channel, beside)


def decode_twin(record: str, channel: bytes, source: object) -> dict[str, Any]:
    """Decode the files of `encode_twin` to the attributes of `Twin` by name.

    BadInput, with the path `source`, if they are damaged, or an effect is not installed.
    """
    given = parse_json(record, source)
    try:
        schema = given["schema"]
        if schema != SCHEMA:
            raise BadInput(f"{source}: schema is {str(schema)[:60]!r}, this version reads "
                           f"{SCHEMA!r}")
        model, beside = decode_both(channel, f"the channel of {source}")
        content = TwinRecord.model_validate(given)
        if content.channel.model != model.name:
            raise ValueError(f"the channel is {model.name}, not {content.channel.model[:60]}")
        patterns = {name: beside.pop(name) for name in list(beside) if name.startswith(PATTERN)}
        declared = _declared(content, patterns)
        fitted = FittedModel.of_channel(model) if content.fitted is None else _fitted(
            content.fitted, model, content.devices, beside)
        return {"fitted": fitted, "devices": content.devices, "level": content.level,
                "limit_db": content.limit_db, "provenance": content.provenance,
                "declared": declared}
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise BadInput(f"{source} is damaged ({type(error).__name__}: {str(error)[:500]}); run "
                       "`radiotwin fit` again") from None


def check_twin_target(folder: Path) -> None:
    """Raise BadInput unless the folder is new, or holds only a twin and its page."""
    require_folder(folder, TWIN_FILES, mark=TWIN_FILE)


def _declared_record(declared: Declared) -> tuple[dict[str, Any] | None, dict[str, np.ndarray]]:
    """Return the record of declared radios (None without any), and arrays of antenna patterns."""
    if not declared.radios:
        return None, {}
    patterns: dict[int, Pattern] = {}

    def record(antenna: Antenna | None) -> dict[str, Any] | None:
        if antenna is None:
            return None
        patterns[id(antenna.pattern)] = antenna.pattern
        return {"pattern": list(patterns).index(id(antenna.pattern)),
                "azimuth_deg": antenna.azimuth_deg, "tilt_deg": antenna.tilt_deg}

    radios = [{"tx_power_dbm": radio.tx_power_dbm, "cable_loss_db": radio.cable_loss_db,
               "antenna": record(radio.antenna), "frequency_hz": radio.frequency_hz}
              for radio in declared.radios]
    known_hz = None if np.isnan(declared.frequency_hz) else declared.frequency_hz
    return {"radios": radios, "receiver_antenna": record(declared.receiver_antenna),
            "frequency_hz": known_hz}, {
        f"{PATTERN}{number}/{field.name}": getattr(pattern, field.name)
        for number, pattern in enumerate(patterns.values()) for field in fields(pattern)}


def _declared(content: TwinRecord, arrays: dict[str, np.ndarray]) -> Declared:
    """Restore declared radios from a record and the arrays of antenna patterns, after checks."""
    record = content.declared
    if record is None:
        if arrays:
            raise ValueError("patterns beside the channel belong to no device")
        return NOTHING
    if len(record.radios) != len(content.devices):
        raise ValueError(f"{len(record.radios)} radios are declared of {len(content.devices)} "
                         "devices")
    patterns, names = [], [field.name for field in fields(Pattern)]
    count = len(arrays) // len(names)
    require_names("patterns", arrays, [f"{PATTERN}{number}/{name}" for number in range(count)
                                       for name in names])
    for number in range(count):
        parts = {name.removeprefix(f"{PATTERN}{number}/"): array for name, array in arrays.items()}
        azimuth_deg = require_array(parts, "azimuth_deg", (None,), 0, 360)
        elevation_deg = require_array(parts, "elevation_deg", (None,), -90, 90)
        if len(elevation_deg) < 2 or not len(azimuth_deg) \
                or not all((np.diff(axis) > 0).all() for axis in (azimuth_deg, elevation_deg)):
            raise ValueError("angles of a pattern are not in order")
        patterns.append(Pattern(azimuth_deg, elevation_deg, require_array(
            parts, "gain_dbi", (len(elevation_deg), len(azimuth_deg)), -MAX_DB, MAX_GAIN_DBI)))

    def antenna(stored: AntennaRecord | None) -> Antenna | None:
        return None if stored is None else Antenna(patterns[stored.pattern], stored.azimuth_deg,
                                                   stored.tilt_deg)

    radios = tuple(Radio(radio.tx_power_dbm, radio.cable_loss_db, antenna(radio.antenna),
                         radio.frequency_hz) for radio in record.radios)
    return Declared(radios, np.nan if record.frequency_hz is None else record.frequency_hz,
                    content.level == "rssi_dbm", antenna(record.receiver_antenna))


def _fitted_record(fitted: FittedModel) -> dict[str, Any]:
    """Return a fitted model as the content of `FittedRecord` for JSON, with null for NaN."""
    effects = [effect.record() | {"coefficients": coefficients.tolist()}
               for effect, coefficients in zip(fitted.effects, fitted.coefficients, strict=True)]
    return {"level_coefficients": fitted.level_coefficients.tolist(),
            "scale_db": fitted.scale_db.tolist(), "dof": float(fitted.dof), "effects": effects,
            "receivers": list(fitted.receivers),
            "first_s": None if np.isnan(fitted.first_s) else fitted.first_s,
            "device_sd_db": fitted.device_sd_db, "likelihood_power": fitted.likelihood_power,
            "shadowing": fitted.shadowing.state() if fitted.shadowing else None,
            "radius_factor": fitted.radius_factor,
            "typical_misfit": None if np.isnan(fitted.typical_misfit) else fitted.typical_misfit,
            "blend": fitted.blend.state()[1] if fitted.blend else None,
            "unheard": None if fitted.unheard is None else vars(fitted.unheard) | {
                "devices": list(fitted.unheard.devices)}}


def _fitted(record: FittedRecord, channel: ChannelModel, devices: list[TwinDevice],
            beside: dict[str, np.ndarray]) -> FittedModel:
    """Restore a fitted model from its record, its channel, and arrays beside the channel."""
    _check_levels(record, channel)
    device_m = np.array([device.position_m for device in devices])
    known = {"device": len(devices), "receiver": len(record.receivers)}
    effects, coefficients = [], []
    for stored in record.effects:
        effect = effect_named(stored.name, stored.variant)
        # As JSON: strict validation then still accepts lists for tuples.
        params = effect.Params.model_validate_json(json.dumps(stored.params), strict=True,
                                                   context=known)
        effects.append(effect.with_params(params, stored.levels))
        coefficients.append(np.array(stored.coefficients, dtype=float))
    shadowing = None
    if record.shadowing is not None:
        shadowing = CorrelatedShadowing.from_state(record.shadowing)
    blend = None
    if beside and record.blend is None:
        raise ValueError("arrays beside the channel belong to nothing")
    if record.blend is not None:
        blend = Blend.from_state(beside, record.blend, len(devices))
    unheard = None
    if record.unheard is not None:
        unheard = Unheard(tuple(record.unheard.devices), record.unheard.mean_db,
                          record.unheard.sd_db)
        if max(unheard.devices) >= len(devices):
            raise ValueError(f"there is no device of index {max(unheard.devices)}")
    _check_terms(effects, coefficients, [device.device for device in devices], record.receivers)
    return FittedModel(channel, tuple(effects), tuple(coefficients),
                       np.array(record.level_coefficients), np.array(record.scale_db), record.dof,
                       np.nan_to_num(device_m), tuple(record.receivers),
                       np.nan if record.first_s is None else record.first_s,
                       record.device_sd_db, record.likelihood_power, shadowing,
                       record.radius_factor,
                       np.nan if record.typical_misfit is None else record.typical_misfit, blend,
                       unheard)


def _check_terms(effects: list[Effect], coefficients: list[np.ndarray], devices: list[str],
                 receivers: list[str]) -> None:
    """Raise ValueError if effects do not fit their coefficients, or add non-finite levels.

    Tried on a few made-up links; effects that need a map or trace paths are checked as they
    predict.
    """
    n = max(len(devices), len(receivers), 2)
    row, nothing = np.arange(n), np.zeros(n)
    columns = Columns(
        level_db=np.full(n, -80.0), limit_db=np.full(n, -np.inf),
        receiver_m=np.column_stack([100.0 + row, nothing, np.full(n, 30.0)]),
        device=row % len(devices), receiver=row % max(len(receivers), 1), flight=row % 2,
        time_s=row.astype(float), heading_deg=nothing)
    links = Links(
        columns=columns, world=World(frequency_hz=2.4e9, city=None, is_gain=True),
        ends=Ends(device_names=devices, receiver_names=receivers or ["any"],
                  flight_names=["f0", "f1"], device_m=np.zeros((len(devices), 3)),
                  anchors=frozenset(range(len(devices))), flown=Flown.of(columns)))
    for effect, stored in zip(effects, coefficients, strict=True):
        if effect.needs_map or effect.is_exact:
            continue  # checked when it predicts
        term = effect.term(links, lambda links, exact=False: np.zeros(len(links)))
        if term.columns.shape[1] != len(stored):
            raise ValueError(f"{effect.name} needs {term.columns.shape[1]} coefficients and "
                             f"has {len(stored)}")
        if not (np.isfinite(term.offset_db).all() and np.isfinite(term.columns).all()):
            raise ValueError(f"{effect.name} adds levels that are not finite")


def _check_levels(record: FittedRecord, channel: ChannelModel) -> None:
    """Raise ValueError if the numbers of levels and error scales are wrong for the channel."""
    if not isinstance(channel, BUILT_IN):
        return
    allowed = {(2, 1), (4, 2)} if channel.uses_map else {(2, 1)}
    allowed = {(4, 2)} if channel.follows_paths else allowed
    given = len(record.level_coefficients), len(record.scale_db)
    if given not in allowed:
        raise ValueError(f"{given[0]} levels and {given[1]} scales do not fit {channel.name}")
