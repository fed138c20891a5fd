"""The twin: a channel, the positions of all devices, and effects and errors fitted upon them."""

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
_TURN = np.linspace(0.0, 2 * np.pi, 73)
CHUNK, CHUNK_WITH_EFFECTS = 200_000, 20_000  # links predicted at once: bounds memory


def plot_positions(devices: list[TwinDevice], ax: Axes | None, origin: Origin | None,
                   scene: Scene | None, geographic: bool | None) -> Axes:
    """Draw devices with the circles of their 90 % radii; see `Twin.plot`."""
    frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
    if scene is not None:
        draw_outlines(ax, scene, frame)
    placed = [each for each in devices if np.isfinite([each.x_m, each.y_m]).all()]
    for role, marker, size, colour, label in MARKS:
        for sure in (True, False):
            some = [each for each in placed if each.role == role and each.located == sure]
            if not some:
                continue
            name = label if role == "anchor" else "located" if sure else "best guess, not located"
            x_m, y_m = np.array([(each.x_m, each.y_m) for each in some]).T
            draw_points(ax, frame, x_m, y_m, marker=marker, s=size, label=name, zorder=4,
                        facecolors=colour if sure else "white", edgecolors="black" if sure
                        else colour, linewidths=0.7 if sure else 1.5)
    wide = [each for each in placed if each.located and 0 < each.credible_radius_m < np.inf]
    for number, each in enumerate(wide):
        ring = frame.at(each.x_m + each.credible_radius_m * np.cos(_TURN),
                        each.y_m + each.credible_radius_m * np.sin(_TURN))
        ax.plot(*ring, color="#f08a00", linewidth=1.2, zorder=3,
                label="" if number else "90 % radius")
    for each in placed[:MAX_NAMES]:
        x, y = frame.at(each.x_m, each.y_m)
        ax.annotate(plain(each.device, 24), (float(x), float(y)), xytext=(5, 5),
                    textcoords="offset points", fontsize=8, zorder=5)
    frame.prepare(ax)
    add_legend(ax)
    missing = len(devices) - len(placed)
    ax.set_title(f"{len(devices)} devices" + f", {missing} without a position" * bool(missing))
    return ax
HEIGHTS = "receiver_heights_m"  # in the provenance: 10 and 90 % of the links, above the ground
MAX_SAMPLED = 10_000  # links that tell these
MIN_GAP_M = 10.0  # between these and a lattice: no other map, for drones and phones alike


