"""The content of `twin.json`, typed and bounded: the bounds are far beyond what is measured."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from radiotwin.channel.stored import MAX_DB, MAX_SD_DB
from radiotwin.effects.params import Seconds
from radiotwin.measurement_columns import MAX_COORDINATE_M
from radiotwin.tables import Origin

SCHEMA, SCHEMA_1 = "radiotwin.twin/2", "radiotwin.twin/1"
CHANNEL_FILE = "channel.safetensors"
_Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
_Decibels = Annotated[float, Field(ge=-MAX_DB, le=MAX_DB)]
_SdDb = Annotated[float, Field(ge=1e-9, le=MAX_SD_DB)]
_Name = Annotated[str, Field(min_length=1, max_length=1000)]
_Scalar = str | int | float | bool | None
_Json = _Scalar | list[_Scalar] | dict[str, _Scalar]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class DeviceRecord(_Strict):
    """A device; null where a position or a radius is not known."""

    device: _Name
    x_m: _Coordinate | None
    y_m: _Coordinate | None
    z_m: _Coordinate | None
    role: Literal["anchor", "unknown"]
    located: bool
    credible_radius_m: Annotated[float, Field(ge=0, le=MAX_COORDINATE_M)] | None
    second_mode: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] | None


class EffectRecord(_Strict):
    """A fitted effect; `params` are checked by the effect's own `Params`."""

    name: str
    variant: str
    params: dict[str, Any]
    coefficients: list[_Decibels]


class UnheardRecord(_Strict):
    """Mean and uncertainty of devices without a reading."""

    devices: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    mean_db: _Decibels
    sd_db: Annotated[float, Field(ge=0, le=MAX_SD_DB)]


class FittedRecord(_Strict):
    """Levels, effects and errors fitted upon the channel."""

    level_coefficients: Annotated[list[_Decibels], Field(min_length=2, max_length=4)]
    scale_db: Annotated[list[_SdDb], Field(min_length=1, max_length=2)]
    dof: Annotated[float, Field(gt=2, le=1e6)]
    effects: list[EffectRecord]
    receivers: list[_Name]
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


class ChannelRecord(_Strict):
    """Where the channel is, and what it is."""

    model: str
    file: Literal["channel.safetensors"]


class _Provenance(BaseModel):
    """Fields of the provenance that are read; the others are only kept."""

    model_config = ConfigDict(strict=True)

    scene: str | None = None
    scene_hash: str | None = None
    origin: Origin | None = None


class TwinRecord(_Strict):
    """Content of `twin.json`."""

    schema_: Literal["radiotwin.twin/1", "radiotwin.twin/2"] = Field(alias="schema")
    channel: ChannelRecord
    devices: Annotated[list[DeviceRecord], Field(min_length=1)]
    level: Literal["gain_db", "rssi_dbm"]
    limit_db: _Decibels | None
    provenance: dict[str, _Json]
    fitted: FittedRecord | None = None

    @field_validator("devices")
    @classmethod
    def _unique(cls, devices: list[DeviceRecord]) -> list[DeviceRecord]:
        names = [device.device for device in devices]
        if len(set(names)) < len(names):
            raise ValueError("a device is listed twice")
        return devices

    @field_validator("provenance")
    @classmethod
    def _readable(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        _Provenance.model_validate(provenance)
        return provenance
