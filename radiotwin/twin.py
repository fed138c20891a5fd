"""The twin: a channel learned from anchors, the positions of all devices, and where both come from."""

import json
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

import radiotwin
from radiotwin.channel import MODELS, ChannelModel, check_fit_data, load_channel, make_links, save_channel
from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, require_writable
from radiotwin.localize import LocalizeSettings, localize
from radiotwin.measurements import Measurements
from radiotwin.progress import progress
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene

SCHEMA = "radiotwin.twin/1"
CHANNEL_FILE = "channel.safetensors"
RAYTRACE = "raytrace"  # a model that is not of distance, elevation and line of sight alone
TWIN_FILES = {"twin.json", CHANNEL_FILE, "report.html"}  # the last one is what `radiotwin report` makes of the others
MAP_CHUNK = 200_000  # links predicted at once
FEW_BLANK, LIMIT_GAP_DB = 0.02, 10.0  # from which on blanks and the limit of detection are said not to fit together


Predictor = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""See `Twin.predictor`."""


@dataclass(frozen=True)
class TwinDevice:
    """A device as the twin knows it.

    Attributes:
        device: its name.
        x_m, y_m, z_m: declared position of an anchor, estimate of an unknown device; NaN where nothing tells it.
        role: `anchor` or `unknown`.
        located: whether the position may be relied on; always so for anchors.
        credible_radius_m: holds 90 % of the posterior; 0 for anchors.
        second_mode: (x_m, y_m, weight) of another place that explains the data, too.
    """

    device: str
    x_m: float
    y_m: float
    z_m: float
    role: str
    located: bool
    credible_radius_m: float
    second_mode: tuple[float, float, float] | None


class _DeviceRecord(BaseModel):
    """A device in `twin.json`; null where a position or a radius is not known."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    device: str
    x_m: float | None
    y_m: float | None
    z_m: float | None
    role: Literal["anchor", "unknown"]
    located: bool
    credible_radius_m: float | None
    second_mode: Annotated[list[float], Field(min_length=3, max_length=3)] | None