@dataclass(frozen=True, eq=False, repr=False)
class Twin(Summarised):
    """A learnt model of all links of a scene.

    Attributes:
        fitted: the channel, and levels, effects and errors fitted upon it; the channel alone where
            `close-loop` did not look and the channel does not need levels.
        devices: in the order of the measurements' `devices.csv`.
        level: `gain_db`, or `rssi_dbm` where transmit power is unknown.
        limit_db: level below which receivers do not detect [dB]: the median of theirs, see
            `Links.usual_limit_db`; None where it was not known.
        provenance: measurements, scene, seed and version that made it.
        declared: of the devices' powers, cables, antennas and carriers; what of it is in the levels
            was taken off them before anything was learnt, and is put back where they are predicted.
        scene: that is taken where none is given; not saved with the twin.
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
        """Fitted law: `links` (LoS, NLoS or all), `parameter, value, low, high, unit`.

        The interval holds 90 %; it is empty where it is not known, such as after `close-loop`.
        There is no row where the channel has no log-distance law.
        """
        rows = self.provenance.get(LAW)
        if rows is None:
            sd_db = self.fitted.scale_db * sd_of_scale(self.fitted.dof)
            rows = parameters_of(self.channel, self.fitted.level_coefficients, sd_db)
        return law_frame(rows, self.level)

    @property
    def positions(self) -> pd.DataFrame:
        """Where the devices are: `device, role, located, radius_m`, and their place.

        `radius_m` holds 90 % of the probability. The place is `x_m, y_m, z_m`; with an origin also
        `latitude_deg, longitude_deg`.
        """
        rows = [(each.device, each.role, each.located, each.credible_radius_m)
                for each in self.devices]
        table = pd.DataFrame(rows, columns=["device", "role", "located", "radius_m"])
        return with_coordinates(table, self.device_m, self.origin)

    @property
    def channel(self) -> ChannelModel:
        """As it was fitted first, without levels that are fitted again."""
        return self.fitted.channel

    @property
    def device_m(self) -> np.ndarray:
        """(k, 3) positions [m]; NaN where nothing is known of a device's."""
        return np.array([each.position_m for each in self.devices], dtype=float).reshape(-1, 3)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects that `close-loop` found."""
        return self.fitted.effects

    @property
    def has_gains(self) -> bool:
        """Whether its levels are gains, or powers of devices that declare their transmit power."""
        return self.level == "gain_db" or self.declared.knows_powers

    @property
    def is_corrected(self) -> bool:
        """Whether effects or interpolated shadowing were added to it."""
        return bool(self.effects) or self.fitted.shadowing is not None

    @property
    def residual_field(self) -> ResidualField | None:
        """Interpolation of the residual; None where the twin has none."""
        if isinstance(self.channel, RegressionKriging | PathKriging):
            return self.channel.field
        return None if self.fitted.shadowing is None else self.fitted.shadowing.field

    @property
    def origin(self) -> Origin | None:
        """Of the frame of its positions; None where it is not known."""
        known = self.provenance.get("origin")
        return None if known is None else Origin.model_validate(known)

    @property
    def description(self) -> str:
        """Channel and effects, in one line."""
        names = [each.name for each in self.effects]
        if self.fitted.shadowing is not None:
            names.append(SHADOWING)
        return self.channel.name + (f" with {', '.join(names)}" if names else "")

    def links(self, receiver_m: np.ndarray, device: np.ndarray, scene: Scene | None = None
              ) -> Links:
        """Return links that nobody measured: receiver, flight and time unset.

        Args:
            receiver_m: (n, 3) positions of the receivers [m].
            device: (n,) row of each link's device in `devices`.
            scene: the 3D map and the radio; None: the twin's own, if it has one.

        Raises:
            BadInput: they are no such arrays.
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
        anchors = frozenset(i for i, each in enumerate(self.devices) if each.role == "anchor")
        return Links(
            columns=Columns.unmeasured(receiver_m, device, self.limit_db),
            ends=Ends(device_names=[each.device for each in self.devices],
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
        """Return the levels that are expected at places, or of links.

        Args:
            places: a data frame with the columns below, or an array (n, 3) of x, y, z [m]; or
                measurements, whose receivers are taken for faultless. Or `Links` with the twin's
                devices; measured ones with the twin's receivers.
            scene: the 3D map; None: the one that the twin was fitted in or loaded with.
            interval: probability that a level is between `low_db` and `high_db`, where the device
                is where the twin has it.
            columns: numbers or arrays: `latitude, longitude` [degrees] or `x_m, y_m`; `height_m`
                above the scene's datum, or `above_ground_m`; and `device`, a name. Without names,
                every device at each place.

        Returns:
            of places a data frame, in the order and with the index of theirs: `device, x_m, y_m,
            z_m`, `mean_db`, `sd_db`, `low_db`, `high_db` [dB or dBm], `detection_probability`; NaN
            of a device that the twin has nowhere. Of links a `Prediction`.

        Raises:
            BadInput: what cannot be used, and what to pass.
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
        names = [each.device for each in self.devices]
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
        return self.scene if scene is None else Scene.of(scene)

    def _predict(self, links: Links) -> Prediction:
        size = CHUNK if self.fitted.is_channel_alone else CHUNK_WITH_EFFECTS
        chunks = [links] if len(links) <= size else [
            links.select(slice(start, start + size)) for start in range(0, len(links), size)]
        return Prediction.concatenate([self.fitted.predict(chunk) for chunk in chunks])

    def radio_map(self, scene: Scene | Path | str | None = None) -> RadioMap:
        """Return mean and standard deviation of the level over a scene's lattice.

        For all devices that have a position, at faultless receivers. The mean is given below
        sensitivity, too; attribute `gain_limit_db` says where detection ends, by the readings where
        these have shown it.

        Args:
            scene: None: the one that the twin was fitted in or loaded with.

        Raises:
            BadInput: the twin was fitted without a 3D map or in another frame, or predicts what no
                link has.
        """
        world = self._world(scene)
        if world is None:
            raise BadInput("a map is over the lattice of a scene; pass one, radio_map(scene), or "
                           "load the twin with it, Twin.load(folder, scene)")
        return RadioMap.collect(self.map_stream(world))

    def map_stream(self, scene: Scene) -> MapStream:
        """Return the map of `radio_map`, made block by block when it is written.

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
        """Write the twin's folder, whole or not at all; a twin that is in it is replaced.

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
            folder: as `save` writes it.
            scene: that its predictions need, if it was learnt in one.

        Raises:
            BadInput: not a twin's folder, a damaged one, or effects that are not installed.
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
        """Draw where the devices are; circles hold 90 % of the probability.

        Args:
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: whose buildings are outlined; None: none are.
            geographic: whether axes are longitude and latitude; None: where the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: longitude and latitude are wanted and the origin is not known.
        """
        world = None if scene is None else Scene.of(scene)
        origin = self.origin if world is None else self.origin or world.origin
        return plot_positions(self.devices, ax, origin, world, geographic)

    def to_geodataframe(self) -> GeoDataFrame:
        """Return a row for each device, with a point in metres of the local frame.

        Columns are those of `TwinDevice`; a device that could not be located has no geometry.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        table = pd.DataFrame([asdict(each) for each in self.devices]).drop(columns="second_mode")
        return geo_data_frame(table, self.origin, position_m=self.device_m)

    def __len__(self) -> int:
        """Return the number of devices."""
        return len(self.devices)

    @property
    def _summary(self) -> Summary:
        unknown = [each for each in self.devices if each.role == "unknown"]
        located = sum(each.located for each in unknown)
        limit = "not known" if self.limit_db is None else (
            f"{self.limit_db:g} {'dB' if self.level == 'gain_db' else 'dBm'}")
        found = f"{located} of {len(unknown)} unknown ones located"
        return Summary("Twin", f"{self.description}, {count(len(self), 'device')}, {found}, "
                       f"{self.level}", (
            ("channel", self.channel.name),
            ("effects", some(each.name for each in self.effects) or "none"),
            ("devices", some(each.device for each in self.devices)), ("unknown devices", found),
            ("level", self.level), ("declared of devices", self.declared.description),
            ("limit of detection", limit),
            ("scene", str(self.provenance.get("scene", "none")))))

    def encode(self) -> tuple[str, bytes]:
        """Return the contents of the twin's two files: the record, and the channel."""
        return encode_twin(self)

    @classmethod
    def decode(cls, record: str, channel: bytes, source: object) -> Twin:
        """Return the twin that `encode` described.

        Args:
            record: content of `twin.json`.
            channel: content of the channel's file.
            source: where they are from, for the message.

        Raises:
            BadInput: as `load`.
        """
        return cls(**decode_twin(record, channel, source))

    def power_dbm(self, scene: Scene) -> np.ndarray:
        """Return the transmit power that is in the levels of each device (k,) [dBm]; 0 of gains.

        Warns:
            Levels are received powers, no device declares its power, and the scene has the default
            of 0 dBm.
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
        """Warn where the twin was learnt in another scene than one with this hash."""
        if self.provenance.get("scene_hash") not in (None, scene_hash):
            warnings.warn(f"the twin was learnt in another scene ({self.provenance.get('scene')}) "
                          f"than {scene.folder}, or this one has changed since: geometry, radio or "
                          "declared devices differ", stacklevel=3)

    def warn_of_other_heights(self, scene: Scene) -> None:
        """Warn where the lattice of a scene is far above or below what the twin was learnt from."""
        low_m, high_m = self.provenance.get(HEIGHTS) or (-np.inf, np.inf)
        first_m, *_, last_m = np.repeat(np.sort(scene.config.lattice.altitudes_m), 2)
        gap_m = max(first_m - high_m, low_m - last_m)
        if gap_m > max(MIN_GAP_M, min(high_m, last_m)):
            warnings.warn(f"the twin was learnt at {low_m:g} to {high_m:g} m above the ground, and "
                          f"the lattice of {scene.folder} is at {first_m:g} to {last_m:g} m: its "
                          "map is an extrapolation; build the scene with --measurements, or with "
                          f"--altitudes {(low_m + high_m) / 2:g}", stacklevel=3)

    def require_frame(self, scene: Scene) -> None:
        """Check that the positions of the twin are not known to be in another frame than a scene's.

        Raises:
            BadInput: they are.
        """
        own, other = self.origin, scene.config.origin
        if own is not None and other is not None and not is_same_frame(own, other):
            raise BadInput(f"the twin is in the frame about {origin_text(own)}, the scene "
                           f"{scene.folder} in that about {origin_text(other)}: positions would be "
                           "elsewhere; build the "
                           f"scene with --origin {own.latitude_deg:.10g},{own.longitude_deg:.10g}"
                           f",{own.altitude_m:g}, or fit again with this one")

    def require_map(self, scene: Scene | None) -> None:
        """Check that the twin was fitted with a 3D map in this frame, or without one as now.

        Levels that were fitted to each class of line of sight need a map, and one level for all
        links cannot use one.

        Raises:
            BadInput: it was not.
        """
        if scene is not None:
            self.require_frame(scene)
        if not self.channel.uses_map:
            return
        # A level and a slope for each class; without any, `radiotwin fit` made it with a map.
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
    """Return the entry of the provenance on how high receivers were; none without a map."""
    if links.city is None:
        return {}
    some_m = links.receiver_m[::max(len(links) // MAX_SAMPLED, 1)]
    above_m = some_m[:, 2] - links.city.ground_height_m(*some_m[:, :2].T)
    return {HEIGHTS: np.quantile(above_m, (0.1, 0.9)).round(1).tolist()}
