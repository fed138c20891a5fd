"""Twins as folders: `twin.json`, and the channel in a file of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from radiotwin.channel import ChannelModel, load_channel, save_channel
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.effects.correlated_shadowing import CorrelatedShadowing
from radiotwin.effects.effect_model import EffectModel
from radiotwin.effects.fold_model import FittedEffect
from radiotwin.effects.registry import effect_named
from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, require_writable
from radiotwin.localize import TwinDevice

SCHEMA, SCHEMA_1 = "radiotwin.twin/2", "radiotwin.twin/1"
CHANNEL_FILE = "channel.safetensors"
TWIN_FILES = {"twin.json", CHANNEL_FILE, "report.html"}  # the last is what `radiotwin report` makes


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class _DeviceRecord(_Strict):
    """A device; null where a position or a radius is not known."""

    device: str
    x_m: float | None
    y_m: float | None
    z_m: float | None
    role: Literal["anchor", "unknown"]
    located: bool
    credible_radius_m: float | None
    second_mode: Annotated[list[float], Field(min_length=3, max_length=3)] | None


class _EffectRecord(_Strict):
    """A fitted effect; `params` are checked by the effect's own `Params`."""

    name: str
    variant: str
    params: dict[str, Any]
    coefficients: list[float]


class _FittedRecord(_Strict):
    """Levels, effects and errors fitted upon the channel."""

    level_coefficients: Annotated[list[float], Field(min_length=2, max_length=4)]
    scale_db: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1, max_length=2)]
    dof: Annotated[float, Field(gt=2)]
    effects: list[_EffectRecord]
    receivers: list[str]
    first_s: float | None
    device_sd_db: Annotated[float, Field(ge=0)]
    likelihood_power: Annotated[float, Field(gt=0, le=1)]
    shadowing: dict[str, Any] | None


