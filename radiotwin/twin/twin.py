"""Twin: fitted channel and effects, and positions of all devices; predicts levels and maps."""

from __future__ import annotations

import json
import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

import radiotwin
from radiotwin.display import (
    PlotFrame,
    Summarised,
    Summary,
    add_legend,
    count,
    draw_points,
    geo_data_frame,
    new_axes,
    plain,
    some,
)
from radiotwin.effects.base import Effect
from radiotwin.errors import BadInput
from radiotwin.geo import is_same_frame, origin_text, with_coordinates
from radiotwin.inference.student import sd_of_scale
from radiotwin.io.files import atomic_folder
from radiotwin.io.forms import Origin
from radiotwin.io.inputs import read_bytes, read_text, require_within
from radiotwin.links.alignment import in_known_frame
from radiotwin.links.declared import NOTHING, Declared
from radiotwin.links.links import Columns, Ends, Links, Prediction, World
from radiotwin.links.measurements import Measurements
from radiotwin.maps.file import POWERS, MapStream
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws import ChannelModel
from radiotwin.propagation.laws.kriging import RegressionKriging, ResidualField
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.plot import MARKS, draw_outlines
from radiotwin.twin.law import LAW, law_frame, parameters_of
from radiotwin.twin.localize import TwinDevice
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING
from radiotwin.twin.model.model import FittedModel
from radiotwin.twin.places import Places
from radiotwin.twin.store import (
    CHANNEL_FILE,
    TWIN_FILE,
    check_twin_target,
    decode_twin,
    encode_twin,
)

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

MAX_NAMES = 40  # more names would hide the map
_TURN = np.linspace(0.0, 2 * np.pi, 73)  # angles of a drawn circle [rad]
CHUNK, CHUNK_WITH_EFFECTS = 200_000, 20_000  # links predicted at a time: bounds memory
HEIGHTS = "receiver_heights_m"  # in the provenance: 10 and 90 % quantile, above the ground
MAX_SAMPLED = 10_000  # links from which these are computed
MIN_GAP_M = 10.0  # between these heights and a lattice for which the user is warned


def plot_positions(devices: list[TwinDevice], ax: Axes | None, origin: Origin | None,
                   scene: Scene | None, geographic: bool | None) -> Axes:
    """Draw devices with circles of their 90 % radii; arguments as in `Twin.plot`."""
    frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
    if scene is not None:
        draw_outlines(ax, scene, frame)
    placed = [device for device in devices if np.isfinite([device.x_m, device.y_m]).all()]
    for role, marker, size, colour, label in MARKS:
        for sure in (True, False):
            group = [device for device in placed if device.role == role and device.located == sure]
            if not group:
                continue
            name = label if role == "anchor" else "located" if sure else "best guess, not located"
            x_m, y_m = np.array([(device.x_m, device.y_m) for device in group]).T
            draw_points(ax, frame, x_m, y_m, marker=marker, s=size, label=name, zorder=4,
                        facecolors=colour if sure else "white", edgecolors="black" if sure
                        else colour, linewidths=0.7 if sure else 1.5)
    circled = [device for device in placed
               if device.located and 0 < device.credible_radius_m < np.inf]
    for number, device in enumerate(circled):
        ring = frame.at(device.x_m + device.credible_radius_m * np.cos(_TURN),
                        device.y_m + device.credible_radius_m * np.sin(_TURN))
        ax.plot(*ring, color="#f08a00", linewidth=1.2, zorder=3,
                label="" if number else "90 % radius")
    for device in placed[:MAX_NAMES]:
        x, y = frame.at(device.x_m, device.y_m)
        ax.annotate(plain(device.device, 24), (float(x), float(y)), xytext=(5, 5),
                    textcoords="offset points", fontsize=8, zorder=5)
    frame.prepare(ax)
    add_legend(ax)
    missing = len(devices) - len(placed)
    ax.set_title(f"{len(devices)} devices" + f", {missing} without a position" * bool(missing))
    return ax