class _TwinFile(BaseModel):
    """What is read of `twin.json`."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    devices: list[_DeviceRecord] = Field(min_length=1)
    level: Literal["gain_db", "rssi_dbm"]
    limit_db: float | None
    provenance: dict
    effects: dict | list[dict] = {}  # a list, always empty, in twins of earlier versions

    @field_validator("devices")
    @classmethod
    def _unique(cls, devices: list[_DeviceRecord]) -> list[_DeviceRecord]:
        names = [device.device for device in devices]
        if len(set(names)) < len(names):
            raise ValueError("a device stands there twice")
        return devices


@dataclass(frozen=True, eq=False)
class Twin:
    """A learned model of all links of a scene.

    Attributes:
        channel: fitted model.
        devices: in the order of the measurements' `devices.csv`.
        level: `gain_db`, or `rssi_dbm` where transmit power is unknown.
        limit_db: the level below which receivers do not detect; None where it was not known.
        provenance: measurements, scene, seed and version that made it.
        effects: what `close-loop` found, as `radiotwin.closeloop.corrected` reads it; empty where it did not look.
    """

    channel: ChannelModel
    devices: list[TwinDevice]
    level: str
    limit_db: float | None
    provenance: dict = field(default_factory=dict)
    effects: dict = field(default_factory=dict)

    @property
    def device_m(self) -> np.ndarray:
        """(k, 3) positions [m]; NaN where a device could not be located."""
        return np.array([(d.x_m, d.y_m, d.z_m) for d in self.devices], dtype=float).reshape(-1, 3)

    def predictor(self, scene: Scene) -> "Predictor":
        """What tells the links between receivers (n, 3) and the twin's devices (n,), where it has them in a scene.

        Returns:
            receivers [m], indices of devices -> mean and standard deviation of the level [dB] (n,), also below what is
            detected, and whether there is line of sight (n,)
        """
        if self.effects:
            # Effects are built upon the twin, and only they know what they do; a twin without them would be wrong.
            from radiotwin.closeloop.corrected import corrected_predictor

            return corrected_predictor(self, scene)

        def predict(receiver_m: np.ndarray, device: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            links = make_links(self.device_m, receiver_m, device, scene.city)
            return *self.channel.predict(links), links.los

        return predict

    def radio_map(self, scene: Scene) -> RadioMap:
        """Mean and standard deviation of the level over a scene's lattice, for all devices that have a position.

        The mean is given below sensitivity, too; attribute `gain_limit_db` says where detection ends.
        """
        scene_hash = scene.content_hash()
        self._warn_of_another_scene(scene, scene_hash)
        predict = self.predictor(scene)
        known = np.flatnonzero(np.isfinite(self.device_m).all(axis=1))
        receiver_m = scene.lattice.positions_m
        shape = (len(known), len(receiver_m))
        mean_db, sigma_db, los = np.empty(shape), np.empty(shape), np.empty(shape, dtype=bool)
        with progress("mapping", total=len(known)) as advance:
            for row, device in enumerate(known):
                for start in range(0, len(receiver_m), MAP_CHUNK):
                    part = slice(start, start + MAP_CHUNK)
                    ends = receiver_m[part]
                    mean_db[row, part], sigma_db[row, part], los[row, part] = predict(ends, np.full(len(ends), device))
                advance(1)
        if self.level == "rssi_dbm":
            mean_db -= scene.config.radio.tx_power_dbm
        attributes = {"source": f"twin:{self._described()}", "frequency_hz": scene.config.radio.frequency_hz,
                      "gain_limit_db": scene.config.gain_limit_db, "scene_hash": scene_hash,
                      "radiotwin_version": radiotwin.__version__}
        names = [self.devices[i].device for i in known]
        return RadioMap.build(names, scene.lattice, mean_db, los, sigma_db, attributes)

    def _warn_of_another_scene(self, scene: Scene, scene_hash: str) -> None:
        """Warn where the twin was learnt elsewhere."""
        if self.provenance.get("scene_hash") not in (None, scene_hash):
            warnings.warn(f"the twin was learnt in another scene ({self.provenance.get('scene')}) than {scene.folder}, "
                          "or this one has changed since: geometry, radio or declared devices differ", stacklevel=3)

    def _described(self) -> str:
        if not self.effects:
            return self.channel.name
        from radiotwin.closeloop.corrected import described

        return described(self)

    def save(self, folder: Path | str) -> None:
        """Write the twin's folder, whole or not at all.

        Raises:
            BadInput: the folder exists and is not a twin's.
        """
        folder = Path(folder)
        check_twin_target(folder)
        record = {"schema": SCHEMA, "channel": {"model": self.channel.name, "file": CHANNEL_FILE},
                  "level": self.level, "limit_db": self.limit_db,
                  "devices": [_without_nan(asdict(device)) for device in self.devices],
                  "effects": self.effects, "provenance": self.provenance}
        with atomic_folder(folder) as temporary:
            save_channel(self.channel, temporary / CHANNEL_FILE)
            (temporary / "twin.json").write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path | str) -> "Twin":
        """Read a twin's folder.

        Raises:
            BadInput: not a twin's folder, or a damaged one.
        """
        folder = Path(folder)
        path = folder / "twin.json"
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if record["schema"] != SCHEMA:
                raise BadInput(f"{path}: schema is {record['schema']!r}, this version reads {SCHEMA!r}")
            content = _TwinFile.model_validate(record)
            devices = [TwinDevice(**_with_nan(device.model_dump())) for device in content.devices]
            channel = load_channel(folder / CHANNEL_FILE)
            return cls(channel, devices, content.level, content.limit_db, content.provenance,
                       content.effects if isinstance(content.effects, dict) else {})
        except (FileNotFoundError, NotADirectoryError):
            raise BadInput(f"{folder} is not a twin's folder (no twin.json); `radiotwin fit` makes one") from None
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise BadInput(f"{path} is damaged ({type(error).__name__}: {error}); run `radiotwin fit` again") from None


def check_twin_target(folder: Path) -> None:
    """Raise BadInput unless a twin can be written there without loss of anything but a twin and its page."""
    require_writable(folder / "twin.json")
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    foreign = sorted(name for name in names - TWIN_FILES if not name.startswith("."))
    if foreign:
        raise BadInput(f"{folder} holds {foreign[0]}, which is not a twin's and would be lost; choose another output "
                       "folder, or move it away")


def fit_twin(measurements: Measurements, scene: Scene, *, model: str = "segmented_nn", seed: int,
             start: "Twin | None" = None, allow_indoor: bool = False) -> Twin:
    """Learn the channel from the anchors' links, then find the unknown devices with it.

    Args:
        measurements: links to anchors and unknown devices.
        scene: its map and extent, and the receivers' sensitivity.
        model: a key of `radiotwin.channel.MODELS`, or `raytrace`: paths over the 3D map, see
            `radiotwin.closeloop.corrected.raytraced_twin`.
        seed: of the channel's and the search's random numbers.
        start: an earlier twin; the search also starts from its positions.
        allow_indoor: whether unknown devices may be inside buildings.

    Raises:
        BadInput: no anchor, nothing detected, links that no channel can be learned from, or devices that may be
            indoors with `raytrace`.
    """
    if start is not None:
        start._warn_of_another_scene(scene, scene.content_hash())
    if model == RAYTRACE:
        if allow_indoor:
            raise BadInput(f"model {RAYTRACE} follows paths outside buildings only; take another model where unknown "
                           "devices may be indoors")
        # Built upon a law that is fitted here, and so imported late.
        from radiotwin.closeloop.corrected import raytraced_twin

        return raytraced_twin(measurements, scene, seed, start)
    if model not in MODELS:
        raise BadInput(f"channel model {model!r} is unknown; allowed are {', '.join((*MODELS, RAYTRACE))}")
    _check_positions(measurements, scene)
    level = measurements.level_column
    radio = scene.config.radio
    limit_db = scene.config.gain_limit_db if level == "gain_db" else radio.sensitivity_dbm
    _check_limit(measurements, limit_db)
    # Where a file gives x and y of an unknown device, too, they are not to be learned from.
    anchors_m = np.where(measurements.is_anchor[:, None], measurements.device_m, np.nan)
    channel = _fit_channel(measurements, anchors_m, scene, MODELS[model](), limit_db, seed)
    devices: list[Any] = [_anchor(row) if row.role == "anchor" else None for row in measurements.devices.itertuples()]
    unknown = np.flatnonzero(~measurements.is_anchor)
    if len(unknown):
        settings = LocalizeSettings(allow_indoor=allow_indoor)
        located = _locate(measurements, scene, channel.trend, unknown, limit_db, seed, start, settings)
        for index, found in zip(unknown, located):
            devices[index] = TwinDevice(measurements.devices["device"][index], found.x_m, found.y_m, found.z_m,
                                        "unknown", found.located, found.credible_radius_m, found.second_mode)
    if channel.trend is not channel:
        device_m = np.array([(d.x_m, d.y_m, d.z_m) if d.located else (np.nan,) * 3 for d in devices])
        channel = _fit_channel(measurements, device_m, scene, MODELS[model](), limit_db, seed)
    provenance = {"scene": scene.config.name, "scene_hash": scene.content_hash(), "links": len(measurements.table),
                  "flights": measurements.flights, "seed": seed, "radiotwin_version": radiotwin.__version__}
    return Twin(channel, devices, level, limit_db, provenance)


def _fit_channel(measurements, device_m, scene, channel: ChannelModel, limit_db, seed) -> ChannelModel:
    """Fit to the links of all devices whose position in `device_m` (k, 3) is known."""
    if not measurements.is_anchor.any():
        raise BadInput("no anchor: every device has the role unknown, and a channel is learned from devices whose "
                       "positions are known; give at least one device x_m, y_m and the role anchor in devices.csv")
    known = np.isfinite(device_m[:, :2]).all(axis=1)[measurements.device_index]
    if not known.any():
        raise BadInput("no link to an anchor: none of the devices with role anchor was measured; fly nearer to them")
    training = measurements.select(known)
    links = make_links(device_m, training.receiver_m, training.device_index, scene.city)
    check_fit_data(links, training.level_db, needs_los=channel.uses_map)
    return channel.fit(links, training.level_db, limit_db, seed)


def _check_positions(measurements: Measurements, scene: Scene) -> None:
    """Raise BadInput for what a 3D map cannot be used with, warn about what is odd."""
    if measurements.table["receiver_z_m"].isna().any():
        row = int(np.flatnonzero(measurements.table["receiver_z_m"].isna())[0])
        raise BadInput(f"measurements, row {row + 2}, column receiver_z_m: the receiver's height is empty; with a 3D "
                       "map every position needs one")
    measured = np.unique(measurements.device_index)
    for index in measured[np.isnan(measurements.device_m[measured, 2])]:
        raise BadInput(f"devices, row {index + 2}, column z_m: the height of device "
                       f"{measurements.devices['device'][index]!r} is empty; with a 3D map every position needs one")
    anchors = np.flatnonzero(measurements.is_anchor & np.isfinite(measurements.device_m).all(axis=1))
    for index in anchors[scene.city.inside(measurements.device_m[anchors])]:
        x_m, y_m, z_m = measurements.device_m[index]
        name = measurements.devices["device"][index]
        raise BadInput(f"devices, row {index + 2}: anchor {name!r} at ({x_m:g}, {y_m:g}, {z_m:g}) m is inside a "
                       "building of the scene; correct its position, or the scene's frame")
    receiver_m = measurements.receiver_m
    low, high = scene.city.vertices.min(axis=0)[:2], scene.city.vertices.max(axis=0)[:2]
    for odd, where in ((scene.city.inside(receiver_m), "inside buildings"),
                       (((receiver_m[:, :2] < low) | (receiver_m[:, :2] > high)).any(axis=1), "outside the 3D map")):
        if odd.any():
            warnings.warn(f"{odd.sum()} of {len(odd)} receiver positions lie {where}: do measurements and scene share "
                          "one frame and unit?", stacklevel=3)


def _check_limit(measurements: Measurements, limit_db: float) -> None:
    """Warn where blank levels are said to lie below a limit that no measured level comes near."""
    level_db = measurements.level_db
    blank = np.isnan(level_db)
    if blank.mean() > FEW_BLANK and not blank.all() and np.nanmin(level_db) > limit_db + LIMIT_GAP_DB:
        warnings.warn(f"{blank.sum()} levels are blank and taken for levels below the scene's limit of detection, "
                      f"{limit_db:.0f} dB, but the weakest measured one is {np.nanmin(level_db):.0f} dB: check "
                      "sensitivity_dbm and tx_power_dbm in scene.toml", stacklevel=3)


def _locate(measurements, scene, channel, unknown, limit_db, seed, start, settings):
    measured = np.isin(measurements.device_index, unknown)
    links = measurements.select(measured)
    start_m = None
    if start is not None:
        before = {device.device: (device.x_m, device.y_m) for device in start.devices}
        start_m = np.array([before.get(measurements.devices["device"][i], (np.nan, np.nan)) for i in unknown])
    return localize(
        links.receiver_m, links.device_index, links.level_db, channel, devices=unknown,
        bounds=scene.config.extent.bounds, z_m=measurements.device_m[unknown, 2],
        city=scene.city, limit_db=limit_db, seed=seed, start_m=start_m, settings=settings)


def _anchor(row) -> TwinDevice:
    return TwinDevice(row.device, row.x_m, row.y_m, row.z_m, "anchor", True, 0.0, None)


def _without_nan(record: dict) -> dict:
    """NaN and infinity as null: JSON has neither."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in record.items()}


def _with_nan(record: dict) -> dict:
    if record["second_mode"] is not None:
        record["second_mode"] = tuple(record["second_mode"])
    for key in ("x_m", "y_m", "z_m"):
        record[key] = np.nan if record[key] is None else record[key]
    if record["credible_radius_m"] is None:
        record["credible_radius_m"] = np.inf
    return record