class _TwinRecord(BaseModel):
    """Content of `twin.json`."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    devices: Annotated[list[_DeviceRecord], Field(min_length=1)]
    level: Literal["gain_db", "rssi_dbm"]
    limit_db: float | None
    provenance: dict
    fitted: _FittedRecord | None = None

    @field_validator("devices")
    @classmethod
    def _unique(cls, devices: list[_DeviceRecord]) -> list[_DeviceRecord]:
        names = [device.device for device in devices]
        if len(set(names)) < len(names):
            raise ValueError("a device is listed twice")
        return devices


def write_twin(folder: Path | str, channel: ChannelModel, devices: list[TwinDevice], level: str,
               limit_db: float | None, provenance: dict, fitted: EffectModel | None) -> None:
    """Write a twin's folder, whole or not at all.

    Args:
        folder: to write; a twin that is in it is replaced.
        channel: fitted.
        devices: in the order of the measurements' `devices.csv`.
        level: `gain_db`, or `rssi_dbm` where transmit power is unknown.
        limit_db: level below which receivers do not detect [dB]; None where it was not known.
        provenance: measurements, scene, seed and version that made it.
        fitted: levels, effects and errors fitted upon the channel, if there are any.

    Raises:
        BadInput: the folder exists and is not a twin's.
    """
    folder = Path(folder)
    check_twin_target(folder)
    record = {"schema": SCHEMA, "channel": {"model": channel.name, "file": CHANNEL_FILE},
              "level": level, "limit_db": limit_db,
              "devices": [_device_record(device) for device in devices],
              "fitted": _fitted_record(fitted) if fitted else None, "provenance": provenance}
    with atomic_folder(folder) as temporary:
        save_channel(channel, temporary / CHANNEL_FILE)
        text = json.dumps(record, indent=1, allow_nan=False)
        (temporary / "twin.json").write_text(text, encoding="utf-8")


def read_twin(folder: Path | str) -> dict[str, Any]:
    """Read a twin's folder, of this version or of version 0.1.

    Returns:
        the attributes of `Twin` by name.

    Raises:
        BadInput: not a twin's folder, a damaged one, or effects that are not installed.
    """
    folder = Path(folder)
    path = folder / "twin.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        schema = record["schema"]
        if schema not in (SCHEMA, SCHEMA_1):
            raise BadInput(f"{path}: schema is {schema!r}, this version reads {SCHEMA!r} and "
                           f"{SCHEMA_1!r}")
        channel = load_channel(folder / CHANNEL_FILE)
        if schema == SCHEMA_1:
            record, channel = _from_version_1(record, channel)
        content = _TwinRecord.model_validate(record)
        devices = [_device(device) for device in content.devices]
        fitted = None if content.fitted is None else _fitted(content.fitted, channel, devices)
        return {"channel": channel, "devices": devices, "level": content.level,
                "limit_db": content.limit_db, "provenance": content.provenance, "fitted": fitted}
    except (FileNotFoundError, NotADirectoryError):
        raise BadInput(f"{folder} is not a twin's folder (no twin.json); `radiotwin fit` makes "
                       "one") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{path} is damaged ({type(error).__name__}: {error}); run `radiotwin fit` "
                       "again") from None


def check_twin_target(folder: Path) -> None:
    """Check that a twin can be written there without loss of anything but a twin and its page.

    Raises:
        BadInput: it cannot.
    """
    require_writable(folder / "twin.json")
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    foreign = sorted(name for name in names - TWIN_FILES if not name.startswith("."))
    if foreign:
        raise BadInput(f"{folder} holds {foreign[0]}, which is not a twin's and would be lost; "
                       "choose another output folder, or move it away")


def _fitted_record(fitted: EffectModel) -> dict[str, Any]:
    effects = [{"name": each.effect.name, "variant": each.effect.variant,
                "params": each.params.model_dump(mode="json"),
                "coefficients": each.coefficients.tolist()} for each in fitted.effects]
    return {"level_coefficients": fitted.level_coefficients.tolist(),
            "scale_db": fitted.scale_db.tolist(), "dof": float(fitted.dof), "effects": effects,
            "receivers": list(fitted.receivers),
            "first_s": None if np.isnan(fitted.first_s) else fitted.first_s,
            "device_sd_db": fitted.device_sd_db, "likelihood_power": fitted.likelihood_power,
            "shadowing": fitted.shadowing.state() if fitted.shadowing else None}


def _fitted(record: _FittedRecord, channel: ChannelModel,
            devices: list[TwinDevice]) -> EffectModel:
    device_m = np.array([(each.x_m, each.y_m, each.z_m) for each in devices])
    effects = []
    for each in record.effects:
        effect = effect_named(each.name, each.variant)
        params = effect.Params.model_validate(each.params)
        effects.append(FittedEffect(effect, params, np.array(each.coefficients)))
    shadowing = CorrelatedShadowing.from_state(record.shadowing) if record.shadowing else None
    return EffectModel(channel, tuple(effects), np.array(record.level_coefficients),
                       np.array(record.scale_db), record.dof, np.nan_to_num(device_m),
                       tuple(record.receivers),
                       np.nan if record.first_s is None else record.first_s,
                       record.device_sd_db, record.likelihood_power, shadowing)


def _from_version_1(record: dict, channel: ChannelModel) -> tuple[dict, ChannelModel]:
    """Return the record and the channel as version 2 has them.

    There, paths were followed upon a law (`base`), and effects had a `setting`.
    """
    old = record.get("effects")
    record = {name: value for name, value in record.items() if name != "effects"}
    if not isinstance(old, dict) or not old:  # a list, always empty, in the earliest twins
        return record, channel
    if old["base"] == "raytrace":
        gain_db, exponent = map(float, old["rest"])
        channel = ImagePaths(channel, (gain_db, exponent))
    shadowing = old.get("shadowing")
    if shadowing is not None:
        shadowing = {name: value for name, value in shadowing.items() if name != "sigma"} | {
            "relative_sd": shadowing["sigma"]}
    record["fitted"] = {
        "level_coefficients": old["coefficients"], "scale_db": old["scale_db"], "dof": old["dof"],
        "effects": [{"name": part["name"], "variant": part["variant"], "params": part["setting"],
                     "coefficients": part["coefficients"]} for part in old["parts"]],
        "receivers": old["receivers"], "first_s": old["first_s"],
        "device_sd_db": old["device_spread_db"], "likelihood_power": old["temper"],
        "shadowing": shadowing}
    return record, channel


def _device_record(device: TwinDevice) -> dict[str, Any]:
    """Return a device for JSON, which has neither NaN nor infinity: they are null."""
    return {name: None if isinstance(value, float) and not np.isfinite(value) else value
            for name, value in vars(device).items()}


def _device(record: _DeviceRecord) -> TwinDevice:
    x_m, y_m, z_m = (np.nan if each is None else each
                     for each in (record.x_m, record.y_m, record.z_m))
    radius_m = np.inf if record.credible_radius_m is None else record.credible_radius_m
    mode = None if record.second_mode is None else (*record.second_mode,)
    return TwinDevice(record.device, x_m, y_m, z_m, record.role, record.located, radius_m, mode)  # type: ignore[arg-type]