@dataclass(frozen=True, eq=False, repr=False)
class Twin(Summarised):
    """A fitted model of all radio links of a scene.

    Attributes:
        fitted: channel with refitted levels, effects and error scales; only the channel if the twin
            is of `radiotwin fit` and the channel needs no levels.
        devices: devices in the order of the measurements' `devices.csv`.
        level: predicted quantity: `gain_db`, or `rssi_dbm` if transmit power is unknown.
        limit_db: limit of detection [dB or dBm, as `level`], the median over receivers, see
            `Links.usual_limit_db`; None: unknown.
        provenance: measurements, scene, seed and version of the fit.
        declared: declared powers, cables, antennas and carriers of the devices; they were
            subtracted from levels before the fit, and are added to predictions.
        scene: default scene of predictions; not saved with the twin.
    """

    fitted: FittedModel
    devices: list[TwinDevice]
    level: str
    limit_db: float | None
    provenance: dict = field(default_factory=dict)
    declared: Declared = NOTHING
    scene: Scene | None = None

    @property
    def params(self) -> pd.DataFrame:
        """Return the fitted log-distance law: `links, parameter, value, low, high, unit`.

        `links` is LoS, NLoS or all. `low` to `high` is the 90 % interval, NaN if unknown, such as
        after `close-loop`. Empty if the channel has no log-distance law.
        """
        rows = self.provenance.get(LAW)
        if rows is None:
            sd_db = self.fitted.scale_db * sd_of_scale(self.fitted.dof)
            rows = parameters_of(self.channel, self.fitted.level_coefficients, sd_db)
        return law_frame(rows, self.level)

    @property
    def positions(self) -> pd.DataFrame:
        """Return the positions of the devices: `device, role, located, radius_m, x_m, y_m, z_m`.

        `radius_m` holds 90 % of the probability. With a known origin also `latitude_deg,
        longitude_deg`.
        """
        rows = [(device.device, device.role, device.located, device.credible_radius_m)
                for device in self.devices]
        table = pd.DataFrame(rows, columns=["device", "role", "located", "radius_m"])
        return with_coordinates(table, self.device_m, self.origin)

    @property
    def channel(self) -> ChannelModel:
        """Return the channel model, before levels are refitted with effects."""
        return self.fitted.channel

    @property
    def device_m(self) -> np.ndarray:
        """Return the positions (k, 3) of the devices [m]; NaN: unknown."""
        return np.array([device.position_m for device in self.devices],
                        dtype=float).reshape(-1, 3)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects that `close-loop` found."""
        return self.fitted.effects

    @property
    def has_gains(self) -> bool:
        """Return True if levels are gains, or all devices declare their transmit power."""
        return self.level == "gain_db" or self.declared.knows_powers

    @property
    def is_corrected(self) -> bool:
        """Return True if `close-loop` added effects or interpolated shadowing."""
        return bool(self.effects) or self.fitted.shadowing is not None

    @property
    def residual_field(self) -> ResidualField | None:
        """Return the interpolation of residuals; None if the twin does not interpolate."""
        if isinstance(self.channel, RegressionKriging | PathKriging):
            return self.channel.field
        return None if self.fitted.shadowing is None else self.fitted.shadowing.field

    @property
    def origin(self) -> Origin | None:
        """Return the origin of the local frame; None: unknown."""
        known = self.provenance.get("origin")
        return None if known is None else Origin.model_validate(known)

    @property
    def description(self) -> str:
        """Return the names of channel and effects in one line."""
        names = [effect.name for effect in self.effects]
        if self.fitted.shadowing is not None:
            names.append(SHADOWING)
        return self.channel.name + (f" with {', '.join(names)}" if names else "")

    def links(self, receiver_m: np.ndarray, device: np.ndarray, scene: Scene | None = None
              ) -> Links:
        """Make links to predict, without receivers, flights, times; devices at NaN go to 0, 0, 0.

        Args:
            receiver_m: (n, 3) positions of the receivers [m].
            device: (n,) row of each link's device in `devices`.
            scene: the 3D map and the radio; None: the twin's own, if it has one.

        Raises:
            BadInput: wrong shapes, or unknown rows of devices.
        """
        receiver_m, device = np.asarray(receiver_m), np.asarray(device)
        if receiver_m.ndim != 2 or receiver_m.shape[1] != 3 or device.shape != receiver_m.shape[:1]:
            raise BadInput(f"links need positions (n, 3) in metres and n devices, not arrays of "
                           f"the shapes {receiver_m.shape} and {device.shape}")
        if device.dtype.kind not in "iu" or len(device) and not (
                0 <= device.min() <= device.max() < len(self)):
            raise BadInput(f"the devices of links are rows of twin.devices, 0 to {len(self) - 1}; "
                           "twin.predict takes their names")
        scene = scene or self.scene
        anchors = frozenset(i for i, known in enumerate(self.devices) if known.role == "anchor")
        return Links(
            columns=Columns.unmeasured(receiver_m, device, self.limit_db),
            ends=Ends(device_names=[known.device for known in self.devices],
                      device_m=np.nan_to_num(self.device_m), anchors=anchors,
                      declared=self.declared),
            world=World(frequency_hz=np.nan if scene is None else scene.config.radio.frequency_hz,
                        city=None if scene is None else scene.city,
                        is_gain=self.level == "gain_db"))

    @overload
    def predict(self, places: Links) -> Prediction: ...

    @overload
    def predict(self, places: Measurements | pd.DataFrame | np.ndarray | None = None, *,
                scene: Scene | Path | str | None = None, interval: float = 0.9,
                **columns: Any) -> pd.DataFrame: ...

    def predict(self, places: Links | Measurements | pd.DataFrame | np.ndarray | None = None, *,
                scene: Scene | Path | str | None = None, interval: float = 0.9,
                **columns: Any) -> Prediction | pd.DataFrame:
        """Predict the levels of devices at places, or of given links.

        Args:
            places: a data frame with the columns below, an array (n, 3) of x, y, z [m], or
                measurements, all predicted without effects of receivers; or `Links` with the twin's
                devices and receivers.
            scene: the 3D map; None: the scene in which the twin was fitted or loaded.
            interval: probability that a level is between `low_db` and `high_db`, given the device's
                position.
            columns: numbers or arrays: `latitude, longitude` [degrees] or `x_m, y_m`; `height_m`
                above the scene's datum, or `above_ground_m`; and `device`, a name. Without device,
                every device is predicted at each place.

        Returns:
            for places a data frame with their order and index: `device, x_m, y_m, z_m`, `mean_db`,
            `sd_db`, `low_db`, `high_db` [dB or dBm], `detection_probability`; NaN for a device
            without a position. For links a `Prediction`.

        Raises:
            BadInput: a wrong argument; the message says what to pass.
        """
        if isinstance(places, Links):
            return self._predict(places)
        if not 0 < interval < 1:
            raise BadInput(f"interval = {interval:g} is no probability between 0 and 1; 0.9 holds "
                           "nine levels in ten")
        world = self._world(scene)
        self.require_map(world)
        if isinstance(places, Measurements):
            places = in_known_frame(places, self.origin, "the twin").table
        origin = self.origin or (None if world is None else world.origin)
        names = [device.device for device in self.devices]
        found = Places.read(places, columns, names, origin, None if world is None else world.city)
        known = np.isfinite(self.device_m).all(axis=1)[found.device]
        values = np.full((3, len(known)), np.nan)
        if known.any():
            predicted = self._predict(self.links(found.receiver_m[known], found.device[known],
                                                 world))
            values[:, known] = (predicted.mean_db, predicted.sd_db,
                                predicted.detection_probability)
        mean_db, sd_db, detected = values
        dof = self.fitted.dof
        reach_db = student_t.ppf((1 + interval) / 2, dof) * sd_db / sd_of_scale(dof)
        x_m, y_m, z_m = found.receiver_m.T
        return pd.DataFrame({
            "device": np.array(names)[found.device],
            "x_m": x_m, "y_m": y_m, "z_m": z_m, "mean_db": mean_db, "sd_db": sd_db,
            "low_db": mean_db - reach_db, "high_db": mean_db + reach_db,
            "detection_probability": detected}, index=found.index)

    def _world(self, scene: Scene | Path | str | None) -> Scene | None:
        """Return the given scene, or by default the twin's own."""
        return self.scene if scene is None else Scene.of(scene)

    def _predict(self, links: Links) -> Prediction:
        """Predict links in chunks, to bound memory."""
        length = CHUNK if self.fitted.is_channel_alone else CHUNK_WITH_EFFECTS
        chunks = [links] if len(links) <= length else [
            links.select(slice(start, start + length)) for start in range(0, len(links), length)]
        return Prediction.concatenate([self.fitted.predict(chunk) for chunk in chunks])

    def radio_map(self, scene: Scene | Path | str | None = None) -> RadioMap:
        """Predict mean and standard deviation of gains over a scene's lattice as a radio map.

        It holds all devices that have a position, and leaves out effects of receivers. The mean is
        predicted even below sensitivity; the attribute `gain_limit_db` is the limit of detection,
        that of the readings if known.

        Args:
            scene: the scene; None: that in which the twin was fitted or loaded.

        Raises:
            BadInput: the twin was fitted without a 3D map or in another frame, or predicts
                impossible levels.
        """
        world = self._world(scene)
        if world is None:
            raise BadInput("a map is over the lattice of a scene; pass one, radio_map(scene), or "
                           "load the twin with it, Twin.load(folder, scene)")
        return RadioMap.collect(self.map_stream(world))

    def map_stream(self, scene: Scene) -> MapStream:
        """Return the radio map as a stream that is predicted block by block as it is written.

        Raises:
            BadInput: the twin was fitted without a 3D map, or in another frame.
        """
        self.require_map(scene)
        scene_hash = scene.content_hash()
        self.warn_of_another_scene(scene, scene_hash)
        self.warn_of_other_heights(scene)
        known = np.flatnonzero(np.isfinite(self.device_m).all(axis=1))
        rows = {self.devices[i].device: int(i) for i in known}
        power_dbm = self.power_dbm(scene)

        def make(device: str, lattice: Lattice) -> dict[str, np.ndarray]:
            receiver_m = lattice.positions_m
            links = self.links(receiver_m, np.full(len(receiver_m), rows[device]), scene)
            predicted = self._predict(links)
            values = {"gain_db": predicted.mean_db - power_dbm[rows[device]], "los": links.los,
                      "sigma_db": predicted.sd_db}
            return {name: value.reshape(lattice.shape) for name, value in values.items()}

        limit_db = scene.config.gain_limit_db if self.limit_db is None \
            else self.limit_db - float(np.median(power_dbm))
        attributes = {"source": f"twin:{self.description}",
                      "frequency_hz": scene.config.radio.frequency_hz,
                      "gain_limit_db": limit_db, "scene_hash": scene_hash,
                      "radiotwin_version": radiotwin.__version__}
        if self.level == "rssi_dbm" and not np.ptp(power_dbm):
            attributes["tx_power_dbm"] = float(power_dbm[0])
        powers_dbm = {name: self.declared.radios[row].tx_power_dbm for name, row in rows.items()
                      if self.declared.radios
                      and self.declared.radios[row].tx_power_dbm is not None}
        if powers_dbm:
            attributes[POWERS] = json.dumps(powers_dbm)
        return MapStream(list(rows), scene.lattice, attributes, ("gain_db", "los", "sigma_db"),
                         make).with_origin(scene.config.origin)

    def save(self, folder: Path | str) -> None:
        """Write the twin's folder, all or nothing; replace a twin in it.

        Raises:
            BadInput: the folder exists and is not a twin's.
        """
        folder = Path(folder)
        check_twin_target(folder)
        record, channel = self.encode()
        with atomic_folder(folder) as temporary:
            (temporary / CHANNEL_FILE).write_bytes(channel)
            (temporary / TWIN_FILE).write_text(record, encoding="utf-8")

    @classmethod
    def load(cls, folder: Path | str, scene: Scene | Path | str | None = None) -> Twin:
        """Read a twin's folder.

        Args:
            folder: folder written by `save`.
            scene: scene for predictions, or its folder; None: none.

        Raises:
            BadInput: not a twin's folder, damaged, or an effect is not installed.
        """
        folder = Path(folder)
        path = folder / TWIN_FILE
        if not path.exists():
            raise BadInput(f"{folder} is not a twin's folder (no {TWIN_FILE}); `radiotwin fit` "
                           "makes one")
        record, channel = (require_within(folder, folder / name, str(folder))
                           for name in (TWIN_FILE, CHANNEL_FILE))
        twin = cls.decode(read_text(record, "twin"), read_bytes(channel, "channel model"), path)
        return replace(twin, scene=None if scene is None else Scene.of(scene))

    def plot(self, ax: Axes | None = None, *, scene: Scene | Path | str | None = None,
             geographic: bool | None = None) -> Axes:
        """Draw the devices with circles that hold 90 % of the probability; return the axes.

        Args:
            ax: matplotlib axes; None: a new figure.
            scene: scene whose buildings are outlined; None: no buildings.
            geographic: axes in longitude and latitude; None: if the origin is known.

        Raises:
            BadInput: longitude and latitude are requested, and the origin is unknown.
        """
        world = None if scene is None else Scene.of(scene)
        origin = self.origin if world is None else self.origin or world.origin
        return plot_positions(self.devices, ax, origin, world, geographic)

    def to_geodataframe(self) -> GeoDataFrame:
        """Return a row for each device, with a point in the local frame [m].

        Columns are those of `TwinDevice`; a device without a position has no geometry.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        table = pd.DataFrame([asdict(device) for device in self.devices])
        table = table.drop(columns="second_mode")
        return geo_data_frame(table, self.origin, position_m=self.device_m)

    def __len__(self) -> int:
        """Return the number of devices."""
        return len(self.devices)

    @property
    def _summary(self) -> Summary:
        """Return the lines that the twin prints: channel, effects, devices, level, limit, scene."""
        unknown = [device for device in self.devices if device.role == "unknown"]
        located = sum(device.located for device in unknown)
        limit = "not known" if self.limit_db is None else (
            f"{self.limit_db:g} {'dB' if self.level == 'gain_db' else 'dBm'}")
        found = f"{located} of {len(unknown)} unknown ones located"
        return Summary("Twin", f"{self.description}, {count(len(self), 'device')}, {found}, "
                       f"{self.level}", (
            ("channel", self.channel.name),
            ("effects", some(effect.name for effect in self.effects) or "none"),
            ("devices", some(device.device for device in self.devices)), ("unknown devices", found),
            ("level", self.level), ("declared of devices", self.declared.description),
            ("limit of detection", limit),
            ("scene", str(self.provenance.get("scene", "none")))))

    def encode(self) -> tuple[str, bytes]:
        """Encode the twin as the contents of its two files, `twin.json` and the channel."""
        return encode_twin(self)

    @classmethod
    def decode(cls, record: str, channel: bytes, source: object) -> Twin:
        """Decode a twin from the contents of its files.

        Args:
            record: content of `twin.json`.
            channel: content of the channel's file.
            source: path of the twin, for messages.

        Raises:
            BadInput: see `load`.
        """
        return cls(**decode_twin(record, channel, source))

    def power_dbm(self, scene: Scene) -> np.ndarray:
        """Return the transmit power (k,) that each device's levels contain [dBm]; 0 for gains.

        Warns:
            Levels are received powers, and neither devices nor the scene declare transmit power.
        """
        if self.level == "gain_db":
            return np.zeros(len(self))
        if self.declared.knows_powers:
            return np.array([radio.tx_power_dbm for radio in self.declared.radios])
        radio = scene.config.radio
        if not radio.declares_power:
            warnings.warn(f"gains are levels minus the transmit power, which nobody declared: "
                          f"{radio.tx_power_dbm:g} dBm is assumed. Levels in dBm do not depend on "
                          f"it, gains do. Declare tx_power_dbm in {scene.folder / 'scene.toml'}, "
                          "or for each device in devices.csv before `fit`", stacklevel=3)
        return np.full(len(self), radio.tx_power_dbm)

    def warn_of_another_scene(self, scene: Scene, scene_hash: str) -> None:
        """Warn if the twin was fitted in another scene than the one with this hash."""
        if self.provenance.get("scene_hash") not in (None, scene_hash):
            warnings.warn(f"the twin was learnt in another scene ({self.provenance.get('scene')}) "
                          f"than {scene.folder}, or this one has changed since: geometry, radio or "
                          "declared devices differ", stacklevel=3)

    def warn_of_other_heights(self, scene: Scene) -> None:
        """Warn if a scene's lattice is far above or below the heights of the measurements."""
        low_m, high_m = self.provenance.get(HEIGHTS) or (-np.inf, np.inf)
        first_m, *_, last_m = np.repeat(np.sort(scene.config.lattice.altitudes_m), 2)
        gap_m = max(first_m - high_m, low_m - last_m)
        if gap_m > max(MIN_GAP_M, min(high_m, last_m)):
            warnings.warn(f"the twin was learnt at {low_m:g} to {high_m:g} m above the ground, and "
                          f"the lattice of {scene.folder} is at {first_m:g} to {last_m:g} m: its "
                          "map is an extrapolation; build the scene with --measurements, or with "
                          f"--altitudes {(low_m + high_m) / 2:g}", stacklevel=3)

    def require_frame(self, scene: Scene) -> None:
        """Raise BadInput if twin and scene have known origins that differ."""
        known, other = self.origin, scene.config.origin
        if known is not None and other is not None and not is_same_frame(known, other):
            raise BadInput(f"the twin is in the frame about {origin_text(known)}, the scene "
                           f"{scene.folder} in that about {origin_text(other)}: positions would be "
                           f"elsewhere; build the scene with --origin {known.latitude_deg:.10g},"
                           f"{known.longitude_deg:.10g},{known.altitude_m:g}, or fit again with "
                           "this one")

    def require_map(self, scene: Scene | None) -> None:
        """Raise BadInput if the twin needs a 3D map that is not given, or cannot use the given one.

        A twin fitted with a map has levels for LoS and NLoS, one fitted without has one level for
        all links. Twin and scene must also have the same frame.
        """
        if scene is not None:
            self.require_frame(scene)
        if not self.channel.uses_map:
            return
        # With a map there are levels for LoS and NLoS; `radiotwin fit` always has a map.
        with_map = (self.channel.follows_paths or self.fitted.is_channel_alone
                    or len(self.fitted.level_coefficients) > 2)
        if with_map and scene is None:
            raise BadInput(f"the twin was made with a 3D map (scene "
                           f"{self.provenance.get('scene', 'unknown')}), and none is given; give "
                           "it with --scene, in Python as scene=")
        if scene is not None and not with_map:
            raise BadInput(f"the twin was made without a 3D map, and cannot use that of "
                           f"{scene.folder}: locate devices without --scene, or run close-loop "
                           "with --scene first")


def measured_heights(links: Links) -> dict[str, list[float]]:
    """Return the 10 % and 90 % quantile of receivers' heights above the ground [m].

    As an entry of a twin's provenance; empty without a map.
    """
    if links.city is None:
        return {}
    sampled_m = links.receiver_m[::max(len(links) // MAX_SAMPLED, 1)]
    above_m = sampled_m[:, 2] - links.city.ground_height_m(*sampled_m[:, :2].T)
    return {HEIGHTS: np.quantile(above_m, (0.1, 0.9)).round(1).tolist()}
